"""Nodes of lattices as bricks of rows: what `brick_sums` answers from instead of looking for kernels one by one.

Kernels that stand on a lattice and share one width factorise: exp(-gamma |x - h|^2) is a product of three numbers, one an axis,
and a point needs six of them along each. So the sums over the 6 x 6 x 6 nodes about a point are fused multiply-adds over rows
of nodes.

Whether kernels stand on a lattice is read off them, for each tile and width: the finest lattice that divides the tile's edge
and that all of them lie on, as long as six of its nodes along an axis are all that count. In a planar map the nodes lie in a
plane of any height. Kernels on no lattice are left to a `KernelIndex`.

A brick has the nodes that the windows of six nodes with their first one in a box need, so one brick is enough for nearly every
point. Neighbouring bricks overlap by five nodes. Bricks hold nodes of one part of the map alone: a window across the border of
two parts adds what each of them has, and no part needs its neighbours to be built.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Bool, Float32, Float64, Int16, Int64
from potserver.numerics.geometry import bounds
from potserver.numerics.voxel_hash import empty_table, enter, pack

WINDOW = 6  # nodes along an axis that a point looks at; with `_LEAST_FALL` all others add less than 4e-6 of their weight
BEFORE = WINDOW // 2 - 1  # of these, so many lie before the node just below the point
HALO = WINDOW - 1  # nodes by which neighbouring bricks overlap
ROW = 16  # nodes of a row, along x
ROWS = 32  # rows of a brick along y and z
STARTS = (ROW - HALO, ROWS - HALO, ROWS - HALO)  # first nodes of windows in a brick, along x, y and z
BYTES_OF_ROW = 3 * 4 * ROW

_LEAST_FALL = 1.38  # gamma spacing^2, at least: exp(-1.38 * 3^2) is 4e-6
_SPARSEST = 4  # times the spacing at that fall, at most
_MOST_NODES = 2**13  # along a tile: kernels narrower than such a lattice needs are looked for one by one
_OFF_NODE = 1e-5  # spacings by which a kernel may lie beside its node
_PLANE_STEP_M = 2.0**-30  # planes nearer than this are one
_MOST_LATTICES = 8  # of one part: each costs every point there


class Lattice(NamedTuple):
    """A lattice of kernels of one width. Node (i, j, k) lies at (i + 1/2, j + 1/2, k + 1/2) spacings, from the map's origin."""

    nodes: int  # along the edge of a part of the map
    edge_m: float  # of a part
    gamma: float  # 1/m^2
    # of lattices that fill no space but a plane: the part's number along z and the plane's height in it, m; k is 0 then
    plane: tuple[int, float] | None = None

    @property
    def spacing_m(self) -> float:
        """From node to node."""
        return self.edge_m / self.nodes


class LatticeBricks(NamedTuple):
    """The nodes of one lattice in one part of a map. A brick's first row has no nodes: it stands for all that are not there."""

    lattice: Lattice
    n_kernels: int
    lower: Float64  # (3,) m, map frame: the box of the nodes
    upper: Float64
    place: Int64  # (B, 3) number of each brick along the axes, among all of the map
    layers: Int64  # (B,) bit z: the brick has rows in layer z
    row_of: Int16  # (B, ROWS, ROWS) by z and y: number of a row in its brick
    first: Int64  # (B,) first row of each brick
    rows: Float32  # (R, 3, ROW) weight, variance and known share, summed over the kernels at each node


class Part(NamedTuple):
    """A cube of whole tiles, whose kernels are put into bricks together."""

    tile_m: float  # edge of a tile
    tiles: int  # along the part's edge
    number: tuple[int, int, int]  # floor(p_map / edge of the part)

    @property
    def edge_m(self) -> float:
        """Of the part."""
        return self.tiles * self.tile_m


class NodeKernels(NamedTuple):
    """K kernels of a part."""

    hinge: Float64  # (K, 3) m, relative to their tile's lower corner
    tile: Int64  # (K, 3) their tile in the part, from 0
    gamma: Float32  # (K,) 1/m^2
    weight: Float32  # (K,) log-odds
    variance: Float32  # (K,) log-odds^2
    known: Float32  # (K,) in [0, 1], share of the weight that is known: what a kernel adds to the activation


def bricks_of(kernels: NodeKernels, part: Part) -> tuple[list[LatticeBricks], Bool]:
    """Bricks of all kernels that stand on lattices; and (K,) which kernels do not."""
    of_group, group = _fit_lattices(
        kernels.hinge, (kernels.tile @ [1, part.tiles, part.tiles**2]).astype(np.int64), kernels.gamma, part.tile_m,
        empty_table(len(kernels.gamma)),
    )  # fmt: skip
    lattices: dict[Lattice, list[int]] = {}
    for number in np.flatnonzero(of_group.nodes):
        plane = None
        if of_group.is_flat[number]:
            height = of_group.height_m[number] + kernels.tile[of_group.first[number], 2] * part.tile_m
            plane = part.number[2], round(height / _PLANE_STEP_M) * _PLANE_STEP_M
        nodes = part.tiles * int(of_group.nodes[number])
        lattice = Lattice(nodes, part.edge_m, float(kernels.gamma[of_group.first[number]]), plane)
        lattices.setdefault(lattice, []).append(int(number))
    most_first = sorted(lattices, key=lambda lattice: -of_group.n_kernels[lattices[lattice]].sum())
    rest = np.ones(len(group), np.bool_)
    made = []
    for lattice in most_first[:_MOST_LATTICES]:
        is_of = np.zeros(len(of_group.n_kernels), np.bool_)
        is_of[lattices[lattice]] = True
        members = np.flatnonzero(is_of[group])
        rest[members] = False
        made.append(_bricks(lattice, kernels, members, part))
    return made, rest


def _bricks(lattice: Lattice, kernels: NodeKernels, members: Int64, part: Part) -> LatticeBricks:
    n = lattice.nodes // part.tiles  # along a tile's edge
    tile, hinge = kernels.tile[members], kernels.hinge[members]
    node = np.rint(hinge * (n / part.tile_m) - 0.5).astype(np.int64) + n * tile
    counts = bricks_along(lattice.nodes)
    origin = np.array(part.number, np.int64)
    if lattice.plane is not None:
        node[:, 2], origin[2] = 0, 0
    table = empty_table(min(8 * len(members), int(counts.prod())))  # a node is in up to eight bricks
    columns = np.stack([column[members] for column in (kernels.weight, kernels.variance, kernels.known)])
    place, row_of, first, layers, rows = _build(node, columns.astype(np.float32), counts, table)
    lower, upper = bounds(hinge + tile * part.tile_m + np.array(part.number) * part.edge_m)
    return LatticeBricks(
        lattice, len(members), lower, upper, place + origin * counts, layers, row_of, first, rows
    )


def bricks_along(nodes_of_part: int) -> Int64:
    """(3,) bricks of a part along each axis."""
    return np.array([(nodes_of_part + HALO - 1) // starts + 1 for starts in STARTS], np.int64)


class _Groups(NamedTuple):
    """The kernels of one width in one tile are a group."""

    first: Int64  # (G,) one of its kernels
    n_kernels: Int64  # (G,)
    nodes: Int64  # (G,) of its lattice along a tile's edge; 0: it has none
    is_flat: Bool  # (G,) the lattice is a plane
    height_m: Float64  # (G,) of the plane, in the tile


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _fit_lattices(hinge, tile, gamma, tile_m, table):
    """The groups, and (K,) the group of each kernel."""
    k = len(gamma)
    keys, group = np.empty(k, np.int64), np.empty(k, np.int64)
    first, count = np.empty(k, np.int64), np.zeros(k, np.int64)
    bits = gamma.view(np.int32)
    n = 0
    for i in range(k):
        group[i] = enter(table, keys, n, (tile[i] << 32) | np.int64(bits[i]))
        if group[i] == n:
            first[n] = i
            n += 1
        count[group[i]] += 1
    start = np.zeros(n + 1, np.int64)
    for g in range(n):
        start[g + 1] = start[g] + count[g]
    members, at = np.empty(k, np.int64), start[:n].copy()
    for i in range(k):
        members[at[group[i]]] = i
        at[group[i]] += 1
    nodes, flat, height = np.zeros(n, np.int64), np.zeros(n, np.bool_), np.zeros(n)
    for g in range(n):
        own = members[start[g] : start[g + 1]]
        height[g] = hinge[own[0], 2]
        finest = int(tile_m * np.sqrt(gamma[own[0]] / _LEAST_FALL))
        if finest > _MOST_NODES:
            continue
        for candidate in range(finest, max(1, finest // _SPARSEST), -1):
            fits = _fits(hinge, own, candidate / tile_m, height[g])
            if fits:
                nodes[g], flat[g] = candidate, fits == 2
                break
    return _Groups(first[:n], count[:n], nodes, flat, height), group


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _fits(hinge, members, nodes_a_metre, height):
    """1: all lie on nodes; 2: they do in x and y, and all at one height; 0: neither."""
    in_space, in_plane = True, True
    for m in members:
        for c in range(2):
            at = hinge[m, c] * nodes_a_metre - 0.5
            if abs(at - np.rint(at)) > _OFF_NODE:
                return 0
        at = hinge[m, 2] * nodes_a_metre - 0.5
        in_space = in_space and abs(at - np.rint(at)) <= _OFF_NODE
        in_plane = in_plane and abs(hinge[m, 2] - height) * nodes_a_metre <= _OFF_NODE
    return 1 if in_space else 2 if in_plane else 0


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _first_brick(at, size, starts):
    """The first brick with a node, counted from `HALO` before the part; bricks have `size` nodes, one each `starts`."""
    return max((at - size) // starts + 1, 0)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _build(node, columns, counts, table):
    """Bricks of (M, 3) nodes, numbered from the part's lower corner: place, row_of, first, layers, rows.

    Args:
        node, columns: Of M kernels; (3, M) weight, variance and known share.
        counts: Bricks of a part along each axis.
        table: Room for a hash of them.
    """
    m = len(node)
    keys, place = np.empty(len(table), np.int64), np.empty((len(table), 3), np.int64)
    brick = np.full((m, 8), -1, np.int64)  # that each node is in
    n = 0
    for i in range(m):
        ax, ay, az = node[i, 0] + HALO, node[i, 1] + HALO, node[i, 2] + HALO
        j = 0
        for x in range(_first_brick(ax, ROW, STARTS[0]), min(ax // STARTS[0] + 1, counts[0])):
            for y in range(_first_brick(ay, ROWS, STARTS[1]), min(ay // STARTS[1] + 1, counts[1])):
                for z in range(_first_brick(az, ROWS, STARTS[2]), min(az // STARTS[2] + 1, counts[2])):
                    e = enter(table, keys, n, pack(0, x, y, z))
                    if e == n:
                        place[n, 0], place[n, 1], place[n, 2] = x, y, z
                        n += 1
                    brick[i, j] = e
                    j += 1
    place = place[:n].copy()
    row_of = np.zeros((n, ROWS, ROWS), np.int16)
    for i in range(m):
        for b in brick[i]:
            if b >= 0:
                row_of[
                    b,
                    node[i, 2] + HALO - place[b, 2] * STARTS[2],
                    node[i, 1] + HALO - place[b, 1] * STARTS[1],
                ] = 1
    first, layers = np.empty(n, np.int64), np.zeros(n, np.int64)
    n_rows = 0
    for b in range(n):
        first[b] = n_rows
        n_rows += 1
        for z in range(ROWS):
            for y in range(ROWS):
                if row_of[b, z, y]:
                    row_of[b, z, y] = n_rows - first[b]
                    layers[b] |= np.int64(1) << z
                    n_rows += 1
    rows = np.zeros(
        (n_rows + 1, 3, ROW), np.float32
    )  # one more: vectors of eight may look beyond the last row
    for i in range(m):
        for b in brick[i]:
            if b >= 0:
                y, z = (
                    node[i, 1] + HALO - place[b, 1] * STARTS[1],
                    node[i, 2] + HALO - place[b, 2] * STARTS[2],
                )
                row = rows[first[b] + row_of[b, z, y]]
                lane = node[i, 0] + HALO - place[b, 0] * STARTS[0]
                for c in range(3):
                    row[c, lane] += columns[c, i]
    return place, row_of, first, layers, rows
