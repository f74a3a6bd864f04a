"""What stands in one cell of the street grid; each cell has random numbers of its own, so any of them can be built alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np

from potclient.results import Float64
from potclient.towns.solids import Kind, Part, blob, box, placed, post, roof, slab
from potclient.towns.streets import Crossing, StreetGrid, stream
from potclient.towns.styles import Style
from potclient.towns.things import (
    Mover,
    bench,
    bush,
    chair,
    conifer,
    cupboard,
    desk,
    lamp,
    sign,
    signal,
    tree,
    vehicle,
)

SOUTH, EAST, NORTH, WEST = range(4)
_WALL_M = 0.14  # indoors
_DOOR_M = 0.95
Area = tuple[float, float, float, float]  # lower x, y, upper x, y in a frame, m
Name = tuple[Crossing, int]  # of a parked car: its cell, and which it is there
Openings = dict[int, list[tuple[float, float]]]  # doorways along each side, m


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


def build_block(grid: StreetGrid, cell: Crossing) -> Block:
    """The block of a cell in the town's style."""
    site = Site(grid, cell)
    if site.style.kerb_m > 0:
        site.pavement()
    _BUILDERS[site.style.name](site)
    return site.build()


# --- terraces --------------------------------------------------------------------------------------------------------


def _terraces(site: Site) -> None:
    rng = site.rng
    pavement = rng.uniform(1.6, 2.0)
    for side in site.sides:
        site.park(side, 0.78)
        site.along(side, 26.0, 0.45, lambda: lamp(0.0, 0.0, 5.0))
        if rng.random() < 0.6:
            site.parts += side.put(sign(0.0, 0.0, rng), rng.uniform(5.0, 9.0), 0.4)
        if rng.random() < 0.25:
            site.along(side, 16.0, 0.9, lambda: _street_tree(rng, 5.0, 6.5, 1.5, 2.0))
    if rng.random() < 0.08:
        _park(site, pavement)
        return
    long_first = (EAST, WEST) if site.sides[EAST].length_m > site.sides[SOUTH].length_m else (SOUTH, NORTH)
    deep = {}
    for k in long_first:
        deep[k] = _terrace(site, site.sides[k].inner(pavement), 0.0)
    taken = max(deep.values())
    for k in range(4):
        if k not in long_first:
            side = site.sides[k].inner(pavement)
            if rng.random() < 0.5:
                _terrace(site, side, taken + 1.0)
            else:  # the ends of the gardens
                _wall(site, side, taken, side.length_m - taken, 0.0, rng.uniform(1.7, 2.1), 0.22)


def _terrace(site: Site, side: Frame, margin_m: float) -> float:
    """A row of houses along a side; the result is how deep it reaches, front garden included."""
    rng = site.rng
    setback = float(rng.choice((0.0, 0.0, rng.uniform(1.2, 3.0))))
    depth, eaves, width = rng.uniform(8.0, 10.0), rng.uniform(5.2, 8.0), rng.uniform(4.8, 6.8)
    rise = rng.uniform(2.2, 3.4)
    x, end = margin_m, side.length_m - margin_m
    mirrored = False
    while end - x > 0.7 * width:
        wide = width if end - x > 1.7 * width else end - x
        if rng.random() < 0.05 and margin_m < x < end - 2 * width:  # an alley to the back
            x += 1.3
            continue
        front = setback + rng.normal(0.0, 0.06)
        _row_house(
            site,
            side,
            x,
            x + wide,
            front,
            front + depth,
            eaves + rng.normal(0.0, 0.12),
            rise,
            mirrored,
            setback,
        )
        x += wide
        mirrored = not mirrored
    return setback + depth


def _row_house(
    site: Site,
    side: Frame,
    x0: float,
    x1: float,
    y0: float,
    y1: float,
    eaves: float,
    rise: float,
    mirrored: bool,
    setback: float,
) -> None:
    rng = site.rng
    parts = [
        box((x0, y0, 0.0), (x1, y1, eaves), Kind.BUILDING),
        roof((x0, y0 - 0.3, eaves), (x1, y1 + 0.3, eaves + rise)),
    ]
    middle, wide = (x0 + x1) / 2, x1 - x0
    if rng.random() < 0.8:
        c = x0 if mirrored else x1
        c0, c1 = (c, c + 0.9) if mirrored else (c - 0.9, c)
        parts.append(
            box((c0, (y0 + y1) / 2 - 0.5, eaves), (c1, (y0 + y1) / 2 + 0.5, eaves + rise + 1.1), Kind.ROOF)
        )
    door = x1 - 1.1 if mirrored else x0 + 1.1
    parts.append(box((door - 0.55, y0 - 0.45, 0.0), (door + 0.55, y0 + 0.2, 0.30), Kind.BUILDING))  # a step
    if rng.random() < 0.35:  # a canopy over the door
        parts.append(box((door - 0.7, y0 - 0.6, 2.35), (door + 0.7, y0 + 0.1, 2.5), Kind.BUILDING))
    if setback > 1.0 and rng.random() < 0.6:  # a bay window
        b = middle + (-0.12 if mirrored else 0.12) * wide
        parts.append(box((b - 1.0, y0 - 0.7, 0.0), (b + 1.0, y0 + 0.1, 2.7), Kind.BUILDING))
    if rng.random() < 0.7:  # the kitchen at the back
        k0, k1 = (x0, x0 + 0.55 * wide) if mirrored else (x1 - 0.55 * wide, x1)
        parts.append(box((k0, y1, 0.0), (k1, y1 + rng.uniform(2.0, 4.0), 3.0), Kind.BUILDING))
    parts.append(box((x0 - 0.1, y1, 0.0), (x0 + 0.1, y1 + 7.0, 1.7), Kind.WALL))  # between back gardens
    if setback > 1.0:
        high = rng.uniform(0.6, 1.1)
        for w0, w1 in ((x0, door - 0.5), (door + 0.5, x1)):
            if w1 - w0 > 0.2:
                parts.append(box((w0, 0.0, 0.0), (w1, 0.2, high), Kind.WALL))
        parts.append(box((x0 - 0.1, 0.0, 0.0), (x0 + 0.1, y0, high), Kind.WALL))
    site.parts += side.put(parts)
    if setback > 1.0 and rng.random() < 0.3:
        site.parts += side.put(bush(rng, 0.0, 0.0), middle, 0.8)
    if rng.random() < 0.3:  # a bin on the pavement
        site.parts += side.put(
            [box((-0.29, -0.35, 0.0), (0.29, 0.35, 1.05), Kind.FURNITURE)],
            rng.uniform(x0 + 0.4, x1 - 0.4),
            -0.45,
        )
    if rng.random() < 0.25:
        site.parts += side.put(
            tree(rng, 0.0, 0.0, height_m=rng.uniform(4, 7), crown_m=rng.uniform(1.4, 2.2)), middle, y1 + 6.0
        )


def _wall(site: Site, side: Frame, x0: float, x1: float, y: float, high: float, thick: float) -> None:
    """A wall along a side, with a gap here and there."""
    x = x0
    while x < x1 - 1.0:
        end = min(x1, x + site.rng.uniform(6.0, 14.0))
        site.parts += side.put([box((x, y, 0.0), (end, y + thick, high), Kind.WALL)])
        x = end + (site.rng.uniform(1.0, 3.0) if site.rng.random() < 0.4 else 0.0)


def _street_tree(rng: np.random.Generator, low: float, high: float, thin: float, wide: float) -> list[Part]:
    return tree(rng, 0.0, 0.0, height_m=rng.uniform(low, high), crown_m=rng.uniform(thin, wide))


def _park(site: Site, margin_m: float) -> None:
    """Trees, benches and bushes behind a low wall."""
    rng = site.rng
    for side in site.sides:
        inner = side.inner(margin_m)
        _wall(site, inner, 0.0, inner.length_m, 0.0, 0.6, 0.3)
    lower, upper = site.lower + margin_m + 3.0, site.upper - margin_m - 3.0
    area = float((upper - lower).prod())
    for _ in range(int(area / 90.0)):
        x, y = rng.uniform(lower, upper)
        site.parts += placed(_street_tree(rng, 6.0, 11.0, 2.0, 3.2), x, y, 0.0)
    for _ in range(int(area / 200.0)):
        x, y = rng.uniform(lower, upper)
        site.parts += placed(bench(), x, y, rng.uniform(0, 2 * math.pi))
        x, y = rng.uniform(lower, upper)
        site.parts += placed(bush(rng, 0.0, 0.0), x, y, 0.0)


# --- suburb ----------------------------------------------------------------------------------------------------------


def _suburb(site: Site) -> None:
    rng = site.rng
    verge = rng.uniform(2.0, 3.2)
    for side in site.sides:
        site.park(side, 0.10)
        site.along(side, 34.0, 0.6, lambda: lamp(0.0, 0.0, 6.0))
        if rng.random() < 0.5:
            site.along(side, rng.uniform(12.0, 20.0), 1.2, lambda: _street_tree(rng, 5.0, 8.0, 1.8, 2.8))
    if rng.random() < 0.08:
        _park(site, verge)
        return
    lot_depth = min(28.0, 0.46 * float((site.upper - site.lower).min()))
    long_first = (EAST, WEST) if site.sides[EAST].length_m > site.sides[SOUTH].length_m else (SOUTH, NORTH)
    for k in range(4):
        side = site.sides[k].inner(verge)
        first = 0.0 if k in long_first else lot_depth
        room = side.length_m - 2 * first
        n = max(1, int(room / rng.uniform(16.0, 23.0))) if room > 13.0 else 0
        for m in range(n):
            _lot(site, side, first + room * m / n, first + room * (m + 1) / n, lot_depth)


def _lot(site: Site, side: Frame, x0: float, x1: float, depth: float) -> None:
    rng = site.rng
    room = x1 - x0
    wide, deep = min(rng.uniform(8.5, 12.5), room - 4.5), rng.uniform(7.5, 10.5)
    setback = rng.uniform(5.0, 8.0)
    x, y = x0 + room / 2 + rng.uniform(-0.8, 0.8), setback + deep / 2
    yaw = rng.normal(0.0, 0.06)
    eaves, rise = float(rng.choice((2.8, 3.2, 5.4))), rng.uniform(1.8, 2.8)
    hip = float(rng.choice((0.0, deep / 2 - 0.5)))
    ridge = rng.random() < 0.65
    w, d = (wide / 2, deep / 2) if ridge else (deep / 2, wide / 2)
    house = [
        box((-w, -d, 0.0), (w, d, eaves), Kind.BUILDING),
        roof((-w - 0.4, -d - 0.4, eaves), (w + 0.4, d + 0.4, eaves + rise), hip_m=min(hip, w - 0.5)),
        box((0.2 * w, -0.4, eaves), (0.2 * w + 0.7, 0.4, eaves + rise + 0.7), Kind.ROOF),
    ]
    site.parts += side.put(house, x, y, yaw if ridge else yaw + math.pi / 2)
    right = bool(rng.random() < 0.5)
    drive = x1 - 2.1 if right else x0 + 2.1
    if rng.random() < 0.5:  # a porch
        p = x + rng.uniform(-1.5, 1.5)
        site.parts += side.put(
            [
                box((p - 1.3, setback - 1.5, 0.0), (p + 1.3, setback + 0.3, 0.3), Kind.BUILDING),
                box((p - 1.4, setback - 1.6, 2.4), (p + 1.4, setback + 0.3, 2.6), Kind.BUILDING),
                post(p - 1.2, setback - 1.4, 0.0, 2.4, 0.08, Kind.BUILDING),
                post(p + 1.2, setback - 1.4, 0.0, 2.4, 0.08, Kind.BUILDING),
            ]
        )
    if rng.random() < 0.6:  # a garage beside the house
        g0, g1 = setback + 2.0, setback + 7.5
        site.parts += side.put(
            [
                box((drive - 1.7, g0, 0.0), (drive + 1.7, g1, 2.4), Kind.BUILDING),
                roof((drive - 1.8, g0 - 0.2, 2.4), (drive + 1.8, g1 + 0.2, 3.2), hip_m=0.8),
            ]
        )
    if rng.random() < 0.45:
        car = vehicle(rng, 0.08)
        lift = np.array([0.0, 0.0, site.style.kerb_m])
        parts = [(shape, vertices + lift, kind) for shape, vertices, kind in car.parts]
        out = rng.choice((-1.0, 1.0)) * math.pi / 2
        site.parts += side.put(parts, drive, max(2.6, setback - 2.6) + rng.normal(0.0, 0.2), out)
    bounds = rng.choice(3, p=(0.5, 0.25, 0.25))  # hedge, fence, open
    if bounds < 2:
        kind, thick = (Kind.HEDGE, rng.uniform(0.6, 0.9)) if bounds == 0 else (Kind.WALL, 0.08)
        gate0, gate1 = drive - 1.8, drive + 1.8
        for a, b in ((x0 + 0.1, gate0), (gate1, x1 - 0.1)):
            _hedge(site, side, a, b, 0.1, thick, kind)
    _hedge_inward(site, side, x1, 0.8, depth - 0.5)
    for _ in range(int(rng.integers(1, 4))):  # the front garden, beside the drive
        gx = rng.uniform(x0 + 3.9, x1 - 1.0) if not right else rng.uniform(x0 + 1.0, x1 - 3.9)
        make = rng.random()
        if make < 0.45:
            thing = bush(rng, 0.0, 0.0)
        elif make < 0.85:
            thing = _street_tree(rng, 4.0, 7.0, 1.2, 1.9)
        else:
            thing = conifer(rng, 0.0, 0.0)
        site.parts += side.put(thing, gx, rng.uniform(1.6, setback - 2.2))
    for _ in range(int(rng.integers(1, 4))):  # the back garden
        gx, gy = (
            rng.uniform(x0 + 2.5, x1 - 2.5),
            rng.uniform(setback + deep + 2.0, max(setback + deep + 2.5, depth - 2.0)),
        )
        thing = _street_tree(rng, 5.0, 9.0, 1.5, 2.5) if rng.random() < 0.7 else conifer(rng, 0.0, 0.0)
        site.parts += side.put(thing, gx, gy)


def _hedge(site: Site, side: Frame, x0: float, x1: float, y: float, thick: float, kind: Kind) -> None:
    """A hedge or fence in pieces of slightly different height and thickness."""
    rng = site.rng
    high = rng.uniform(0.9, 1.8)
    x = x0
    while x < x1 - 0.3:
        end = min(x1, x + rng.uniform(1.2, 2.5))
        bulge = rng.uniform(0.0, 0.15) if kind == Kind.HEDGE else 0.0
        top = high + (rng.normal(0.0, 0.05) if kind == Kind.HEDGE else 0.0)
        taper = 0.1 if kind == Kind.HEDGE else 0.0
        site.parts += side.put(
            [box((x, y - bulge / 2, 0.0), (end, y + thick + bulge, top), kind, taper=taper)]
        )
        x = end


def _hedge_inward(site: Site, side: Frame, x: float, y0: float, y1: float) -> None:
    """A hedge or fence between two lots."""
    rng = site.rng
    hedge = rng.random() < 0.6
    half, kind = (0.35, Kind.HEDGE) if hedge else (0.04, Kind.WALL)
    high = rng.uniform(1.2, 1.9)
    while y0 < y1 - 0.5:
        end = min(y1, y0 + rng.uniform(1.5, 3.0))
        top = high + (rng.normal(0.0, 0.06) if hedge else 0.0)
        site.parts += side.put(
            [box((x - half, y0, 0.0), (x + half, end, top), kind, taper=0.08 if hedge else 0.0)]
        )
        y0 = end


# --- downtown --------------------------------------------------------------------------------------------------------


def _downtown(site: Site) -> None:
    rng = site.rng
    pavement = rng.uniform(3.6, 5.0)
    for side in site.sides:
        site.park(side, 0.35, van_share=0.2)
        site.along(side, 20.0, 0.7, lambda: lamp(0.0, 0.0, 8.0))
        if rng.random() < 0.6:
            site.along(side, 11.0, 1.5, lambda: _street_tree(rng, 6.0, 9.0, 1.6, 2.4))
        elif rng.random() < 0.5:
            site.along(side, 2.4, 0.4, lambda: [post(0.0, 0.0, 0.0, 1.05, 0.08, Kind.POLE)])
        for x in (site.style.corner_m + 1.0, side.length_m - site.style.corner_m - 1.0):
            site.parts += side.put(signal(0.0, 0.0), x, 0.6)
        if rng.random() < 0.4:
            _bus_stop(site, side, rng.uniform(14.0, side.length_m - 14.0))
    if rng.random() < 0.22:
        _square(site, pavement)
        return
    lower, upper = site.lower + pavement, site.upper - pavement
    nx, ny = int(rng.integers(1, 3)), int(rng.integers(1, 3))
    cut = [
        np.sort([lower[a], *(lower[a] + (upper[a] - lower[a]) * rng.uniform(0.4, 0.6, n - 1)), upper[a]])
        for a, n in ((0, nx), (1, ny))
    ]
    for i in range(nx):
        for j in range(ny):
            low, high = np.array([cut[0][i], cut[1][j]]), np.array([cut[0][i + 1], cut[1][j + 1]])
            lane = rng.uniform(2.0, 4.0) / 2  # between neighbours
            low += [lane if i else 0.0, lane if j else 0.0]
            high -= [lane if i < nx - 1 else 0.0, lane if j < ny - 1 else 0.0]
            _tower(site, low, high)


def _tower(site: Site, low: Float64, high: Float64) -> None:
    """A building that fills its plot: flat front, arcade, or a podium with a tower set back."""
    rng = site.rng
    floors = int(rng.integers(4, 16))
    top = 4.2 + 3.3 * floors
    kind = rng.choice(3, p=(0.4, 0.3, 0.3))
    if kind == 1:  # an arcade: columns under a building that begins at the first floor
        deep = rng.uniform(2.6, 3.4)
        site.parts += [
            box((*(low + deep), 0.0), (*(high - deep), 4.2), Kind.BUILDING),
            box((*low, 4.2), (*high, top), Kind.BUILDING),
        ]
        half = rng.uniform(0.25, 0.4)
        for axis in (0, 1):
            n = max(2, round(float(high[axis] - low[axis]) / rng.uniform(4.5, 6.0)))
            for t in np.linspace(low[axis] + half, high[axis] - half, n + 1):
                for edge in (low[1 - axis] + half, high[1 - axis] - half):
                    x, y = (t, edge) if axis == 0 else (edge, t)
                    site.parts.append(
                        box((x - half, y - half, 0.0), (x + half, y + half, 4.2), Kind.BUILDING)
                    )
        return
    if kind == 2:
        podium = float(rng.choice((4.5, 8.0, 12.0)))
        back = rng.uniform(3.0, 7.0)
        site.parts += [
            box((*low, 0.0), (*high, podium), Kind.BUILDING),
            box((*(low + back), podium), (*(high - back), podium + top), Kind.BUILDING),
        ]
        top = podium
    else:
        site.parts.append(box((*low, 0.0), (*high, top), Kind.BUILDING))
    relief, pitch = rng.uniform(0.2, 0.45), rng.uniform(3.5, 7.0)
    for axis in (0, 1):  # piers on the fronts, with a canopy or shop sign between some
        n = max(2, round(float(high[axis] - low[axis]) / pitch))
        ticks = np.linspace(low[axis] + 0.4, high[axis] - 0.4, n + 1)
        for sign_, edge in ((-1, low[1 - axis]), (1, high[1 - axis])):
            for k, t in enumerate(ticks):
                a, b = sorted((edge, edge + sign_ * relief))
                site.parts.append(_on_axis(axis, (t - 0.35, t + 0.35), (a, b), (0.0, top), Kind.BUILDING))
                if k < n and rng.random() < 0.3:
                    a, b = sorted((edge, edge + sign_ * rng.uniform(0.8, 1.5)))
                    site.parts.append(
                        _on_axis(axis, (t + 0.4, ticks[k + 1] - 0.4), (a, b), (2.9, 3.1), Kind.BUILDING)
                    )


def _on_axis(
    axis: int, along: tuple[float, float], across: tuple[float, float], z: tuple[float, float], kind: Kind
) -> Part:
    x, y = (along, across) if axis == 0 else (across, along)
    return box((x[0], y[0], z[0]), (x[1], y[1], z[1]), kind)


def _bus_stop(site: Site, side: Frame, x: float) -> None:
    site.parts += side.put(
        [
            box((x - 2.0, 2.4, 0.0), (x + 2.0, 2.46, 2.3), Kind.FURNITURE),
            box((x - 2.0, 1.2, 2.3), (x + 2.0, 2.5, 2.42), Kind.FURNITURE),
            box((x + 1.94, 1.5, 0.0), (x + 2.0, 2.4, 2.3), Kind.FURNITURE),
            box((x - 1.2, 2.0, 0.45), (x + 1.2, 2.35, 0.52), Kind.FURNITURE),
        ]
    )


def _square(site: Site, margin_m: float) -> None:
    """An open square: rows of trees, benches, bollards, a fountain and perhaps a pavilion."""
    rng = site.rng
    lower, upper = site.lower + margin_m, site.upper - margin_m
    cx, cy = (float(c) for c in (lower + upper) / 2)
    r = rng.uniform(3.0, 6.0)
    site.parts += [
        post(cx, cy, 0.0, 0.55, r, Kind.FURNITURE),
        post(cx, cy, 0.55, 1.3, r / 3, Kind.FURNITURE, top_radius_m=r / 4),
        post(cx, cy, 1.3, 4.0, 0.35, Kind.FURNITURE, top_radius_m=0.2),
        blob((cx, cy, 4.4), (0.6, 0.6, 0.8), rng, Kind.FURNITURE),
    ]
    for side in site.sides:
        inner = side.inner(margin_m)
        site.along(inner, 3.0, 0.0, lambda: [post(0.0, 0.0, 0.0, 1.0, 0.1, Kind.POLE)])
        site.along(inner, 9.0, 4.0, lambda: _street_tree(rng, 6.0, 9.0, 1.8, 2.8))
        if rng.random() < 0.7:
            site.along(inner, 9.0, 7.5, bench)
    if rng.random() < 0.6:
        at = lower + (upper - lower) * rng.uniform(0.2, 0.3, 2)
        site.parts += [
            box((*(at - 2.5), 0.0), (*(at + 2.5), 3.0), Kind.BUILDING),
            box((*(at - 3.4), 3.0), (*(at + 3.4), 3.3), Kind.ROOF),
        ]


# --- offices ---------------------------------------------------------------------------------------------------------


def _offices(site: Site) -> None:
    rng = site.rng
    kind = rng.random()
    if kind < 0.10:
        _lounge(site)
        return
    pair = (SOUTH, NORTH) if rng.random() < 0.6 else (WEST, EAST)
    whole = float((site.upper - site.lower)[1 if pair[0] == SOUTH else 0])
    walled = [k for k in range(4) if k not in pair]
    openings: Openings = {k: [] for k in range(4)}
    if kind < 0.22:
        _row_of_rooms(site, pair[0], whole, openings, hall=True)
        walled.append(pair[1])
    else:
        share = rng.uniform(0.42, 0.58)
        _row_of_rooms(site, pair[0], whole * share, openings, hall=False)
        _row_of_rooms(site, pair[1], whole * (1 - share), openings, hall=False)
    for k in walled:
        _side_wall(site, site.sides[k], openings[k])


def _side_wall(site: Site, side: Frame, openings: list[tuple[float, float]]) -> None:
    """The wall to the corridor, with doorways up to 2.05 m."""
    assert site.style.ceiling_m is not None
    high, parts = site.style.ceiling_m, []
    x = 0.0
    for x0, x1 in [*sorted(openings), (side.length_m, side.length_m)]:
        if x0 > x:
            parts.append(box((x, 0.0, 0.0), (x0, _WALL_M, high), Kind.WALL))
        if x1 > x0:
            parts.append(box((x0, 0.0, 2.05), (x1, _WALL_M, high), Kind.WALL))
        x = x1
    site.parts += side.put(parts)


def _row_of_rooms(site: Site, k: int, depth: float, openings: Openings, *, hall: bool) -> None:
    """Rooms side by side along a corridor; the outer ones may have a second door, noted in `openings` of that side."""
    rng, side = site.rng, site.sides[k]
    assert site.style.ceiling_m is not None
    high = site.style.ceiling_m
    n = 1 if hall else max(1, int((side.length_m - _WALL_M) / rng.uniform(3.4, 5.6)))
    inner = side.length_m - 2 * _WALL_M
    edges = _WALL_M + inner * (np.arange(n + 1) + np.pad(rng.uniform(-0.12, 0.12, n - 1), 1)) / n
    for m in range(n):
        x0, x1 = float(edges[m]), float(edges[m + 1])
        if m:
            x0 += _WALL_M / 2
            site.parts += side.put(
                [box((edges[m] - _WALL_M / 2, 0.0, 0.0), (edges[m] + _WALL_M / 2, depth, high), Kind.WALL)]
            )
        if m < n - 1:
            x1 -= _WALL_M / 2
        free_left = bool(rng.random() < 0.5)  # the side of the door with more room
        door = x1 - 0.85 if free_left else x0 + 0.85
        openings[k].append((door - _DOOR_M / 2, door + _DOOR_M / 2))
        second = [
            x for x, outer in ((0.0, m == 0), (side.length_m, m == n - 1)) if outer and rng.random() < 0.5
        ]
        ways = [_second_door(site, side, x, depth, openings) for x in second]
        closed = bool(rng.random() < 0.22)
        _room(site, k, x0, x1, depth, door, free_left, ways, closed=closed, hall=hall)
    if not hall:
        site.parts += side.put(
            [box((0.0, depth - _WALL_M / 2, 0.0), (side.length_m, depth + _WALL_M / 2, high), Kind.WALL)]
        )
    _side_wall(site, side, openings[k])


def _second_door(site: Site, side: Frame, x: float, depth: float, openings: Openings) -> Area:
    """A doorway at one end of a row; the result is the floor inside it that stays free."""
    y = site.rng.uniform(1.0, depth - 1.2)
    at = side.point(x, y)
    for k, other in enumerate(site.sides):
        if other is not side and abs(float((at - other.origin) @ other.inward)) < 1e-6:
            along = float((at - other.origin) @ other.along)
            openings[k].append((along - _DOOR_M / 2, along + _DOOR_M / 2))
    return (x - 1.4, y - 0.6, x + 1.4, y + 0.6)


def _room(
    site: Site,
    k: int,
    x0: float,
    x1: float,
    depth: float,
    door: float,
    free_left: bool,
    ways: list[Area],
    *,
    closed: bool,
    hall: bool,
) -> None:
    rng, side = site.rng, site.sides[k]
    y0, y1 = _WALL_M, depth - (_WALL_M if hall else _WALL_M / 2)
    leaf = [box((0.0, -0.02, 0.0), (_DOOR_M, 0.02, 2.03), Kind.WALL)]
    hinge = door - _DOOR_M / 2 if not free_left else door + _DOOR_M / 2
    if closed:
        site.parts += side.put(leaf, door - _DOOR_M / 2, _WALL_M / 2)
    else:  # open into the room, towards the near wall
        swing = rng.uniform(1.5, 1.62)
        site.parts += side.put(leaf, hinge, _WALL_M + 0.03, swing if free_left else swing + 0.04)
        turn = -1.0 if free_left else 1.0
        if (x1 - x0) > 3.0 and y1 > 4.0:
            site.doors.append(Door(k, side.point(door, _WALL_M / 2), side.inward, turn * side.along))
    clear = (door - 1.75, door + 0.75) if free_left else (door - 0.75, door + 1.75)
    taken = [(clear[0], y0, clear[1], min(y1, y0 + 3.3)), *ways]
    wanted = int(rng.integers(3, 7)) if not hall else int(rng.integers(8, 14))
    if hall:
        wide, long = 1.2, min(5.0, (x1 - x0) - 6.0)
        cx, cy = (x0 + x1) / 2, max(y0 + 5.2, 0.6 * y1)
        if long > 1.5:
            site.parts += side.put(
                [box((-long / 2, -wide / 2, 0.7), (long / 2, wide / 2, 0.75), Kind.FURNITURE)], cx, cy
            )
            site.parts += side.put(
                [
                    post(-long / 4, 0.0, 0.0, 0.7, 0.2, Kind.FURNITURE),
                    post(long / 4, 0.0, 0.0, 0.7, 0.2, Kind.FURNITURE),
                ],
                cx,
                cy,
            )
            for s in np.arange(-long / 2 + 0.4, long / 2 - 0.2, 0.75):
                site.parts += side.put(
                    chair(rng, s, wide / 2 + 0.25) + placed(chair(rng, s, wide / 2 + 0.25), 0, 0, math.pi),
                    cx,
                    cy,
                )
            taken.append((cx - long / 2 - 0.6, cy - 1.6, cx + long / 2 + 0.6, cy + 1.6))
    for _ in range(wanted):
        is_desk = rng.random() < 0.55
        parts = desk(rng) if is_desk else cupboard(rng)
        for _attempt in range(6):
            wall = int(rng.integers(3))  # back, left, right
            lower = np.min([v.min(axis=0) for _, v, _ in parts], axis=0)
            upper = np.max([v.max(axis=0) for _, v, _ in parts], axis=0)
            turn = (math.pi, -math.pi / 2, math.pi / 2)[wall]
            half = float(upper[0])
            if wall == 0:
                if x1 - x0 < 2 * half + 0.1:
                    continue
                x, y = rng.uniform(x0 + half, x1 - half), y1 - 0.02
            else:
                if y1 - y0 < 2 * half + 0.1:
                    continue
                x, y = (x0 + 0.02 if wall == 1 else x1 - 0.02), rng.uniform(y0 + half, y1 - half)
            c, s = round(math.cos(turn)), round(math.sin(turn))
            xs = sorted((x + c * lower[0] - s * lower[1], x + c * upper[0] - s * upper[1]))
            ys = sorted((y + s * lower[0] + c * lower[1], y + s * upper[0] + c * upper[1]))
            fits = xs[0] > x0 and xs[1] < x1 and ys[0] > y0 and ys[1] < y1
            if fits and all(xs[0] > t[2] or xs[1] < t[0] or ys[0] > t[3] or ys[1] < t[1] for t in taken):
                taken.append((xs[0], ys[0], xs[1], ys[1]))
                site.parts += side.put(parts, x, y, turn)
                break


def _lounge(site: Site) -> None:
    """Open to all corridors: columns, sofas, plants."""
    rng = site.rng
    assert site.style.ceiling_m is not None
    size = site.upper - site.lower
    for fx in (0.0, 0.33, 0.67, 1.0):
        for fy in (0.0, 0.5, 1.0):
            x, y = site.lower + 0.25 + (size - 0.5) * (fx, fy)
            site.parts.append(
                box((x - 0.2, y - 0.2, 0.0), (x + 0.2, y + 0.2, site.style.ceiling_m), Kind.WALL)
            )
    for _ in range(int(rng.integers(5, 10))):
        x, y = rng.uniform(site.lower + 1.5, site.upper - 1.5)
        if rng.random() < 0.6:
            wide = rng.uniform(0.8, 2.0) / 2
            sofa = [
                box((-wide, -0.4, 0.0), (wide, 0.4, 0.45), Kind.FURNITURE),
                box((-wide, 0.2, 0.45), (wide, 0.4, 0.9), Kind.FURNITURE),
            ]
            site.parts += placed(sofa, x, y, float(rng.choice(4)) * math.pi / 2)
        else:
            site.parts.append(post(x, y, 0.0, 0.45, 0.2, Kind.FURNITURE, top_radius_m=0.25))
            site.parts.append(blob((x, y, 1.0), (0.4, 0.4, 0.6), rng, Kind.TREE))


_BUILDERS: dict[str, Callable[[Site], None]] = {
    "terraces": _terraces,
    "suburb": _suburb,
    "downtown": _downtown,
    "offices": _offices,
}
