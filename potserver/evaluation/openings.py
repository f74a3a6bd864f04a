"""What a map leaves of doorways, and keeps of poles and wires, of known size: the gauntlet."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.towns import GauntletRecording
from potclient.towns.gauntlet import OPENINGS, POLES, WIRE_HALF_M, WIRES
from potserver.evaluation.mappers import Mapper
from potserver.evaluation.neighbours import within

_STEP_M = 0.01  # across openings and poles
_ASIDE_M = 0.75  # from the middle of an opening or pole, to either side
_THROUGH_M = np.arange(-0.15, 0.151, 0.05)  # through the wall: an opening is as free as its least free place
_HEIGHTS_M = np.array([0.3, 0.6, 0.9, 1.2, 1.5])
_POLE_HEIGHTS_M = np.arange(0.2, 2.2, 0.05)
_WIRE_STEP_M = 0.05
_NEAR_AXIS_M = 0.07  # a hit so far from the axis of a thin thing, its radius apart, is one of it


class OpeningWidth(NamedTuple):
    """What is left of the openings of one width in one wall. Unknown is not free."""

    away_m: float  # of the wall from the way
    width_m: float
    free_m: float  # mean width where p < 0.5
    safe_m: float  # mean width where p < 0.2
    least_free_m: float


class ThinKept(NamedTuple):
    """How much of the axes of thin things of one diameter the map calls occupied. NaN where there is nothing to count."""

    away_m: float  # from the way
    diameter_m: float
    kept: float  # share of the axes
    kept_of_hit: float  # share of the parts that a beam hit
    width_m: float  # mean width where p >= 0.5, of poles


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class OpeningScores:
    """How one map did."""

    openings: list[OpeningWidth]
    poles: list[ThinKept]
    wires: list[ThinKept]  # none in a slice

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            field.name: [found._asdict() for found in getattr(self, field.name)]
            for field in dataclasses.fields(self)
        }


class OpeningQuestions:
    """The points, the same for every map.

    Args:
        place: The gauntlet; its slice if it is planar.
        hits: (N, 3) m, of all scans.
    """

    def __init__(self, place: GauntletRecording, hits: Float64) -> None:
        self._planar = place.slice_m is not None
        self._hits = hits

    def score(self, mapper: Mapper) -> OpeningScores:
        """How a map does."""
        doors = dict.fromkeys((opening.away_m, opening.width_m) for opening in OPENINGS)
        posts = dict.fromkeys((abs(pole.y_m), pole.diameter_m) for pole in POLES)
        return OpeningScores(
            openings=[self._widths(mapper, away_m, width_m) for away_m, width_m in doors],
            poles=[self._poles(mapper, away_m, diameter_m) for away_m, diameter_m in posts],
            wires=[] if self._planar else [self._wire(mapper, *wire) for wire in WIRES],
        )

    def _widths(self, mapper: Mapper, away_m: float, width_m: float) -> OpeningWidth:
        free: list[float] = []
        safe: list[float] = []
        across = _across()
        heights = np.zeros(1) if self._planar else _HEIGHTS_M
        for x_m, y_m, width, away in OPENINGS:
            if (width, away) != (width_m, away_m):
                continue
            points = _lattice(x_m + across, y_m + _THROUGH_M, heights)
            answer = mapper.ask(points.reshape(-1, 3))
            p = np.where(answer.observed, answer.mean, 1.0).reshape(points.shape[:3]).max(axis=1)
            free += _run_widths(p < 0.5)
            safe += _run_widths(p < 0.2)
        return OpeningWidth(away_m, width_m, float(np.mean(free)), float(np.mean(safe)), min(free))

    def _poles(self, mapper: Mapper, away_m: float, diameter_m: float) -> ThinKept:
        heights = np.zeros(1) if self._planar else _POLE_HEIGHTS_M
        poles = [p for p in POLES if (abs(p.y_m), p.diameter_m) == (away_m, diameter_m)]
        axes = np.concatenate([_lattice(np.array([p.x_m]), [p.y_m], heights).reshape(-1, 3) for p in poles])
        widths: list[float] = []
        for x_m, y_m, _ in poles:
            points = _lattice(x_m + _across(), [y_m], heights[::4])
            answer = mapper.ask(points.reshape(-1, 3))
            over = (answer.observed & (answer.mean >= 0.5)).reshape(len(points), -1)
            widths += [width for width in _run_widths(over) if width > 0]
        kept, kept_of_hit = self._kept(mapper, axes, diameter_m)
        width_m = float(np.mean(widths)) if widths else float("nan")
        return ThinKept(away_m, diameter_m, kept, kept_of_hit, width_m)

    def _wire(self, mapper: Mapper, y_m: float, z_m: float, diameter_m: float) -> ThinKept:
        x = np.arange(-WIRE_HALF_M + 0.5, WIRE_HALF_M - 0.5, _WIRE_STEP_M)
        axis = _lattice(x, [y_m], [z_m]).reshape(-1, 3)
        return ThinKept(y_m, diameter_m, *self._kept(mapper, axis, diameter_m), float("nan"))

    def _kept(self, mapper: Mapper, axis: Float64, diameter_m: float) -> tuple[float, float]:
        answer = mapper.ask(axis)
        kept = answer.observed & (answer.mean >= 0.5)
        hit = within(self._hits, axis, diameter_m / 2 + _NEAR_AXIS_M)
        return float(kept.mean()), float(kept[hit].mean()) if hit.any() else float("nan")


def _across() -> Float64:
    return np.arange(-_ASIDE_M, _ASIDE_M + _STEP_M / 2, _STEP_M)


def _lattice(x: Float64, y: Sequence[float] | Float64, z: Sequence[float] | Float64) -> Float64:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1)


def _run_widths(chosen: Bool) -> list[float]:
    """m: of each column (N, C), the unbroken run of chosen places about the middle one."""
    middle = len(chosen) // 2
    widths = []
    for column in chosen.T:
        ends = [np.append(~part, True).argmax() for part in (column[: middle + 1][::-1], column[middle:])]
        widths.append(_STEP_M * max(int(sum(ends)) - 1, 0))
    return widths
