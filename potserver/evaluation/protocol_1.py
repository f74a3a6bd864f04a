"""Protocol 1: free points lie at least 0.5 m before the ends of held-out beams, so walls that stand too near go unnoticed."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from potclient.holdout import LabelledPoints
from potclient.metrics import Metrics
from potserver.evaluation.beams import score_labels
from potserver.evaluation.mappers import Mapper
from potserver.evaluation.surroundings import Surroundings

_TRUTH_POINTS = 50_000  # of each kind
_NEAR_SURFACE_M = 0.2  # standard deviation of a point from the held-out hit that it is near


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Protocol1Scores:
    """How one map did."""

    held_out: Metrics
    truth: dict[str, Metrics]  # of places whose truth is known: `uniform`, `near_surfaces`

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            "held_out": self.held_out._asdict(),
            "truth": {name: metrics._asdict() for name, metrics in self.truth.items()},
        }


class Protocol1:
    """The points, the same for every map.

    Args:
        held_out: What the held-out beams say.
        surroundings: If the truth about the place is known.
    """

    def __init__(self, held_out: LabelledPoints, surroundings: Surroundings | None) -> None:
        self.held_out = held_out
        self.truth = {} if surroundings is None else _truth_points(surroundings)

    def score(self, mapper: Mapper) -> Protocol1Scores:
        """How a map does."""
        return Protocol1Scores(
            held_out=score_labels(mapper, self.held_out),
            truth={name: score_labels(mapper, points) for name, points in self.truth.items()},
        )


def _truth_points(around: Surroundings) -> dict[str, LabelledPoints]:
    """Points whose state at the time of the last scan is known exactly.

    `uniform` ones lie within half the sensor's reach of its way, up to 3 m above the ground; insides of buildings are among
    them. `near_surfaces` are held-out hits, moved at random.
    """
    rng = np.random.default_rng(0)
    uniform = around.uniform_points(_TRUTH_POINTS, around.place.lidar.max_range_m / 2, rng)
    near = around.hits_to_draw_from(_TRUTH_POINTS, rng)
    near = near + rng.normal(0.0, _NEAR_SURFACE_M, near.shape) * ([1, 1, 0] if around.planar else 1)
    return {
        name: LabelledPoints(points=points, occupied=around.occupied(points))
        for name, points in (("uniform", uniform), ("near_surfaces", near))
    }
