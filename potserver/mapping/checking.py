"""The map's self-check: scores on beams that it never learns, and the moderation of answers that they choose."""

from __future__ import annotations

from potserver.domain.kernel_map import KernelMap
from potserver.domain.running_scores import RunningScores
from potserver.domain.types import Float64
from potserver.mapping.sampling import Draws
from potserver.numerics.beams import Beams, label_beams

_GAP_M = 0.5  # before a beam's end, where the map is not asked whether it is free


def check(
    snapshot: KernelMap, beams: Beams, origin: Float64, scores: RunningScores, draws: Draws
) -> RunningScores:
    """The scores after a map was asked about beams: their ends, and one point of each that they crossed.

    Args:
        snapshot: Of the map.
        beams: That it did not learn, relative to `origin`.
        origin: (3,) m, map frame.
        scores: Until now.
        draws: Of this scan.
    """
    asked = label_beams(beams, free_per_beam=1, gap_m=_GAP_M, rng=draws.check)
    answer = snapshot.occupancy(asked.points + origin)
    return scores.with_points(
        answer.latent_mean, answer.latent_var, asked.occupied, snapshot.rule.mean_moderation
    )
