"""Tiles as lattices: which nodes a tile has, their weights in whole steps, and what has changed of them.

A tile's kernels stand on a few lattices. Of those, places and weights are whole numbers, and an asker that holds some revision
of the tile needs only the differences. Codes are a function of the tile alone, so nothing drifts, however often a tile changes.
"""

from __future__ import annotations

import collections
import threading
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from potserver.asking.lattices import LEAST_ON_LATTICE, distinct_rows, lattice_of, shapes_of
from potserver.domain.tiles import TileIndex
from potserver.domain.types import Float32, Float64, KernelSet
from potserver.numerics.arrays import Int64, UInt8

_MOST_NODES = 2**40  # of a lattice in a tile: numbers of nodes of many tiles fit into 63 bits
_LEAST_VAR = 2.0**-126
_REMEMBERED = 1_000_000  # kernels, at 24 bytes


class Steps(NamedTuple):
    """What weights are rounded to."""

    mean: float  # log-odds: means are multiples of it
    var: float  # variances are `var_unit` times powers of exp of it
    var_unit: float  # log-odds^2; that of weights which no data touched, so that these stay what they are

    @staticmethod
    def of(step: float, prior_var: float) -> Steps:
        """Means to `step`, off by at most half of it; variances in steps of three times that share of themselves."""
        return Steps(step, 3.0 * step, prior_var)


class Lattice(NamedTuple):
    """Where kernels of one shape may stand in a tile."""

    spacing_m: float
    offset_m: tuple[float, float, float]  # of the first node, from the tile's lower corner
    cells: tuple[int, int, int]  # nodes along each axis
    shape: bytes  # of (5,) float32: hinge_var, gamma_shape, gamma_rate


class NodeCodes(NamedTuple):
    """The nodes of one lattice that a tile has."""

    places: Int64  # (n,) ascending: (x * cells_y + y) * cells_z + z
    mean: Int64  # (n,) steps
    var: Int64  # (n,) steps


class TileCodes(NamedTuple):
    """All kernels of a tile."""

    nodes: Mapping[Lattice, NodeCodes]
    others: KernelSet  # that stand on no lattice, as they are
    lean: UInt8 | None = None  # of the tile, which was told with its kernels

    @property
    def n_kernels(self) -> int:
        """Of both kinds."""
        return len(self.others) + sum(len(codes.places) for codes in self.nodes.values())


def code_tile(kernels: KernelSet, spacings_m: Sequence[float], size_m: float, steps: Steps) -> TileCodes:
    """A tile's kernels as lattices.

    Args:
        kernels: Hinges relative to the lower corner of the tile.
        spacings_m: Lattices to try.
        size_m: Edge of the tile.
        steps: What weights are rounded to.
    """
    hinge, shapes = kernels.hinge_mean.astype(np.float32), shapes_of(kernels)
    first, kind = distinct_rows(shapes)
    is_other = np.ones(len(kernels), np.bool_)
    nodes: dict[Lattice, NodeCodes] = {}
    for number in np.flatnonzero(np.bincount(kind) >= LEAST_ON_LATTICE):
        members = np.flatnonzero(kind == number)
        found = lattice_of(hinge[members], spacings_m)
        if found is None:
            continue
        placed = _placed(*found, size_m)
        if placed is None:
            continue
        extent, places = placed
        order = np.argsort(places)
        members = members[order]
        mean, var = (w[members].astype(np.float64) for w in (kernels.weight_mean, kernels.weight_var))
        spacing, x, y, z = found[0].tolist()
        lattice = Lattice(spacing, (x, y, z), extent, shapes[first[number]].tobytes())
        nodes[lattice] = NodeCodes(places[order], _steps(mean / steps.mean), _var_steps(var, steps))
        is_other[members] = False
    return TileCodes(nodes, kernels.take(is_other))


def _placed(lattice: Float64, cells: Int64, size_m: float) -> tuple[tuple[int, int, int], Int64] | None:
    """Nodes along each axis, and the number of each cell; None where a cell is outside or taken twice."""
    spacing = float(lattice[0])
    is_flat = lattice[1:] != 0.5 * spacing  # along z: the one height of a planar map
    x, y, z = np.where(is_flat, 1, max(1, round(size_m / spacing))).tolist()
    if x * y * z > _MOST_NODES or (cells < 0).any() or (cells >= [x, y, z]).any():
        return None
    places = (cells[:, 0] * y + cells[:, 1]) * z + cells[:, 2]
    if len(np.unique(places)) < len(places):
        return None
    return (x, y, z), places


def _steps(values: Float64) -> Int64:
    return np.rint(values).astype(np.int64)


def _var_steps(var: Float64, steps: Steps) -> Int64:
    return _steps(np.log(np.maximum(var, _LEAST_VAR) / steps.var_unit) / steps.var)


class TileKey(NamedTuple):
    """A tile as it once was, in these steps."""

    epoch: int
    tile: TileIndex
    revision: int
    steps: Steps


class TileMemory:
    """Codes of tiles that were sent lately: what an asker holds may be what the next answer differs from.

    Of a tile that is forgotten all is sent. Any thread may ask.
    """

    def __init__(self, most_kernels: int = _REMEMBERED) -> None:
        self._most = most_kernels
        self._lock = threading.Lock()
        self._codes: collections.OrderedDict[TileKey, TileCodes] = collections.OrderedDict()
        self._n_kernels = 0

    def get(self, key: TileKey) -> TileCodes | None:
        """The codes of a tile, if they are remembered."""
        with self._lock:
            if key in self._codes:
                self._codes.move_to_end(key)
            return self._codes.get(key)

    def put(self, key: TileKey, codes: TileCodes) -> None:
        """Remember them; what was not asked for longest goes."""
        with self._lock:
            if key in self._codes:
                return
            self._codes[key] = codes
            self._n_kernels += _worth(codes)
            while self._n_kernels > self._most:
                _, old = self._codes.popitem(last=False)
                self._n_kernels -= _worth(old)


def _worth(codes: TileCodes) -> int:
    """What codes take, in kernels: a tile without any has a lean."""
    return max(codes.n_kernels, 1)


def shape_of(lattice: Lattice) -> Float32:
    """(5,) what its kernels share."""
    return np.frombuffer(lattice.shape, np.float32)
