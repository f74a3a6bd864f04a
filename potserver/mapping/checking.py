"""The map's self-check: scores on beams that it never learns, and the moderation of answers that they choose."""

from __future__ import annotations

import numpy as np

from potserver.domain.kernel_map import KernelMap
from potserver.domain.running_scores import RunningScores
from potserver.domain.types import Float64
from potserver.mapping.sampling import Draws
from potserver.numerics.beams import Beams, label_beams

_GAP_M = 0.5  # before a beam's end; the free point of each beam lies farther away
_NEAR_M = (0.05, 0.5)  # clearance of the second free point of beams with an echo


def check(
    snapshot: KernelMap, beams: Beams, origin: Float64, scores: RunningScores, draws: Draws
) -> RunningScores:
    """The scores after a map was asked about beams: their ends, and points that they crossed, far from the end and near it.

    Args:
        snapshot: Of the map.
        beams: That it did not learn, relative to `origin`.
        origin: (3,) m, map frame.
        scores: Until now.
        draws: Of this scan.
    """
    asked = label_beams(beams, free_per_beam=1, gap_m=_GAP_M, rng=draws.check)
    near = _near(beams, draws.check)
    points = np.concatenate([asked.points, near]) + origin
    occupied = np.concatenate([asked.occupied, np.zeros(len(near), np.bool_)])
    answer = snapshot.occupancy(points)
    return scores.with_points(answer.latent_mean, answer.latent_var, occupied, snapshot.rule.mean_moderation)


def _near(beams: Beams, rng: np.random.Generator) -> Float64:
    """(N, 3) m, relative to the beams' start: a free point just before each echo."""
    ends = beams.ends[beams.is_return]
    length = np.linalg.norm(ends, axis=1)
    clearance = rng.uniform(*_NEAR_M, len(ends))
    kept = length > 2.0 * clearance
    return (ends * (1.0 - clearance / length)[:, None])[kept]
