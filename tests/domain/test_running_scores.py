"""Running scores against plain sums, and the moderation that they choose."""

from __future__ import annotations

import math

import numpy as np
import pytest

from potschemas.answers import occupancy_mean
from potserver.domain.running_scores import MODERATIONS, RunningScores


def _answers(n: int, seed: int, *, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Latent means and variances, and truths drawn from them: `scale` times too sure of itself."""
    rng = np.random.default_rng(seed)
    latent, var = rng.normal(0, 3, n), rng.uniform(5, 20, n)
    truth = rng.random(n) < 1 / (1 + np.exp(-latent))
    return (scale * latent).astype(np.float32), var.astype(np.float32), truth


def test_scores_are_plain_means_while_all_points_are_new() -> None:
    latent, var, truth = _answers(500, 0)
    scores = RunningScores().with_points(latent, var, truth, 0.1)
    p = occupancy_mean(latent.astype(float), var.astype(float), 0.1)
    assert scores.n_points == 500
    assert scores.mean_nll(0.1) == pytest.approx(-np.log(np.where(truth, p, 1 - p)).mean())
    assert scores.mean_brier == pytest.approx(((p - truth) ** 2).mean())
    bins = np.minimum((p * 15).astype(int), 14)
    ece = sum(abs((p[bins == b] - truth[bins == b]).sum()) for b in range(15)) / 500
    assert scores.ece == pytest.approx(ece)


def test_old_points_count_less_and_the_sums_stay_bounded() -> None:
    scores = RunningScores()
    sure, none = np.full(1000, 5.0, np.float32), np.zeros(1000, np.float32)
    for _ in range(300):
        scores = scores.with_points(sure, none, np.ones(1000, bool), 0.0)
    assert 19_000 < scores.n_points < 21_000
    before = scores.mean_brier
    scores = scores.with_points(sure, none, np.zeros(1000, bool), 0.0)
    assert before < 1e-4 < 0.04 < scores.mean_brier < 0.06


def test_nothing_asked_changes_nothing() -> None:
    scores = RunningScores()
    assert scores.with_points(*(np.zeros(0, np.float32),) * 2, np.zeros(0, bool), 0.0) is scores
    assert math.isnan(scores.mean_nll(0.0))
    assert scores.moderation(0.05) == 0.05


@pytest.mark.parametrize("scale", [1.0, 4.0])
def test_the_surer_a_map_is_without_cause_the_more_it_is_moderated(scale: float) -> None:
    latent, var, truth = _answers(5000, 1, scale=scale)
    few = RunningScores().with_points(latent[:400], var[:400], truth[:400], 0.05)
    assert few.moderation(0.05) == 0.05, "too few to say"
    scores = RunningScores().with_points(latent, var, truth, 0.05)
    chosen = scores.moderation(0.05)
    assert chosen == (0.0 if scale == 1.0 else 1.0)
    assert scores.mean_nll(chosen) == min(scores.mean_nll(m) for m in MODERATIONS)
