"""Narrow streets of row houses close to the kerb."""

from __future__ import annotations

from typing import NamedTuple

from potclient.towns.parks import park, wall
from potclient.towns.site import EAST, NORTH, SOUTH, WEST, Frame, Site
from potclient.towns.solids import Kind, box, roof
from potclient.towns.things import (
    bush,
    lamp,
    sign,
    street_tree,
    tree,
)


def build(site: Site) -> None:
    """Fill the block."""
    rng = site.rng
    pavement = rng.uniform(1.6, 2.0)
    for side in site.sides:
        site.park(side, 0.78)
        site.along(side, 26.0, 0.45, lambda: lamp(0.0, 0.0, 5.0))
        if rng.random() < 0.6:
            site.parts += side.put(sign(0.0, 0.0, rng), rng.uniform(5.0, 9.0), 0.4)
        if rng.random() < 0.25:
            site.along(side, 16.0, 0.9, lambda: street_tree(rng, 5.0, 6.5, 1.5, 2.0))
    if rng.random() < 0.08:
        park(site, pavement)
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
                wall(site, side, taken, side.length_m - taken, 0.0, rng.uniform(1.7, 2.1), 0.22)


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
        high = eaves + rng.normal(0.0, 0.12)
        house = _House(x, x + wide, front, front + depth, high, rise, setback, mirrored)
        _row_house(site, side, house)
        x += wide
        mirrored = not mirrored
    return setback + depth


class _House(NamedTuple):
    """One house of a row, m, in the frame of its side; a mirrored one has its door at x1."""

    x0: float
    x1: float
    y0: float
    y1: float
    eaves: float
    rise: float
    setback: float
    mirrored: bool


def _row_house(site: Site, side: Frame, house: _House) -> None:
    rng = site.rng
    x0, x1, y0, y1, eaves, rise, setback, mirrored = house
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
