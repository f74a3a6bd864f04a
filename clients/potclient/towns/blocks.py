"""What stands in one cell of the street grid; each cell has random numbers of its own, so any of them can be built alone."""

from __future__ import annotations

from collections.abc import Callable

from potclient.towns import downtown, offices, suburb, terraces
from potclient.towns.site import Block, Site
from potclient.towns.streets import Crossing, StreetGrid

_BUILDERS: dict[str, Callable[[Site], None]] = {
    "terraces": terraces.build,
    "suburb": suburb.build,
    "downtown": downtown.build,
    "offices": offices.build,
}


def build_block(grid: StreetGrid, cell: Crossing) -> Block:
    """The block of a cell in the town's style."""
    site = Site(grid, cell)
    if site.style.kerb_m > 0:
        site.pavement()
    _BUILDERS[site.style.name](site)
    return site.build()
