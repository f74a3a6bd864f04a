"""A town: everything solid in it, at any time, and one drive through it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from potclient.arguments import as_points
from potclient.arrays import Bool, Float64
from potclient.errors import DatasetError
from potclient.poses import yaw_pose
from potclient.towns.blocks import build_block
from potclient.towns.site import EAST, NORTH, SOUTH, WEST, Block, Door, Name, Parked
from potclient.towns.solids import Int64, Part, SolidSet
from potclient.towns.streets import Crossing, StreetGrid, plan_drive, stream
from potclient.towns.styles import style_named
from potclient.towns.traffic import Traffic, plan_traffic

_KEPT_BLOCKS = 64  # as parts
_KEPT_SOLIDS = 250_000  # in blocks that are ready to be asked: some 300 MB
_GROUND_Z_M = 0.0
_SWAY_RAD = 0.005  # of a car on its springs


class Town:
    """Same style, seed and length: the same town, drive and traffic, bit for bit.

    The streets have no end; blocks are built when they are looked at, each from random numbers of its own.

    Args:
        style: One of `STYLES`.
        seed: Chooses everything else.
        length_m: Of the drive.
        dynamic: Cars (in `offices`: people) move, and some parked cars leave; all within about 110 m of the drive.
        slice_m: Makes it a 2D town: the slice at this height; z is ignored in questions.
    Raises:
        DatasetError: no such style, or a length that is not positive.
    """

    def __init__(
        self,
        style: str,
        seed: int = 0,
        *,
        length_m: float = 1000.0,
        dynamic: bool = False,
        slice_m: float | None = None,
    ) -> None:
        if not 0 < length_m <= 1e6:
            raise DatasetError(f"town: a drive of {length_m:g} m; need more than 0 and at most 1000 km")
        self.style, self.seed, self.dynamic, self.slice_m = style_named(style), seed, dynamic, slice_m
        self.grid = StreetGrid(self.style, seed)
        self._blocks: dict[Crossing, Block] = {}
        self._solids: dict[Crossing, SolidSet] = {}
        self._n_kept = 0  # solids in `_solids`
        self._leaving: set[Name] = set()
        indoors = self.style.ceiling_m is not None
        self.drive, self._edges = plan_drive(self.grid, length_m, self._visit_rooms if indoors else None)
        self.traffic = Traffic(self.style)
        if dynamic:
            self.traffic, self._leaving = plan_traffic(self.grid, self.drive, self._may_leave())
        self._sway = stream(seed, 7).uniform(0.0, 2 * math.pi, (2, 3))

    # --- where the sensor is -----------------------------------------------------------------------------------------

    @property
    def duration_s(self) -> float:
        """How long the drive takes."""
        return self.drive.length_m / self.style.speed_m_s

    def pose(self, time_s: float) -> Float64:
        """(4, 4) T_map_sensor on the drive; in a 2D town z is 0, else the road is z = 0 and the vehicle sways a little."""
        distance = self.style.speed_m_s * time_s
        x, y, yaw = self.drive.at(np.array([distance]))[0]
        pose = yaw_pose(x, y, yaw)
        if self.slice_m is not None:
            return pose
        pose[2, 3] = self.style.sensor_m
        if self.style.ceiling_m is None:
            waves = np.sin(self._sway + distance / np.array([3.1, 7.3, 17.0]))
            roll, pitch = _SWAY_RAD * waves.mean(axis=1)
            cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
            nod = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
            lean = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
            pose[:3, :3] = pose[:3, :3] @ nod @ lean
        return pose

    # --- what is solid -----------------------------------------------------------------------------------------------

    def occupied(self, points: ArrayLike, time_s: float = 0.0) -> Bool:
        """(N,) the exact truth at points (N, 3) or (N, 2), m, map frame: in a solid, under the ground or above a ceiling.

        In a 2D town the answer holds at the scanner's height, whatever z is.

        Raises:
            DatasetError: (N, 2) points in a 3D town.
        """
        given = np.asarray(points)
        if self.slice_m is None and given.ndim == 2 and given.shape[1] == 2:
            raise DatasetError("town: a 3D town needs points of shape (N, 3)")
        p = np.array(as_points(given), np.float64)
        if self.slice_m is not None:
            p[:, 2] = self.slice_m
        found = p[:, 2] < _GROUND_Z_M
        if self.style.ceiling_m is not None:
            found |= p[:, 2] > self.style.ceiling_m
        if not len(p):
            return found
        cells = self.grid.cell(p[:, :2])
        for cell, rows in _groups(cells):
            found[rows] |= self.solids(cell).contains(p[rows])
        moving = SolidSet(self.traffic.parts(time_s, p[:, :2].min(axis=0), p[:, :2].max(axis=0)))
        return found | moving.contains(p)

    def block(self, cell: Crossing) -> Block:
        """A block of the town."""
        if cell not in self._blocks:
            while len(self._blocks) >= _KEPT_BLOCKS:
                del self._blocks[next(iter(self._blocks))]  # the oldest
            self._blocks[cell] = build_block(self.grid, cell)
        return self._blocks[cell]

    def solids(self, cell: Crossing) -> SolidSet:
        """What never moves in a cell."""
        if cell not in self._solids:
            block = self.block(cell)
            staying = [c for k, c in enumerate(block.parked) if (cell, k) not in self._leaving]
            solids = SolidSet([*block.parts, *(part for car in staying for part in car.parts())])
            self._n_kept += len(solids)
            while self._n_kept > _KEPT_SOLIDS and self._solids:
                self._n_kept -= len(self._solids.pop(next(iter(self._solids))))
            self._solids[cell] = solids
        return self._solids[cell]

    def moving(self, time_s: float, lower: Float64, upper: Float64) -> list[Part]:
        """What moves, near a box (2,), (2,) m."""
        return self.traffic.parts(time_s, lower, upper)

    def cells(self, lower: Float64, upper: Float64) -> list[Crossing]:
        """The cells that touch a box (2,), (2,) m."""
        (i0, j0), (i1, j1) = self.grid.cell(np.stack([lower, upper]))
        return [(i, j) for i in range(int(i0), int(i1) + 1) for j in range(int(j0), int(j1) + 1)]

    # --- along the drive ---------------------------------------------------------------------------------------------

    def _may_leave(self) -> list[tuple[Name, Parked]]:
        cells = dict.fromkeys(cell for edge in self._edges for cell, _ in _beside(*edge))
        return [
            ((cell, k), car) for cell in cells for k, car in enumerate(self.block(cell).parked) if car.leaves
        ]

    def _visit_rooms(self, at: Crossing, direction: int) -> list[tuple[Float64, float]]:
        """Corners and radii of detours through doors along a corridor: in, a loop to the free side, and out."""
        rng = stream(self.seed, 8, *at, direction)
        unit = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)][direction], np.float64)
        begin, end = self.grid.crossing(at), self.grid.crossing((at[0] + int(unit[0]), at[1] + int(unit[1])))
        doors = [
            door
            for cell, side in _beside(at, direction)
            for door in self.block(cell).doors
            if door.side == side
        ]
        doors.sort(key=lambda door: float(door.at @ unit))
        corners: list[tuple[Float64, float]] = []
        last = float(begin @ unit) + 1.6
        for door in doors:
            where = float(door.at @ unit)
            if where - last < 2.0 or float(end @ unit) - where < 3.6 or rng.random() < 0.25:
                continue
            corners += _loop(door, begin)
            last = where
        return corners


def _loop(door: Door, corridor: Float64) -> list[tuple[Float64, float]]:
    inward, aside = door.inward, door.aside
    middle = door.at + ((corridor - door.at) @ inward) * inward
    deep, near = door.at + 2.6 * inward, door.at + 1.1 * inward
    return [
        (middle, 0.7),
        (deep, 0.45),
        (deep + 1.05 * aside, 0.45),
        (near + 1.05 * aside, 0.45),
        (near, 0.45),
        (middle, 0.7),
    ]


def _beside(at: Crossing, direction: int) -> list[tuple[Crossing, int]]:
    """The two cells along an edge, each with its side that faces the edge."""
    i, j = at
    if direction >= 2:  # named from its other end
        i, j = (i - 1, j) if direction == 2 else (i, j - 1)
    if direction % 2 == 0:
        return [((i, j), SOUTH), ((i, j - 1), NORTH)]
    return [((i, j), WEST), ((i - 1, j), EAST)]


def _groups(cells: Int64) -> list[tuple[Crossing, Int64]]:
    """The distinct rows of (N, 2), each with its places."""
    order = np.lexsort(cells.T)
    changes = np.flatnonzero((np.diff(cells[order], axis=0) != 0).any(axis=1)) + 1
    return [((int(cells[rows[0], 0]), int(cells[rows[0], 1])), rows) for rows in np.split(order, changes)]
