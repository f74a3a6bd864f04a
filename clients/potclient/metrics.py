"""How good occupancy probabilities are: ACC, AUC, NLL, Brier, ECE. numpy only."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from potclient.arrays import Float64
from potclient.errors import UsageError

N_BINS = 15
CLIP = 1e-6


class Metrics(NamedTuple):
    """Scores of N predictions; natural logarithms."""

    n: int
    accuracy: float  # at 0.5; a tie counts as occupied
    auc: float  # area under the ROC curve, ties half; NaN when only one class is there
    nll: float  # mean negative log likelihood, probabilities clipped to [CLIP, 1 - CLIP]
    brier: float
    ece: float  # expected calibration error, N_BINS bins of equal width
    share_unknown: float


def score(p: ArrayLike, occupied: ArrayLike, observed: ArrayLike | None = None) -> Metrics:
    """Score probabilities against truth.

    Args:
        p: (N,) P(occupied).
        occupied: (N,) bool, the truth.
        observed: (N,) bool; where false the answer counts as 0.5 whatever p says. None: all observed.
    Raises:
        UsageError: the shapes differ, nothing to score, or a p outside [0, 1].
    """
    prob, truth = np.asarray(p, np.float64).ravel(), np.asarray(occupied, np.bool_).ravel()
    known = np.ones(len(prob), np.bool_) if observed is None else np.asarray(observed, np.bool_).ravel()
    if not len(prob) == len(truth) == len(known) or not len(prob):
        raise UsageError(
            f"scores need as many truths as predictions, at least one; got {len(prob)} and {len(truth)}"
        )
    if not ((prob >= 0) & (prob <= 1)).all():
        raise UsageError("probabilities must be in [0, 1]")
    prob = np.where(known, prob, 0.5)
    clipped = np.clip(prob, CLIP, 1 - CLIP)
    return Metrics(
        n=len(prob),
        accuracy=float(((prob >= 0.5) == truth).mean()),
        auc=_auc(prob, truth),
        nll=float(-np.where(truth, np.log(clipped), np.log1p(-clipped)).mean()),
        brier=float(np.square(prob - truth).mean()),
        ece=_ece(prob, truth),
        share_unknown=float(1.0 - known.mean()),
    )


def _auc(p: Float64, truth: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> float:
    n_occupied = int(truth.sum())
    n_free = len(truth) - n_occupied
    if not n_occupied or not n_free:
        return float("nan")
    _, group, counts = np.unique(p, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    ranks = (last - (counts - 1) / 2)[group]  # mean rank within ties, from 1
    return float((ranks[truth].sum() - n_occupied * (n_occupied + 1) / 2) / (n_occupied * n_free))


def _ece(p: Float64, truth: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> float:
    bins = np.minimum((p * N_BINS).astype(np.intp), N_BINS - 1)
    sum_p = np.bincount(bins, weights=p, minlength=N_BINS)
    sum_y = np.bincount(bins, weights=truth, minlength=N_BINS)
    return float(np.abs(sum_p - sum_y).sum() / len(p))
