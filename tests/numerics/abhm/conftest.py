"""What the tests of the ABHM learner share."""

from __future__ import annotations

import pytest

from potserver.numerics.abhm import problem


@pytest.fixture
def no_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """No activation is left out, as in float64."""
    monkeypatch.setattr(problem, "FEATURE_CUT", 1e-9)
