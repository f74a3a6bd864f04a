"""The overall map as it is kept: cubes of evidence and kernels, with coordinates relative to their cube.

A scan works on a `Region`, a copy of the tiles around it as one set of arrays; `Region.tiles` cuts it up again. Tiles never
change, so a scan that fails leaves nothing behind, and what a scan costs depends on the tiles about it and not on the map.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potserver.domain.map_part import MapPart
from potserver.domain.order import MAX_ROBOTS
from potserver.domain.types import Bool, Float32, Float64, KernelSet
from potserver.errors import MapFullError, OutOfRangeError, SettingsError, ShapeError
from potserver.numerics.arrays import UInt8
from potserver.numerics.bricks import Part
from potserver.numerics.evidence import SCALES, Cells, Rows, cells, decay, is_alive, tile_of
from potserver.numerics.grouping import by_number
from potserver.numerics.lean import Lean
from potserver.numerics.threads import parallel_map
from potserver.numerics.voxel_hash import CELL_LIMIT

TileIndex = tuple[int, int, int]  # floor(p_map / tile_size_m)

COARSE, FINE, CARRIED = 0, 1, 2  # where a kernel of the overall map comes from: a lattice, or an atom
COARSE_SPACING = 2.5  # of the coarse lattice, in resolutions
_PART = (
    3  # tiles along an edge of what is put into bricks together: a window of nodes rarely crosses its border
)
FREE = ""  # in the list of robots: a number that belongs to nobody
_ROW_BYTES, _KERNEL_BYTES = 31, 122  # of a row; of a kernel in its tile and ready to be asked
LEAN_M, LEAN_LEVEL_M = 1.0, 0.25  # between the nodes of a lean, across and upwards, about
_FORMER_LEAN_M = 2.5
_MOST_LEAN_CELLS = 127  # of a tile along an axis
_VOXELS_OF_PAIR = 5  # two coarse cells are five fine ones: the least length that every lattice divides


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MapKernels:
    """K kernels of the overall map, and what is needed to fit them again.

    The prior is kept apart from the weights: what a fit returned must never be the next fit's prior, or data count twice.

    Raises (on construction):
        ShapeError: the arrays disagree on K.
    """

    kernels: KernelSet  # weights as fitted last
    level: NDArray[np.int8]  # (K,) COARSE, FINE, CARRIED, or above: see `level_of`
    prior_mean: Float32  # (K,) log-odds
    prior_var: Float32  # (K,) log-odds^2, > 0

    def __post_init__(self) -> None:
        for name in ("level", "prior_mean", "prior_var"):
            if getattr(self, name).shape != (len(self.kernels),):
                raise ShapeError(f"{name}: {getattr(self, name).shape}, need ({len(self.kernels)},)")

    def __len__(self) -> int:
        return len(self.kernels)

    def take(self, index: NDArray[np.intp] | Bool | slice) -> MapKernels:
        """The kernels that a numpy index picks."""
        return MapKernels(
            kernels=self.kernels.take(index),
            level=self.level[index],
            prior_mean=self.prior_mean[index],
            prior_var=self.prior_var[index],
        )

    def moved(self, by_m: Float64) -> MapKernels:
        """The same kernels in a frame whose origin lies at -`by_m`, (3,) m, of this one."""
        return MapKernels(
            kernels=self.kernels.moved(by_m),
            level=self.level,
            prior_mean=self.prior_mean,
            prior_var=self.prior_var,
        )

    @staticmethod
    def concatenate(sets: list[MapKernels]) -> MapKernels:
        """One set of all kernels, in order; no sets give the empty set."""
        if not sets:
            return MapKernels.new(KernelSet.empty(), COARSE)
        return MapKernels(
            kernels=KernelSet.concatenate([s.kernels for s in sets]),
            level=np.concatenate([s.level for s in sets]),
            prior_mean=np.concatenate([s.prior_mean for s in sets]),
            prior_var=np.concatenate([s.prior_var for s in sets]),
        )

    @staticmethod
    def new(kernels: KernelSet, level: int) -> MapKernels:
        """Kernels that no data have touched yet: their weights are their prior."""
        return MapKernels(
            kernels=kernels,
            level=np.full(len(kernels), level, np.int8),
            prior_mean=kernels.weight_mean,
            prior_var=kernels.weight_var,
        )


def level_of(scale: int) -> int:
    """The level of the kernels about hits of a scale: a lattice of the resolution / 2^scale."""
    return CARRIED + scale if scale else FINE


def scale_of(level: NDArray[np.int8]) -> NDArray[np.int8]:
    """(K,) the scale that kernels of these levels are of; 0 of the coarse and the carried ones."""
    return np.maximum(level - CARRIED, 0).astype(np.int8)


class Tile(NamedTuple):
    """One cube of the map. Frame: the map's axes, the cube's lower corner as origin."""

    rows: Rows
    kernels: MapKernels
    revision: int = 0  # of the map, when the tile was made
    stamp_ns: int = 0  # map time at which the rows weigh what they say
    lean: UInt8 | None = None  # (X, Y, Z) nodes of `potschemas.lean`; the kernels say what the rows add to it
    news: Float32 | None = None  # (2, B, B, B) see `Region.news`; None: none

    @property
    def is_empty(self) -> bool:
        """Nothing was ever seen or expected here, or it is forgotten."""
        return len(self.rows.kind) == 0 and len(self.kernels) == 0 and self.lean is None

    @property
    def n_bytes(self) -> int:
        """About what it takes in memory, with its share of the index."""
        beside = sum(array.nbytes for array in (self.lean, self.news) if array is not None)
        return _ROW_BYTES * len(self.rows.kind) + _KERNEL_BYTES * len(self.kernels) + beside


class TileGrid(NamedTuple):
    """How the map is cut: all lattices of voxels and kernels divide a tile, so none crosses an edge."""

    size_m: float
    fine_m: float  # the resolution: spacing of fine kernels, edge of a voxel of free space

    @staticmethod
    def of(size_m: float, fine_m: float) -> TileGrid:
        """The grid whose resolution is nearest to the one wanted.

        Raises:
            SettingsError: a tile would hold more voxels along an axis than can be numbered.
        """
        pairs = max(1, round(size_m / (_VOXELS_OF_PAIR * fine_m)))
        if 2 * _VOXELS_OF_PAIR * pairs > 2**14:
            raise SettingsError(
                f"mapping.tile_size_m is {size_m} with mapping.resolution_m {fine_m}: at most {2**14} half voxels fit a tile;"
                " make it smaller"
            )
        return TileGrid(size_m, size_m / (_VOXELS_OF_PAIR * pairs))

    @property
    def coarse_m(self) -> float:
        """Spacing of the coarse kernels."""
        return COARSE_SPACING * self.fine_m

    @property
    def spacings_m(self) -> tuple[float, ...]:
        """Of all lattices, the coarsest first."""
        return (self.coarse_m, *(self.fine_m / 2**scale for scale in range(SCALES)))

    @property
    def voxels(self) -> int:
        """Voxels of free space along a tile's edge; of hits there are twice as many."""
        return round(self.size_m / self.fine_m)

    @property
    def blocks(self) -> int:
        """Blocks along a tile's edge, of two coarse cells each."""
        return self.voxels // _VOXELS_OF_PAIR

    @property
    def block_m(self) -> float:
        """Edge of a block: about as far as a coarse kernel reaches."""
        return self.size_m / self.blocks

    @property
    def lean_nodes(self) -> tuple[int, int, int]:
        """Nodes of a tile's lean along x, y and z, from corner to corner."""
        return self._lean_nodes(LEAN_M)

    @property
    def former_lean_nodes(self) -> tuple[int, int, int]:
        """The same in maps that were kept when leans were known in fewer places."""
        return self._lean_nodes(_FORMER_LEAN_M)

    def _lean_nodes(self, step_m: float) -> tuple[int, int, int]:
        across, up = (
            min(max(round(self.size_m / step), 1), _MOST_LEAN_CELLS) + 1 for step in (step_m, LEAN_LEVEL_M)
        )
        return across, across, up

    def index_of(self, point: Float64) -> TileIndex:
        """The tile that a (3,) point in the map lies in."""
        x, y, z = (int(v) for v in np.floor(point / self.size_m))
        return x, y, z


class TiledMap(NamedTuple):
    """The overall map. Never changes: `with_tiles` is the next one, and shares with it what is the same."""

    grid: TileGrid
    tiles: Mapping[TileIndex, Tile]
    parts: Mapping[TileIndex, MapPart]  # kernels of some tiles together, ready to be asked
    robots: tuple[str, ...] = ()  # whose the rows are: `Rows.source` numbers them; FREE where nobody's are
    lean: Lean | None = None  # of all tiles together, ready to be asked; none before any tile is

    @staticmethod
    def empty(grid: TileGrid) -> TiledMap:
        """A map without tiles."""
        return TiledMap(grid, {}, {})

    def with_robot(self, robot_id: str) -> tuple[TiledMap, int]:
        """The map with a robot in its list, and the robot's number, which may have been another's that was forgotten.

        Raises:
            MapFullError: the numbers are used up.
        """
        if robot_id in self.robots:
            return self, self.robots.index(robot_id)
        number = self.robots.index(FREE) if FREE in self.robots else len(self.robots)
        if number >= MAX_ROBOTS:
            raise MapFullError(
                f"the map has evidence of {MAX_ROBOTS} robots and no number for {robot_id}: forget one"
            )
        return self._replace(robots=(*self.robots[:number], robot_id, *self.robots[number + 1 :])), number

    def without_robot(self, number: int) -> TiledMap:
        """The map with a robot's number free for another; none of its rows may be left."""
        return self._replace(robots=(*self.robots[:number], FREE, *self.robots[number + 1 :]))

    def with_tiles(self, changed: Mapping[TileIndex, Tile], *, threads: int = 1) -> TiledMap:
        """The map with some tiles exchanged, or gone if they are empty; parts without other kernels than before stay."""
        tiles = dict(self.tiles)
        for index, tile in changed.items():
            if tile.is_empty:
                tiles.pop(index, None)
            else:
                tiles[index] = tile

        def ready(number: TileIndex) -> MapPart | None:
            found = {index: tiles[index].kernels.kernels for index in tiles_of_part(number) if index in tiles}
            former = self.parts.get(number)
            if former is not None and former.is_of(found.values()):
                return former
            return MapPart.of_tiles(found, Part(self.grid.size_m, _PART, number)) if found else None

        touched = list(dict.fromkeys(part_of(index) for index in changed))
        parts = dict(self.parts)
        for number, part in zip(touched, parallel_map(ready, touched, threads), strict=True):
            if part is None:
                parts.pop(number, None)
            else:
                parts[number] = part
        lean = self.lean or Lean(self.grid.size_m, {})
        return self._replace(
            tiles=tiles,
            parts=parts,
            lean=lean.with_tiles({index: tile.lean for index, tile in changed.items()}),
        )


def check_reach(tiled: TiledMap, T_map_tiled: Float64, max_coordinate_m: float) -> None:
    """Refuse to move a map to where no map may be.

    Args:
        tiled: The map.
        T_map_tiled: (4, 4) rigid, what it is moved by.
        max_coordinate_m: m, of anything in the map frame.
    Raises:
        OutOfRangeError: a tile would reach beyond that.
    """
    if not tiled.tiles:
        return
    index = np.array(list(tiled.tiles), np.float64)
    bounds = np.stack([index.min(axis=0), index.max(axis=0) + 1.0]) * tiled.grid.size_m
    corners = np.array(list(itertools.product(*bounds.T)))
    reach_m = float(np.abs(corners @ T_map_tiled[:3, :3].T + T_map_tiled[:3, 3]).max())
    if reach_m > max_coordinate_m:
        raise OutOfRangeError(f"the moved map reaches {reach_m:.6g} m, the limit is {max_coordinate_m:.6g} m")


def part_of(index: TileIndex) -> TileIndex:
    """The part that a tile is indexed in."""
    x, y, z = index
    return x // _PART, y // _PART, z // _PART


def tiles_of_part(number: TileIndex) -> list[TileIndex]:
    """All tiles of a part, whether the map has them or not."""
    x, y, z = (range(_PART * n, _PART * (n + 1)) for n in number)
    return list(itertools.product(x, y, z))


@dataclasses.dataclass(slots=True, eq=False, kw_only=True)
class Region:
    """A box of whole tiles as one set of arrays, for the writer to work on. Frame: the lower tile's corner as origin."""

    grid: TileGrid
    lower: TileIndex
    upper: TileIndex  # inclusive
    rows: Rows
    kernels: MapKernels
    lean: dict[TileIndex, UInt8]  # of those tiles that have one
    former: dict[TileIndex, Tile]  # as they were copied
    # (2, X, Y, Z) of each block, what came since it was solved: the growth of its rows, sum of |change of log(1 + looks)|, and
    # the looks of hits that are new or gone
    news: Float32
    cells: Cells | None = None  # of the rows, once known
    gained: Float32 = dataclasses.field(
        default_factory=lambda: np.zeros(0, np.float32)
    )  # (R,) looks, by the last samples
    still: Bool | None = None  # (X, Y, Z) tiles whose kernels are as they were

    @staticmethod
    def of(
        tiled: TiledMap, lower_m: Float64, upper_m: Float64, age: Callable[[Tile], float] | None = None
    ) -> Region:
        """Copy the tiles that a box of the map touches.

        Args:
            tiled: The map.
            lower_m, upper_m: (3,) m, corners of the box, map frame.
            age: What a tile's evidence still weighs; all of it by default.
        Raises:
            SettingsError: the box has more voxels along an axis than can be numbered.
        """
        grid = tiled.grid
        low, high = grid.index_of(lower_m), grid.index_of(upper_m)
        if (max(b - a for a, b in zip(low, high, strict=True)) + 2) * 2 * grid.voxels >= CELL_LIMIT:
            raise SettingsError(
                f"a scan spans {(upper_m - lower_m).round().tolist()} m, too far for voxels of {grid.fine_m:.3g} m: lower"
                " mapping.max_range_m or raise mapping.resolution_m"
            )
        axes = [range(a, b + 1) for a, b in zip(low, high, strict=True)]
        found = [(x, y, z) for x, y, z in itertools.product(*axes) if (x, y, z) in tiled.tiles]
        members = [tiled.tiles[index] for index in found]
        shift = np.reshape(found, (-1, 3)).astype(np.int64) - low
        rows = Rows.concatenate([decay(tile.rows, age(tile)) if age else tile.rows for tile in members])
        kernels = MapKernels.concatenate([tile.kernels for tile in members])
        of_row = np.repeat(shift, [len(tile.rows.kind) for tile in members], axis=0)
        of_kernel = np.repeat(shift, [len(tile.kernels) for tile in members], axis=0)
        edge = voxels_along(rows, grid)
        return Region(
            grid=grid, lower=low, upper=high, kernels=kernels.moved(np.asarray(of_kernel * grid.size_m, np.float64)),
            rows=rows._replace(voxel=(rows.voxel + of_row * edge).astype(np.int32)),
            lean={index: tile.lean for index, tile in zip(found, members, strict=True) if tile.lean is not None},
            former=dict(zip(found, members, strict=True)), news=_news_of(members, shift, np.subtract(high, low) + 1, grid),
        )  # fmt: skip

    @property
    def size(self) -> NDArray[np.int64]:
        """(3,) tiles along the axes."""
        return np.asarray(self.upper, np.int64) - np.asarray(self.lower, np.int64) + 1

    @property
    def origin_m(self) -> Float64:
        """(3,) m, map frame."""
        return np.asarray(self.lower, np.float64) * self.grid.size_m

    def tiles(
        self, lower_m: Float64, upper_m: Float64, *, revision: int = 0, stamp_ns: int = 0
    ) -> dict[TileIndex, Tile]:
        """The tiles that a box touches, cut out again; rows that say nothing any more are left out.

        Args:
            lower_m, upper_m: (3,) m, corners of a box in the region, map frame: outside it nothing was changed.
            revision, stamp_ns: Of the new tiles.
        """
        low, high = self.grid.index_of(lower_m), self.grid.index_of(upper_m)
        size = self.size
        rows, row_cuts = self._rows_by_tile(size)
        hinge = self.kernels.kernels.hinge_mean
        # rounding may put a kernel of the outermost tiles just outside
        kernel_tile = np.clip(np.floor(hinge / self.grid.size_m), 0, size - 1).astype(np.int64)
        kernels = self.kernels.moved(np.asarray(-kernel_tile * self.grid.size_m, np.float64))
        kernel_of, kernel_cuts = by_number(
            np.ravel_multi_index(tuple(kernel_tile.T), tuple(size)), int(size.prod())
        )
        n_blocks = self.grid.blocks
        out = {}
        for number, shift in enumerate(itertools.product(*(range(s) for s in size))):
            index = (self.lower[0] + shift[0], self.lower[1] + shift[1], self.lower[2] + shift[2])
            if all(x <= i <= y for x, i, y in zip(low, index, high, strict=True)):
                is_still = self.still is not None and self.still[shift] and index in self.former
                news = self.news[_blocks_of(shift, n_blocks)]
                out[index] = Tile(
                    rows.take(np.arange(*row_cuts[number : number + 2])),
                    self.former[index].kernels
                    if is_still
                    else kernels.take(kernel_of[slice(*kernel_cuts[number : number + 2])]),
                    revision,
                    stamp_ns,
                    self.lean.get(index),
                    news.copy() if news.any() else None,
                )
        return out

    def _rows_by_tile(self, size: NDArray[np.int64]) -> tuple[Rows, NDArray[np.int64]]:
        """The rows that still say something, relative to their tiles, and where each tile's start; (3,) tiles along the axes.

        Rows of one cell lie together, so that the next scan has to look for each cell once.
        """
        of_row = self.cells or cells(self.rows)
        alive = np.flatnonzero(is_alive(self.rows))
        by_cell = alive[by_number(of_row.number[alive], of_row.n)[0]]
        rows = self.rows.take(by_cell)
        tile, voxel = tile_of(rows, self.grid.voxels, size)
        order, cuts = by_number(tile, int(size.prod()))
        return rows._replace(voxel=voxel).take(order), cuts

    def lean_at(self, points: Float64, threads: int) -> Float32 | None:
        """(N,) log-odds at (N, 3) points of the region, 0 where its tiles do not lean; None if none does."""
        if not self.lean:
            return None
        x0, y0, z0 = self.lower
        own = {(x - x0, y - y0, z - z0): nodes for (x, y, z), nodes in self.lean.items()}
        return np.nan_to_num(Lean(self.grid.size_m, own).at(points, threads=threads), copy=False, nan=0.0)


def voxels_along(rows: Rows, grid: TileGrid) -> NDArray[np.int64]:
    """(R, 1) voxels along a tile's edge, for each row in the voxels of its kind."""
    return np.asarray(grid.voxels << rows.halvings.astype(np.int64), np.int64)[:, None]


def _blocks_of(tile: Sequence[int], n: int) -> tuple[slice, ...]:
    """Where the blocks of a region's tile are in `Region.news`; the tile counted from the region's corner, `n` to an edge."""
    x, y, z = tile
    return slice(None), slice(x * n, (x + 1) * n), slice(y * n, (y + 1) * n), slice(z * n, (z + 1) * n)


def _news_of(tiles: list[Tile], at: NDArray[np.int64], size: NDArray[np.int64], grid: TileGrid) -> Float32:
    """See `Region.news`; the tiles lie at (T, 3) places of a region of (3,) tiles."""
    n = grid.blocks
    news = np.zeros((2, *(size * n)), np.float32)
    for tile, place in zip(tiles, at.tolist(), strict=True):
        if tile.news is not None:
            news[_blocks_of(place, n)] = tile.news
    return news
