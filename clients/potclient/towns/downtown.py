"""Blocks of tall buildings on wide streets, arcades and open squares."""

from __future__ import annotations

import numpy as np

from potclient.arrays import Float64
from potclient.towns.site import Frame, Site
from potclient.towns.solids import Kind, Part, blob, box, post
from potclient.towns.things import (
    bench,
    lamp,
    signal,
    street_tree,
)


def build(site: Site) -> None:
    """Fill the block."""
    rng = site.rng
    pavement = rng.uniform(3.6, 5.0)
    for side in site.sides:
        site.park(side, 0.35, van_share=0.2)
        site.along(side, 20.0, 0.7, lambda: lamp(0.0, 0.0, 8.0))
        if rng.random() < 0.6:
            site.along(side, 11.0, 1.5, lambda: street_tree(rng, 6.0, 9.0, 1.6, 2.4))
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
        site.along(inner, 9.0, 4.0, lambda: street_tree(rng, 6.0, 9.0, 1.8, 2.8))
        if rng.random() < 0.7:
            site.along(inner, 9.0, 7.5, bench)
    if rng.random() < 0.6:
        at = lower + (upper - lower) * rng.uniform(0.2, 0.3, 2)
        site.parts += [
            box((*(at - 2.5), 0.0), (*(at + 2.5), 3.0), Kind.BUILDING),
            box((*(at - 3.4), 3.0), (*(at + 3.4), 3.3), Kind.ROOF),
        ]
