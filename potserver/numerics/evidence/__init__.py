"""Evidence: all labelled points ever seen, as one weighted pseudo-datum (a row) a voxel, label and source.

`rows` keeps them, `joining` adds samples while it keeps rows few, `fading` weakens what beams see through.
"""

from potserver.numerics.evidence.fading import SeenThrough, see_through
from potserver.numerics.evidence.joining import TURNS, Joined, add_sparing
from potserver.numerics.evidence.rows import (
    FREE,
    HIT,
    LABELS,
    NEAR,
    SHADOW,
    Added,
    Cells,
    Rows,
    add,
    cells,
    clip_shadows,
    counts,
    decay,
    forget,
    is_alive,
    positions,
    tile_of,
)

__all__ = [
    "FREE",
    "HIT",
    "LABELS",
    "NEAR",
    "SHADOW",
    "TURNS",
    "Added",
    "Cells",
    "Joined",
    "Rows",
    "SeenThrough",
    "add",
    "add_sparing",
    "cells",
    "clip_shadows",
    "counts",
    "decay",
    "forget",
    "is_alive",
    "positions",
    "see_through",
    "tile_of",
]
