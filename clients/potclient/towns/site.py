"""A cell of the street grid while it is being built: its kerb, its sides, and what already stands there."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from potclient.arrays import Float64
from potclient.towns.solids import Kind, Part, placed, slab
from potclient.towns.streets import Crossing, StreetGrid, stream
from potclient.towns.styles import Style
from potclient.towns.things import Mover, vehicle

SOUTH, EAST, NORTH, WEST = range(4)
Name = tuple[Crossing, int]  # of a parked car: its cell, and which it is there


@dataclasses.dataclass(frozen=True, slots=True)
class Parked:
    """A car at the kerb; `leaves` marks those that drive off in a dynamic town."""

    x_m: float
    y_m: float
    yaw_rad: float
    mover: Mover
    leaves: bool

    def parts(self) -> list[Part]:
        """Where it stands."""
        return placed(self.mover.parts, self.x_m, self.y_m, self.yaw_rad)


@dataclasses.dataclass(frozen=True, slots=True)
class Door:
    """An open door of a room, with room behind it to drive in, turn and come out."""

    side: int
    at: Float64  # (2,) m, middle of the doorway
    inward: Float64  # (2,) unit vector
    aside: Float64  # (2,) unit vector, to the free side of the room


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One cell, built."""

    parts: tuple[Part, ...]  # without the parked cars
    parked: tuple[Parked, ...]
    doors: tuple[Door, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """A side of a block: x along it with the kerb's traffic, y inward, from a corner; mirrored, which solids do not mind."""

    origin: Float64  # (2,) m
    along: Float64  # (2,)
    inward: Float64  # (2,)
    length_m: float

    def put(
        self, parts: Sequence[Part], x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0
    ) -> list[Part]:
        """Parts placed in this frame, in the map."""
        if x_m or y_m or yaw_rad:
            parts = placed(parts, x_m, y_m, yaw_rad)
        return [(shape, vertices @ self._turn + self._shift, kind) for shape, vertices, kind in parts]

    @cached_property
    def _turn(self) -> Float64:
        turn = np.zeros((3, 3))
        turn[0, :2], turn[1, :2], turn[2, 2] = self.along, self.inward, 1.0
        return turn

    @cached_property
    def _shift(self) -> Float64:
        return np.array([*self.origin, 0.0])

    def point(self, x_m: float, y_m: float) -> Float64:
        """(2,) m, map."""
        return np.asarray(self.origin + x_m * self.along + y_m * self.inward)

    def inner(self, margin_m: float) -> Frame:
        """The same side of the block shrunk by a margin."""
        return Frame(self.point(margin_m, margin_m), self.along, self.inward, self.length_m - 2 * margin_m)


class Site:
    """A cell while it is being built."""

    def __init__(self, grid: StreetGrid, cell: Crossing) -> None:
        self.style: Style = grid.style
        self.rng = stream(grid.seed, 3, *cell)
        lower, upper = grid.bounds(cell)
        half = [[grid.street(axis, cell[axis] + end).width_m / 2 for axis in (0, 1)] for end in (0, 1)]
        self.lower, self.upper = lower + half[0], upper - half[1]  # of the block, at the kerb
        self.parts: list[Part] = []
        self.parked: list[Parked] = []
        self.doors: list[Door] = []
        (x0, y0), (x1, y1) = self.lower, self.upper
        wide, deep = x1 - x0, y1 - y0
        east, north = np.array([1.0, 0.0]), np.array([0.0, 1.0])
        self.sides = (
            Frame(np.array([x1, y0]), -east, north, wide),
            Frame(np.array([x1, y1]), -north, -east, deep),
            Frame(np.array([x0, y1]), east, -north, wide),
            Frame(np.array([x0, y0]), north, east, deep),
        )

    def pavement(self) -> None:
        """The raised slab under the block."""
        style = self.style
        self.parts.append(
            slab((*self.lower, -0.5), (*self.upper, style.kerb_m), style.corner_m, Kind.PAVEMENT)
        )

    def park(self, side: Frame, share: float, van_share: float = 0.1) -> None:
        """Cars along a kerb."""
        x = 7.0
        while x < side.length_m - 10.0:
            if self.rng.random() < share:
                car = vehicle(self.rng, van_share)
                jitter = self.rng.normal(0.0, 0.03)
                turned = self.rng.random() < 0.15
                yaw = self.rng.normal(0.0, 0.015) + math.pi * turned
                place = side.point(x + car.length_m / 2, -0.08 - car.width_m / 2 - abs(jitter))
                heading = math.atan2(side.along[1], side.along[0]) + yaw
                leaves = not turned and self.rng.random() < self.style.leaving
                self.parked.append(Parked(float(place[0]), float(place[1]), heading, car, leaves))
                x += car.length_m + (8.0 if leaves else self.rng.uniform(0.5, 1.4))
            else:
                x += self.rng.uniform(3.0, 6.5)

    def along(self, side: Frame, pitch_m: float, inset_m: float, make: Callable[[], list[Part]]) -> None:
        """The same thing again and again along a side, clear of its corners."""
        n = int((side.length_m - 12.0) / pitch_m)
        for k in range(n):
            x = 6.0 + (side.length_m - 12.0) * (k + 0.5) / n + self.rng.normal(0.0, 0.3)
            self.parts += side.put(make(), x, inset_m)

    def build(self) -> Block:
        """The finished block."""
        return Block(tuple(self.parts), tuple(self.parked), tuple(self.doors))
