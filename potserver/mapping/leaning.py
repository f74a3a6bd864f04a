"""What the dictionary expects of a scan's surroundings: the lean of tiles that the map sees for the first time.

A tile takes its lean from the first scan that comes near, and keeps it: its kernels are solved for what evidence says beyond
the lean, so that another one would need them all solved again.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from potschemas.lean import Bytes, to_bytes
from potserver.domain.atom_file import Learned
from potserver.domain.tiles import TiledMap, TileGrid, TileIndex
from potserver.domain.types import Bool, Borrowed, Float64
from potserver.numerics.beams import Beams, LabelledPoints, beam_weights
from potserver.numerics.flag_grid import FlagGrid, may_be_around
from potserver.numerics.geometry import bounds
from potserver.numerics.ground import LEAST_GROUND, LOWEST_EYE_M, Ground, ground_of
from potserver.numerics.surroundings import Perceptron, Surroundings

_JUDGED_BY, _JUDGED = 1_000, 3_000  # beams that tell of labels of the others, labelled points; at most
_CLEARLY = 0.97  # of the first one's loss must another have
_CHOSEN_BY = 60  # beams that tell which of what is known fits: where much was seen, all do
_EYE_M = (LOWEST_EYE_M, 5.0)  # heights of a sensor above the ground that are expected
_STEEPEST = 0.3  # slope of a ground
_SURE_OF_MODEL = 5.0  # precision of the scale about 1
_LEAST_SCALE = 0.4  # with less of it, the model does not fit here
_REACH_M = (-1.5, 6.0)  # heights between which something is expected

EVERY = 8  # steps of half a log-odd: they travel, and kernels make up for what is rounded off
NO_MODEL, PLANAR, NO_GROUND, NOVEL = (
    "no_model",
    "planar",
    "no_ground",
    "novel",
)  # why a scan's tiles do not lean


class Expected(NamedTuple):
    """What is expected around one scan."""

    name: str  # of what in the dictionary expects it
    net: Perceptron
    view: Surroundings  # of the scan, about `origin`
    origin: Float64  # (3,) m, map frame: the sensor
    scale: float  # of the log-odds, in (0, 1]: how well they bear out what the scan itself tells

    def at(self, points: Float64) -> Float64:
        """(N,) log-odds at (N, 3) points, m, map frame."""
        return self.scale * self.view.expected(points - self.origin, self.net)

    @property
    def ground(self) -> Ground:
        """Of the scan, about `origin`."""
        return self.view.ground

    @property
    def borrowed(self) -> tuple[Borrowed, ...]:
        """What of the dictionary it is made of, and where that was put."""
        below = self.origin + np.array([0.0, 0.0, self.ground.height_m])
        return (Borrowed(self.name, 1.0, below, (self.ground.slope_x, self.ground.slope_y), self.scale),)


class Expectation(NamedTuple):
    """What is expected around a scan, or why nothing is."""

    place: Expected | None
    reason: str | None  # one of NO_MODEL, PLANAR, NO_GROUND and NOVEL


def expect(
    known: Sequence[Learned], beams: Beams, labelled: LabelledPoints, origin: Float64, *, planar: bool
) -> Expectation:
    """What the dictionary says about a scan's surroundings.

    Args:
        known: What may be expected; the one that foretells the scan best speaks.
        beams: Relative to the sensor, with the map's axes.
        labelled: Points on them, map frame: some tell whether what is expected from other beams is true here.
        origin: (3,) m, map frame: the sensor.
        planar: A 2D scan has no heights.
    """
    if not known:
        return Expectation(None, NO_MODEL)
    if planar:
        return Expectation(None, PLANAR)
    hits = beams.ends[beams.is_return]
    if len(hits) < LEAST_GROUND:
        return Expectation(None, NO_GROUND)
    ground = ground_of(hits)
    if (
        ground.n_near < LEAST_GROUND
        or np.hypot(ground.slope_x, ground.slope_y) > _STEEPEST
        or not _EYE_M[0] <= -ground.height_m <= _EYE_M[1]
    ):
        return Expectation(None, NO_GROUND)
    best = known[0]
    if len(known) > 1:
        trial = _Trial.by(_CHOSEN_BY, ground, beams, labelled, origin)
        losses = [trial.loss(learned.net) for learned in known]
        losses[0] *= _CLEARLY
        best = known[int(np.argmin(losses))]
    scale = _Trial.by(_JUDGED_BY, ground, beams, labelled, origin).scale(best.net)
    if scale < _LEAST_SCALE:
        return Expectation(None, NOVEL)
    view = Surroundings.of(beams, ground)
    return Expectation(Expected(best.name, best.net, view, origin, min(scale, 1.0)), None)


class _Trial(NamedTuple):
    """Some of a scan's labels, and what a few of its other beams show."""

    few: Surroundings
    points: Float64  # (N, 3) m, about the sensor
    occupied: Bool  # (N,)
    weight: Float64  # (N,)

    @staticmethod
    def by(
        most_beams: int, ground: Ground, beams: Beams, labelled: LabelledPoints, origin: Float64
    ) -> _Trial:
        """That of at most so many beams, and at most half of them."""
        n = len(beams.ends)
        tells = np.arange(n) % max(-(-n // most_beams), 2) == 0
        asked = np.flatnonzero(~tells[labelled.beam])
        asked = asked[:: max(-(-len(asked) // _JUDGED), 1)]
        weight = beam_weights(labelled)[asked]
        few = Surroundings.of(beams.take(tells), ground)
        return _Trial(few, labelled.points[asked] - origin, labelled.occupied[asked], weight)

    def scale(self, net: Perceptron) -> float:
        """By how much what the beams foretell is borne out: 1 if as well as it claims."""
        return _scale(self.few.expected(self.points, net), self.occupied, self.weight)

    def loss(self, net: Perceptron) -> float:
        """What the labels say against it, scaled so, nats."""
        log_odds = self.few.expected(self.points, net)
        log_odds *= min(_scale(log_odds, self.occupied, self.weight), 1.0)
        return float((self.weight * np.logaddexp(0.0, np.where(self.occupied, -log_odds, log_odds))).sum())


def _scale(log_odds: Float64, occupied: Bool, weight: Float64) -> float:
    """By how much log-odds are best multiplied to explain labels: 1 if these say nothing against it."""
    scale = 1.0
    for _ in range(8):
        p = 1.0 / (1.0 + np.exp(-scale * log_odds))
        slope = (weight * log_odds * (p - occupied)).sum() + _SURE_OF_MODEL * (scale - 1.0)
        curvature = (weight * np.square(log_odds) * p * (1.0 - p)).sum() + _SURE_OF_MODEL
        scale = float(np.clip(scale - slope / curvature, 0.0, 2.0))
    return scale


def tiles_to_lean(tiled: TiledMap, labelled: LabelledPoints, pad_m: float) -> list[TileIndex]:
    """The tiles about a scan that take a lean from it: those without, in new columns or in which it is the first to look.

    Args:
        tiled: The map without the scan.
        labelled: Of the scan, map frame.
        pad_m: So far beyond the points tiles count as about the scan.
    """
    points, size = labelled.points, tiled.grid.size_m
    reached = FlagGrid.of(np.floor(points / size).astype(np.int32))
    box = bounds(points)
    low, high = tiled.grid.index_of(box[0] - pad_m), tiled.grid.index_of(box[1] + pad_m)
    columns = itertools.product(*(range(a, b + 1) for a, b in zip(low[:2], high[:2], strict=True)))
    out = []
    for x, y in columns:
        column = [(x, y, z) for z in range(low[2], high[2] + 1)]
        is_known = any(index in tiled.tiles for index in column)
        bare = [i for i in column if i not in tiled.tiles]
        out += [i for i in bare if not is_known or may_be_around(reached, np.asarray(i), 0)]
    return out


def lean_of_tiles(expected: Expected, tiles: list[TileIndex], grid: TileGrid) -> dict[TileIndex, Bytes]:
    """The leans of some tiles; those that lie far above or below the ground have none.

    Nodes beyond the heights that are expected lean as the last ones within.
    """
    nodes, size = grid.lean_nodes, grid.size_m
    axes = [np.linspace(0.0, size, n) for n in nodes]
    corners = np.array(list(itertools.product((0.0, size), repeat=2)))
    out = {}
    for index in tiles:
        start = np.asarray(index) * size
        foot = np.column_stack([corners, np.zeros(4)]) + start
        above = expected.ground.below(foot - expected.origin)  # of the tile's lower corners
        first, last = np.searchsorted(axes[2], [_REACH_M[0] - above.max(), _REACH_M[1] - above.min()])
        if first == nodes[2] or last == 0:
            continue
        levels = axes[2][first:last]
        local = np.stack(np.meshgrid(*axes[:2], levels, indexing="ij"), axis=-1).reshape(-1, 3)
        told = to_bytes(expected.at(local + start), EVERY).reshape(*nodes[:2], -1)
        out[index] = np.pad(told, ((0, 0), (0, 0), (first, nodes[2] - last)), mode="edge")
    return out
