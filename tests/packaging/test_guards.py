"""The guards that `benchmarks/guards.py` takes out are still where it looks for them."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.guards import GUARDS, Guard


@pytest.mark.parametrize("guard", GUARDS, ids=lambda guard: guard.name.replace(" ", "_"))
def test_a_guard_stands_once_in_its_file(root: Path, guard: Guard) -> None:
    assert (root / guard.file).read_text().count(guard.line) == 1
    assert (root / guard.tests).exists()
