"""Evidence: all labelled points ever seen, as one weighted pseudo-datum (a row) a voxel, label and source.

`rows` keeps them, `joining` adds samples while it keeps rows few, `leaving` takes out what has left.
"""

from potserver.numerics.evidence.joining import TURNS, Joined, add_sparing
from potserver.numerics.evidence.leaving import SeenThrough, see_through
from potserver.numerics.evidence.rows import (
    FREE,
    HIT,
    KINDS,
    LABELS,
    MISSED,
    NEAR,
    PASSED,
    SHADOW,
    Added,
    Cells,
    Rows,
    add,
    cells,
    clip,
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
    "KINDS",
    "LABELS",
    "MISSED",
    "NEAR",
    "PASSED",
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
    "clip",
    "counts",
    "decay",
    "forget",
    "is_alive",
    "positions",
    "see_through",
    "tile_of",
]
