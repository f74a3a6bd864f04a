"""The lean: what a map expects where nobody looked, in log-odds, on a lattice in each of its tiles.

A map that leans solves its kernels for what its data say beyond the lean: its latent is the lean and the sum over kernels. The
lattice of a tile has X x Y x Z nodes from its lower to its upper corner, both included, as bytes: (byte - 128) / 16 log-odds.
Between nodes the lean is trilinear. Outside all tiles that have one there is none, which is NaN here.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Float = NDArray[np.floating]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
TileIndex = tuple[int, int, int]  # floor(p_map / tile_size_m)

LEAN_UNIT = 1.0 / 16.0  # log-odds of a step
LEAN_ZERO = 128  # the byte of no log-odds
_MOST_NUMBERED = 2.0**62
MAX_LEAN = 127 * LEAN_UNIT  # log-odds, either way


class LeanTiles(NamedTuple):
    """The nodes of the tiles that have a lean."""

    tile_size_m: float
    nodes: Mapping[
        TileIndex, Bytes
    ]  # (X, Y, Z) of each tile; all of one shape, with at least two nodes an axis


class LeanAt(NamedTuple):
    """The lean at N points."""

    log_odds: Float32  # (N,) NaN: there is none
    gradient: Float32  # (N, 3) log-odds/m; 0 where there is none


def to_bytes(log_odds: Float, every: int = 1) -> Bytes:
    """The nearest steps to log-odds, cut off at `MAX_LEAN`; of those that are multiples of `every`, which deflate better."""
    steps = np.rint(np.clip(log_odds, -MAX_LEAN, MAX_LEAN) / (every * LEAN_UNIT)) * every
    steps = np.clip(steps, -127, 127)
    told: Bytes = (steps + LEAN_ZERO).astype(np.uint8)
    return told


def lean_at(points: Float64, lean: LeanTiles) -> LeanAt:
    """The lean at (N, 3) points, m, map frame."""
    tile_size_m, tiles = lean
    n = len(points)
    value, slope = np.full(n, np.nan, np.float32), np.zeros((n, 3), np.float32)
    if not tiles or not n:
        return LeanAt(value, slope)
    scaled = points / tile_size_m
    corner = np.floor(scaled)
    tile = corner.astype(np.int64)
    low = tile.min(axis=0)
    size = tile.max(axis=0) - low + 1
    if float(np.prod(size.astype(np.float64))) < _MOST_NUMBERED:  # far faster than comparing rows
        number = np.ravel_multi_index(tuple((tile - low).T), tuple(size))
        which, tile_of = np.unique(number, return_inverse=True)
        found = np.stack(np.unravel_index(which, tuple(size)), axis=1) + low
    else:
        found, tile_of = np.unique(tile, axis=0, return_inverse=True)
    here = [
        (k, index) for k, row in enumerate(found.tolist()) if (index := (row[0], row[1], row[2])) in tiles
    ]
    if not here:
        return LeanAt(value, slope)
    slot = np.full(len(found), -1)
    slot[[k for k, _ in here]] = np.arange(len(here))
    nodes = np.stack([tiles[index] for _, index in here])
    own = slot[tile_of.reshape(-1)]
    rows = np.flatnonzero(own >= 0)
    cells = np.array(nodes.shape[1:]) - 1
    place = (scaled[rows] - corner[rows]) * cells
    first = np.minimum(place.astype(np.int64), cells - 1)
    t = place - first
    i, j, k = first.T
    at = {
        (a, b, c): (nodes[own[rows], i + a, j + b, k + c].astype(np.float64) - LEAN_ZERO) * LEAN_UNIT
        for a, b, c in itertools.product((0, 1), repeat=3)
    }
    x, y, z = t.T
    along_z = {(a, b): at[a, b, 0] + z * (at[a, b, 1] - at[a, b, 0]) for a in (0, 1) for b in (0, 1)}
    along_y = {a: along_z[a, 0] + y * (along_z[a, 1] - along_z[a, 0]) for a in (0, 1)}
    value[rows] = along_y[0] + x * (along_y[1] - along_y[0])
    per_m = cells / tile_size_m
    slope[rows, 0] = (along_y[1] - along_y[0]) * per_m[0]
    of_y = [along_z[a, 1] - along_z[a, 0] for a in (0, 1)]
    slope[rows, 1] = (of_y[0] + x * (of_y[1] - of_y[0])) * per_m[1]
    of_z = {(a, b): at[a, b, 1] - at[a, b, 0] for a in (0, 1) for b in (0, 1)}
    of_zy = [of_z[a, 0] + y * (of_z[a, 1] - of_z[a, 0]) for a in (0, 1)]
    slope[rows, 2] = (of_zy[0] + x * (of_zy[1] - of_zy[0])) * per_m[2]
    return LeanAt(value, slope)
