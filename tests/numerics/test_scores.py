"""Scores of probabilities: the server's sums and the client's means are the same numbers."""

from __future__ import annotations

import numpy as np
import pytest

from potclient import metrics
from potserver.numerics import scores


@pytest.fixture(params=[0, 1, 2])
def judged(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities with ties and both ends, and a truth that they know something of."""
    rng = np.random.default_rng(request.param)
    p = np.concatenate([rng.random(400).round(2), [0.0, 1.0, 0.5, 1e-9]])
    return p, rng.random(len(p)) < 0.2 + 0.6 * p


def test_the_server_scores_as_the_client_does(judged: tuple[np.ndarray, np.ndarray]) -> None:
    p, occupied = judged
    wanted = metrics.score(p, occupied)
    n = len(p)
    assert scores.nll_sum(p, occupied) / n == pytest.approx(wanted.nll, rel=1e-9)
    assert scores.brier_sum(p, occupied) / n == pytest.approx(wanted.brier, rel=1e-12)
    assert scores.calibration_error(scores.calibration_bins(p, occupied), n) == pytest.approx(wanted.ece)
    assert scores.auc(p[occupied], p[~occupied]) == pytest.approx(wanted.auc, rel=1e-12)
    assert (scores.N_BINS, wanted.n) == (metrics.N_BINS, n)


def test_bins_count_every_point_once(judged: tuple[np.ndarray, np.ndarray]) -> None:
    p, occupied = judged
    bins = scores.calibration_bins(p, occupied)
    assert bins[:, 0].sum() == len(p)
    assert bins[:, 1].sum() == pytest.approx(p.sum())
    assert bins[:, 2].sum() == occupied.sum()


def test_an_auc_against_counting_pairs() -> None:
    rng = np.random.default_rng(3)
    occupied, free = rng.integers(0, 9, 40).astype(float), rng.integers(0, 7, 30).astype(float)
    wins = (occupied[:, None] > free).mean() + 0.5 * (occupied[:, None] == free).mean()
    assert scores.auc(occupied, free) == pytest.approx(wins)
