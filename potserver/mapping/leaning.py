"""What the dictionary expects of a scan's surroundings: the lean of tiles that the map sees for the first time.

A tile takes its lean from the scans that come before its first evidence, and keeps it: its kernels are solved for what evidence
says beyond the lean, so that another one would need them all solved again.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from potschemas.lean import Bytes, to_bytes
from potserver.domain.tiles import TileGrid, TileIndex
from potserver.domain.types import Bool, Borrowed, Float64
from potserver.numerics.beams import Beams, LabelledPoints, beam_weights
from potserver.numerics.heights import Ground, HeightLabels, HeightModel, HeightModels, ground_of

_JUDGED = 4_000  # labelled points, at most
_EYE_M = (0.3, 5.0)  # heights of a sensor above the ground that the models know
_STEEPEST = 0.3  # slope of a ground
_LEAST_GROUND = 6  # cells of a scan's surroundings that lie on one plane
_SURE_OF_MODEL = 5.0  # precision of the scale about 1
_LEAST_SCALE = 0.25  # with less of it, the model does not fit here
_LEAST_SHARE = 0.01  # of a model that is worth naming
_REACH_M = (-2.0, 6.0)  # heights between which a tile has something to lean on

NO_MODEL, PLANAR, NO_GROUND, NOVEL = (
    "no_model",
    "planar",
    "no_ground",
    "novel",
)  # why a scan's tiles do not lean


class Expected(NamedTuple):
    """A height model, placed: what is expected around one scan."""

    model: HeightModel
    ground: Ground  # about `origin`
    origin: Float64  # (3,) m, map frame: the sensor
    scale: float  # of the log-odds, in (0, 1]: how well the scan's own labels bear them out
    shares: tuple[float, ...] = ()  # of the dictionary's models in this one

    def at(self, points: Float64) -> Float64:
        """(N,) log-odds at (N, 3) points, m, map frame."""
        about = points - self.origin
        return self.scale * self.model.at(self.ground.below(about), np.hypot(about[:, 0], about[:, 1]))

    @property
    def borrowed(self) -> tuple[Borrowed, ...]:
        """What of the dictionary it is made of, and where that was put."""
        below = self.origin + np.array([0.0, 0.0, self.ground.height_m])
        slope = (self.ground.slope_x, self.ground.slope_y)
        return tuple(
            Borrowed(f"heights-{number}", share, below, slope, self.scale)
            for number, share in enumerate(self.shares)
            if share >= _LEAST_SHARE
        )


class Expectation(NamedTuple):
    """What is expected around a scan, or why nothing is."""

    place: Expected | None
    reason: str | None  # one of NO_MODEL, PLANAR, NO_GROUND and NOVEL


def expect(
    models: HeightModels | None, beams: Beams, labelled: LabelledPoints, origin: Float64, *, planar: bool
) -> Expectation:
    """What the dictionary's models say about a scan's surroundings.

    Args:
        models: Of the dictionary; those count most that make the scan's own labels likely.
        beams: Relative to the sensor, with the map's axes.
        labelled: Points on them, map frame.
        origin: (3,) m, map frame: the sensor.
        planar: A 2D scan has no heights.
    """
    if models is None:
        return Expectation(None, NO_MODEL)
    if planar:
        return Expectation(None, PLANAR)
    hits = beams.ends[beams.is_return]
    if len(hits) < _LEAST_GROUND:
        return Expectation(None, NO_GROUND)
    ground = ground_of(hits)
    if (
        ground.n_near < _LEAST_GROUND
        or np.hypot(ground.slope_x, ground.slope_y) > _STEEPEST
        or not _EYE_M[0] <= -ground.height_m <= _EYE_M[1]
    ):
        return Expectation(None, NO_GROUND)
    judged = slice(None, None, -(-len(labelled.points) // _JUDGED))
    about = labelled.points[judged] - origin
    labels = HeightLabels(
        ground.below(about),
        np.hypot(about[:, 0], about[:, 1]),
        labelled.occupied[judged],
        beam_weights(labelled)[judged],
    )
    shares = models.shares(labels)
    model = models.mixed(shares)
    scale = _scale(model.at(labels.height_m, labels.range_m), labels.occupied, labels.weight)
    if scale < _LEAST_SCALE:
        return Expectation(None, NOVEL)
    place = Expected(model, ground, origin, min(scale, 1.0), tuple(shares.tolist()))
    return Expectation(place, None)


def _scale(log_odds: Float64, occupied: Bool, weight: Float64) -> float:
    """By how much log-odds are best multiplied to explain labels: 1 if these say nothing against it."""
    scale = 1.0
    for _ in range(8):
        p = 1.0 / (1.0 + np.exp(-scale * log_odds))
        slope = (weight * log_odds * (p - occupied)).sum() + _SURE_OF_MODEL * (scale - 1.0)
        curvature = (weight * np.square(log_odds) * p * (1.0 - p)).sum() + _SURE_OF_MODEL
        scale = float(np.clip(scale - slope / curvature, 0.0, 2.0))
    return scale


def lean_of_tiles(expected: Expected, tiles: list[TileIndex], grid: TileGrid) -> dict[TileIndex, Bytes]:
    """The leans of some tiles; those that lie far above or below the ground have none."""
    nodes, size = grid.lean_nodes, grid.size_m
    axes = [np.linspace(0.0, size, n) for n in nodes]
    local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    corners = np.array(list(itertools.product((0.0, size), repeat=3)))
    out = {}
    for index in tiles:
        start = np.asarray(index) * size
        heights = expected.ground.below(corners + start - expected.origin)
        if heights.min() < _REACH_M[1] and heights.max() > _REACH_M[0]:
            log_odds = expected.at(local + start)
            out[index] = to_bytes(log_odds).reshape(nodes)
    return out
