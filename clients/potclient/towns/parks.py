"""Garden walls, and parks in the place of houses."""

from __future__ import annotations

import math

from potclient.towns.site import Frame, Site
from potclient.towns.solids import Kind, box, placed
from potclient.towns.things import (
    bench,
    bush,
    street_tree,
)


def wall(site: Site, side: Frame, x0: float, x1: float, y: float, high: float, thick: float) -> None:
    """A wall along a side, with a gap here and there."""
    x = x0
    while x < x1 - 1.0:
        end = min(x1, x + site.rng.uniform(6.0, 14.0))
        site.parts += side.put([box((x, y, 0.0), (end, y + thick, high), Kind.WALL)])
        x = end + (site.rng.uniform(1.0, 3.0) if site.rng.random() < 0.4 else 0.0)


def park(site: Site, margin_m: float) -> None:
    """Trees, benches and bushes behind a low wall."""
    rng = site.rng
    for side in site.sides:
        inner = side.inner(margin_m)
        wall(site, inner, 0.0, inner.length_m, 0.0, 0.6, 0.3)
    lower, upper = site.lower + margin_m + 3.0, site.upper - margin_m - 3.0
    area = float((upper - lower).prod())
    for _ in range(int(area / 90.0)):
        x, y = rng.uniform(lower, upper)
        site.parts += placed(street_tree(rng, 6.0, 11.0, 2.0, 3.2), x, y, 0.0)
    for _ in range(int(area / 200.0)):
        x, y = rng.uniform(lower, upper)
        site.parts += placed(bench(), x, y, rng.uniform(0, 2 * math.pi))
        x, y = rng.uniform(lower, upper)
        site.parts += placed(bush(rng, 0.0, 0.0), x, y, 0.0)
