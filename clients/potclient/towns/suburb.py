"""Detached houses behind lawns, hedges and trees."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from potclient.towns.parks import park
from potclient.towns.site import EAST, NORTH, SOUTH, WEST, Frame, Site
from potclient.towns.solids import Kind, box, post, roof
from potclient.towns.things import (
    bush,
    conifer,
    lamp,
    street_tree,
    vehicle,
)


def build(site: Site) -> None:
    """Fill the block."""
    rng = site.rng
    verge = rng.uniform(2.0, 3.2)
    for side in site.sides:
        site.park(side, 0.10)
        site.along(side, 34.0, 0.6, lambda: lamp(0.0, 0.0, 6.0))
        if rng.random() < 0.5:
            site.along(side, rng.uniform(12.0, 20.0), 1.2, lambda: street_tree(rng, 5.0, 8.0, 1.8, 2.8))
    if rng.random() < 0.08:
        park(site, verge)
        return
    lot_depth = min(28.0, 0.46 * float((site.upper - site.lower).min()))
    long_first = (EAST, WEST) if site.sides[EAST].length_m > site.sides[SOUTH].length_m else (SOUTH, NORTH)
    for k in range(4):
        side = site.sides[k].inner(verge)
        first = 0.0 if k in long_first else lot_depth
        room = side.length_m - 2 * first
        n = max(1, int(room / rng.uniform(16.0, 23.0))) if room > 13.0 else 0
        for m in range(n):
            _fill(site, side, _Lot(first + room * m / n, first + room * (m + 1) / n, lot_depth))


class _Lot(NamedTuple):
    """A plot in the frame of its side, m."""

    x0: float
    x1: float
    depth: float


def _fill(site: Site, side: Frame, lot: _Lot) -> None:
    """House, drive, bounds and gardens."""
    rng = site.rng
    x0, x1, depth = lot
    x, setback, deep = _house(site, side, lot)
    right = bool(rng.random() < 0.5)
    drive = x1 - 2.1 if right else x0 + 2.1
    if rng.random() < 0.5:
        _porch(site, side, x + rng.uniform(-1.5, 1.5), setback)
    _drive(site, side, drive, setback)
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
            thing = street_tree(rng, 4.0, 7.0, 1.2, 1.9)
        else:
            thing = conifer(rng, 0.0, 0.0)
        site.parts += side.put(thing, gx, rng.uniform(1.6, setback - 2.2))
    back = setback + deep + 2.0
    for _ in range(int(rng.integers(1, 4))):  # the back garden
        gx, gy = rng.uniform(x0 + 2.5, x1 - 2.5), rng.uniform(back, max(setback + deep + 2.5, depth - 2.0))
        thing = street_tree(rng, 5.0, 9.0, 1.5, 2.5) if rng.random() < 0.7 else conifer(rng, 0.0, 0.0)
        site.parts += side.put(thing, gx, gy)


def _house(site: Site, side: Frame, lot: _Lot) -> tuple[float, float, float]:
    """The house of a lot: where its middle is along the side, its distance from the street, and its depth, m."""
    rng = site.rng
    room = lot.x1 - lot.x0
    wide, deep = min(rng.uniform(8.5, 12.5), room - 4.5), rng.uniform(7.5, 10.5)
    setback = rng.uniform(5.0, 8.0)
    x, y = lot.x0 + room / 2 + rng.uniform(-0.8, 0.8), setback + deep / 2
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
    return x, setback, deep


def _porch(site: Site, side: Frame, x: float, setback: float) -> None:
    site.parts += side.put(
        [
            box((x - 1.3, setback - 1.5, 0.0), (x + 1.3, setback + 0.3, 0.3), Kind.BUILDING),
            box((x - 1.4, setback - 1.6, 2.4), (x + 1.4, setback + 0.3, 2.6), Kind.BUILDING),
            post(x - 1.2, setback - 1.4, 0.0, 2.4, 0.08, Kind.BUILDING),
            post(x + 1.2, setback - 1.4, 0.0, 2.4, 0.08, Kind.BUILDING),
        ]
    )


def _drive(site: Site, side: Frame, x: float, setback: float) -> None:
    """Perhaps a garage beside the house, and perhaps a car before it."""
    rng = site.rng
    if rng.random() < 0.6:
        y0, y1 = setback + 2.0, setback + 7.5
        site.parts += side.put(
            [
                box((x - 1.7, y0, 0.0), (x + 1.7, y1, 2.4), Kind.BUILDING),
                roof((x - 1.8, y0 - 0.2, 2.4), (x + 1.8, y1 + 0.2, 3.2), hip_m=0.8),
            ]
        )
    if rng.random() < 0.45:
        car = vehicle(rng, 0.08)
        lift = np.array([0.0, 0.0, site.style.kerb_m])
        parts = [(shape, vertices + lift, kind) for shape, vertices, kind in car.parts]
        out = rng.choice((-1.0, 1.0)) * math.pi / 2
        site.parts += side.put(parts, x, max(2.6, setback - 2.6) + rng.normal(0.0, 0.2), out)


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
