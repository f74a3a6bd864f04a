"""The authors' shipped Town 1 map on their shipped test points: the published POT row, to its last digit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from potclient.metrics import score as client_score
from potserver import KernelMap
from tests.conformance import reference


def test_table_pot_town1_to_town1(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("rss2020_pot")
    with (
        np.load(folder / "town1_to_town1_map.npz") as shipped,
        np.load(folder / "town1_test_points.npz") as test,
    ):
        town = KernelMap.from_arrays(
            shipped["qhinge_mean"], shipped["qgamma_mean_forward"], shipped["qw_mean"], shipped["qw_var"]
        )
        points, occupied = test["X_test"][:, 1:], test["Y_test"] > 0.5
    answer = town.occupancy(points)
    scores = reference.score(answer.mean, occupied, clip=1e-15)
    assert scores.accuracy == pytest.approx(0.811, abs=1e-3)
    assert scores.auc == pytest.approx(0.865, abs=1e-3)
    assert scores.nll == pytest.approx(1.110, abs=1e-3)
    ours = client_score(answer.mean, occupied)
    assert ours.accuracy == pytest.approx(scores.accuracy, abs=1e-9)
    assert ours.auc == pytest.approx(scores.auc, abs=1e-9)
    assert ours.nll == pytest.approx(reference.score(answer.mean, occupied, clip=1e-6).nll, abs=1e-9)
