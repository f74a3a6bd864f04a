"""The differential question: which tiles of a map differ from what the asker has, and what is in them now."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potschemas.answers import AnswerRule
from potserver.domain.map_state import MapState
from potserver.domain.tiles import Tile, TileIndex
from potserver.domain.types import Float32, Float64, KernelSet

Int64 = NDArray[np.int64]

MANTISSA_BITS = 23  # of a float32


class KnownTiles(NamedTuple):
    """What an asker has of a map."""

    epoch: int  # of the map that the revisions are of
    indices: Int64  # (N, 3)
    revisions: Int64  # (N,)


class TileRun(NamedTuple):
    """Some tiles, or parts of them, one after the other."""

    indices: Int64  # (T, 3)
    revisions: Int64  # (T,)
    counts: Int64  # (T,) kernels of each, at least 1
    kernels: KernelSet  # relative to the lower corners of their tiles


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TilesPlan:
    """The tiles that differ from what the asker has; all parts come from one state of the map, put together when asked for."""

    epoch: int
    map_revision: int
    rule: AnswerRule
    tile_size_m: float
    spacings_m: tuple[float, ...]  # of the lattices that most of the map's kernels are on
    is_whole: bool  # all tiles of the box, because what the asker has is of another epoch
    tiles: tuple[tuple[TileIndex, Tile], ...]  # that differ, each with kernels
    gone: Int64  # (G, 3) tiles that the asker has and the map has not
    mantissa_bits: int
    part_kernels: int

    @property
    def n_kernels(self) -> int:
        """Of all tiles."""
        return sum(len(tile.kernels) for _, tile in self.tiles)

    @property
    def n_parts(self) -> int:
        """Parts of at most `part_kernels` kernels; at least one, which may be empty."""
        return max(1, -(-self.n_kernels // self.part_kernels))

    def part(self, i: int) -> TileRun:
        """One run of kernels; a tile may go on in the next."""
        sizes = np.array([len(tile.kernels) for _, tile in self.tiles], np.int64)
        ends = np.cumsum(sizes)
        first, stop = i * self.part_kernels, (i + 1) * self.part_kernels
        start = np.maximum(first - (ends - sizes), 0)
        counts = np.minimum(stop - (ends - sizes), sizes) - start
        members = np.flatnonzero(counts > 0)
        kernels = KernelSet.concatenate(
            [
                self.tiles[t][1].kernels.kernels.take(slice(int(start[t]), int(start[t] + counts[t])))
                for t in members
            ]
        )
        if self.mantissa_bits < MANTISSA_BITS:
            kernels = kernels.replace(
                weight_mean=rounded(kernels.weight_mean, self.mantissa_bits),
                weight_var=rounded(kernels.weight_var, self.mantissa_bits),
            )
        return TileRun(
            np.array([self.tiles[t][0] for t in members], np.int64).reshape(-1, 3),
            np.array([self.tiles[t][1].revision for t in members], np.int64),
            counts[members],
            kernels,
        )


def plan_tiles(
    state: MapState,
    known: KnownTiles | None,
    lower: Float64 | None,
    upper: Float64 | None,
    *,
    tile_size_m: float,
    mantissa_bits: int,
    part_kernels: int,
) -> TilesPlan:
    """Compare what an asker has with a state of the map. A tile without kernels says nothing and counts as none.

    Args:
        state: Of the map.
        known: What the asker has; None = nothing.
        lower, upper: (3,) m, corners of the box whose tiles are meant, map frame; None = no bound on that side.
        tile_size_m: Edge of a tile where the map has none yet.
        mantissa_bits: Of each weight, 2 to 23; fewer than 23 are rounded to.
        part_kernels: Of a part.
    """
    size = tile_size_m if state.tiled is None else state.tiled.grid.size_m
    low = None if lower is None else np.floor(lower / size).astype(np.int64)
    high = None if upper is None else np.floor(upper / size).astype(np.int64)
    present: dict[TileIndex, Tile] = {}
    if state.tiled is not None:
        everywhere = {index: tile for index, tile in state.tiled.tiles.items() if len(tile.kernels)}
        inside = _inside(np.array(list(everywhere), np.int64).reshape(-1, 3), low, high)
        present = {index: everywhere[index] for index, is_in in zip(everywhere, inside, strict=True) if is_in}
    is_whole = known is None or known.epoch != state.epoch
    revisions: dict[TileIndex, int] = {}
    if known is not None and not is_whole:
        meant = _inside(known.indices, low, high)
        revisions = {
            (x, y, z): revision
            for (x, y, z), revision in zip(
                known.indices[meant].tolist(), known.revisions[meant].tolist(), strict=True
            )
        }
    return TilesPlan(
        epoch=state.epoch,
        map_revision=state.map_revision,
        rule=state.snapshot.rule,
        tile_size_m=size,
        spacings_m=() if state.tiled is None else (state.tiled.grid.coarse_m, state.tiled.grid.fine_m),
        is_whole=is_whole,
        tiles=tuple((i, tile) for i, tile in present.items() if revisions.get(i) != tile.revision),
        gone=np.array([i for i in revisions if i not in present], np.int64).reshape(-1, 3),
        mantissa_bits=mantissa_bits,
        part_kernels=part_kernels,
    )


def rounded(values: Float32, bits: int) -> Float32:
    """Float32 numbers with mantissas of 2 to 22 bits, the nearest ones: off by at most 2^-(bits + 1) of themselves.

    Nothing becomes infinite: what would is cut off instead. Below 2^-126 numbers are off by at most 2^-(bits + 127).
    """
    dropped = MANTISSA_BITS - bits
    keep = np.uint32((0xFFFFFFFF << dropped) & 0xFFFFFFFF)
    raw = values.view(np.uint32)
    up = ((raw + np.uint32(1 << (dropped - 1))) & keep).view(np.float32)
    return np.where(np.isfinite(up), up, (raw & keep).view(np.float32))


def _inside(index: Int64, low: Int64 | None, high: Int64 | None) -> NDArray[np.bool_]:
    """(N,) which tiles lie in a box of tiles, its upper corner included."""
    inside = np.ones(len(index), np.bool_)
    if low is not None:
        inside &= (index >= low).all(axis=1)
    if high is not None:
        inside &= (index <= high).all(axis=1)
    return inside
