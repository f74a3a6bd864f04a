"""The grid of streets under a town, without end in any direction, and drives through it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Float64
from potclient.towns.styles import Style

Int64 = NDArray[np.int64]
Crossing = tuple[int, int]
_DIRECTIONS = ((1, 0), (0, 1), (-1, 0), (0, -1))  # east, north, west, south


class Street(NamedTuple):
    """One street of the grid, from kerb to kerb."""

    center_m: float  # x of a street that runs north, y of one that runs east
    width_m: float


def stream(*words: int) -> np.random.Generator:
    """The random numbers of one thing: named by integers, independent of all other things."""
    return np.random.default_rng([word & 0xFFFFFFFF for word in words])


class StreetGrid:
    """Streets that run north (axis 0, at some x) and east (axis 1, at some y), numbered from minus to plus infinity."""

    def __init__(self, style: Style, seed: int) -> None:
        self.style, self.seed = style, seed
        self._streets: dict[tuple[int, int], Street] = {}

    def street(self, axis: int, k: int) -> Street:
        """Street k of an axis."""
        found = self._streets.get((axis, k))
        if found is None:
            style = self.style
            rng = stream(self.seed, 1, axis, k)
            pitch = style.pitch_m[axis]
            shift = rng.uniform(-style.irregular, style.irregular)
            width = rng.uniform(*style.street_width_m)
            found = self._streets[axis, k] = Street(pitch * (k + shift), width)
        return found

    def cell(self, points: Float64) -> Int64:
        """(N, 2): the cells between the centre lines of streets in which points (N, 2) m lie."""
        cells = np.zeros((len(points), 2), np.int64)
        for axis in (0, 1) if len(points) else ():
            k = np.floor(points[:, axis] / self.style.pitch_m[axis]).astype(np.int64)
            # streets are less than half a pitch from their regular place
            low, high = int(k.min()) - 1, int(k.max()) + 2
            lines = np.array([self.street(axis, i).center_m for i in range(low, high + 1)])
            cells[:, axis] = low + np.searchsorted(lines, points[:, axis], side="right") - 1
        return cells

    def bounds(self, cell: Crossing) -> tuple[Float64, Float64]:
        """Lower and upper corner, (2,) m, of a cell."""
        lower = np.array([self.street(axis, cell[axis]).center_m for axis in (0, 1)])
        upper = np.array([self.street(axis, cell[axis] + 1).center_m for axis in (0, 1)])
        return lower, upper

    def crossing(self, at: Crossing) -> Float64:
        """(2,) m: the middle of the crossing of two streets."""
        return np.array([self.street(axis, at[axis]).center_m for axis in (0, 1)])

    def lane_m(self, axis: int, k: int) -> float:
        """How far right of the centre line one drives."""
        width = self.street(axis, k).width_m
        return self.style.lane_share * max(0.0, width - 2 * self.style.parking_m)


# --- drives ----------------------------------------------------------------------------------------------------------


class Drive:
    """A smooth way: straight lines joined by arcs, with the heading along it.

    Args:
        corners: (C, 2) m.
        radii_m: (C,) of the arc at each corner; the first and the last have none.
        length_m: The way ends here; the corners must reach that far.
    """

    def __init__(self, corners: Sequence[Float64], radii_m: Sequence[float], length_m: float) -> None:
        starts: list[tuple[float, float, float]] = []
        lengths: list[float] = []
        bends: list[float] = []  # 1/m, left turns positive
        here = corners[0]
        for k in range(1, len(corners)):
            ahead = corners[k] - here
            reach = float(np.hypot(*ahead))
            yaw = math.atan2(ahead[1], ahead[0])
            turn = cut = 0.0
            if k + 1 < len(corners):
                after = corners[k + 1] - corners[k]
                turn = math.remainder(math.atan2(after[1], after[0]) - yaw, 2 * math.pi)
                cut = radii_m[k] * math.tan(abs(turn) / 2)
            assert reach > cut, "corners too close for their arcs"
            starts.append((*here, yaw))
            lengths.append(reach - cut)
            bends.append(0.0)
            if abs(turn) > 1e-9:
                c, s = math.cos(yaw), math.sin(yaw)
                begin = corners[k] - cut * np.array([c, s])
                starts.append((*begin, yaw))
                lengths.append(radii_m[k] * abs(turn))
                bends.append(math.copysign(1 / radii_m[k], turn))
                here = corners[k] + cut * np.array([math.cos(yaw + turn), math.sin(yaw + turn)])
            else:
                here = corners[k]
        self._starts = np.array(starts)  # (P, 3) x m, y m, yaw rad
        self._bends = np.array(bends)
        self._begins = np.concatenate([[0.0], np.cumsum(lengths)])
        assert self._begins[-1] >= length_m, "a drive's corners end before it"
        self.length_m = length_m

    def at(self, distance_m: Float64) -> Float64:
        """(N, 3) x m, y m, yaw rad at distances (N,) m from the start."""
        s = np.asarray(distance_m, np.float64)
        piece = np.clip(np.searchsorted(self._begins, s, side="right") - 1, 0, len(self._bends) - 1)
        x, y, yaw = self._starts[piece].T
        along, bend = s - self._begins[piece], self._bends[piece]
        end = yaw + bend * along
        middle = (yaw + end) / 2
        chord = along * np.sinc(bend * along / (2 * math.pi))
        return np.stack([x + chord * np.cos(middle), y + chord * np.sin(middle), end], axis=1)


Detour = Callable[[Crossing, int], list[tuple[Float64, float]]]


def plan_drive(
    grid: StreetGrid, length_m: float, detour: Detour | None = None
) -> tuple[Drive, list[tuple[Crossing, int]]]:
    """A drive from crossing to crossing that prefers streets it has not seen, on the right-hand lane.

    Args:
        grid: The streets.
        length_m: Of the drive.
        detour: Extra corners and radii along an edge (crossing, direction), e.g. into rooms.

    Returns:
        The drive, and its edges in order: where each begins and its direction (0 east, 1 north, 2 west, 3 south).
    """
    style, rng = grid.style, stream(grid.seed, 2)
    at, heading = (0, 0), int(rng.integers(4))
    visits: dict[tuple[Crossing, int], int] = {}
    edges: list[tuple[Crossing, int]] = []
    travelled, last_turn = 0.0, 0
    while travelled < length_m + 2 * max(style.pitch_m):
        options = []
        for turn, liking in ((0, 1.0), (1, style.turning), (-1, style.turning)):
            direction = (heading + turn) % 4
            if turn and turn == last_turn:
                liking *= 0.6  # not round and round the same block
            options.append((visits.get(_edge(at, direction), 0), -liking * rng.uniform(0.2, 1.0), turn))
        turn = min(options)[2]
        last_turn, heading = turn or last_turn, (heading + turn) % 4
        visits[_edge(at, heading)] = visits.get(_edge(at, heading), 0) + 1
        edges.append((at, heading))
        step = _DIRECTIONS[heading]
        after = (at[0] + step[0], at[1] + step[1])
        travelled += float(np.abs(grid.crossing(after) - grid.crossing(at)).sum())
        at = after
    start = _lane_point(grid, *edges[0])
    unit = np.array(_DIRECTIONS[edges[0][1]], np.float64)
    corners = [start + 0.5 * (grid.crossing(_after(edges[0])) - grid.crossing(edges[0][0])) @ unit * unit]
    radii = [0.0]
    for k, (edge, following) in enumerate(itertools.pairwise(edges)):
        if detour is not None and k > 0:
            for corner, radius in detour(*edge):
                corners.append(corner)
                radii.append(radius)
        if following[1] != edge[1]:
            crossing = following[0]
            corners.append(_turn_point(grid, crossing, edge[1], following[1]))
            left = (following[1] - edge[1]) % 4 == 1
            radii.append(style.turn_left_m if left else style.turn_right_m)
    corners.append(_lane_point(grid, _after(edges[-1]), edges[-1][1]))
    radii.append(0.0)
    return Drive(corners, radii, length_m), edges


def _edge(at: Crossing, direction: int) -> tuple[Crossing, int]:
    """The same name for an edge from either end."""
    step = _DIRECTIONS[direction]
    return (at, direction) if direction < 2 else ((at[0] + step[0], at[1] + step[1]), direction - 2)


def _after(edge: tuple[Crossing, int]) -> Crossing:
    (i, j), step = edge[0], _DIRECTIONS[edge[1]]
    return i + step[0], j + step[1]


def _lane_point(grid: StreetGrid, at: Crossing, direction: int) -> Float64:
    """The crossing, moved into the lane of a direction of travel."""
    dx, dy = _DIRECTIONS[direction]
    axis = 1 if dx else 0  # the street that runs this way
    return grid.crossing(at) + grid.lane_m(axis, at[axis]) * np.array([dy, -dx])


def _turn_point(grid: StreetGrid, at: Crossing, before: int, after: int) -> Float64:
    """Where the lane that comes in meets the lane that goes out."""
    a, b = _lane_point(grid, at, before), _lane_point(grid, at, after)
    return np.array([a[0], b[1]]) if before % 2 else np.array([b[0], a[1]])
