"""Nodes of a map's tiles in whole steps, kept up to date by what has changed of them. numpy only."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Bool, Float32
from potclient.errors import BadReplyError
from potschemas.messages import MAX_PART_KERNELS, DType, LatticeNodes, Packed, TileChanges
from potschemas.wire import unpack_array

Int64 = NDArray[np.int64]

_MOST_NUMBERS = 2**62  # of nodes in all tiles of a part
_MOST_STEPS = 2**40  # of a weight


class Steps(NamedTuple):
    """What one step of a weight is."""

    step: float  # log-odds
    var_step: float  # of the logarithm
    var_unit: float  # log-odds^2


class Lattice(NamedTuple):
    """Where nodes of one shape may stand in a tile."""

    spacing_m: float
    offset_m: tuple[float, ...]
    cells: tuple[int, ...]
    shape: bytes  # of (5,) float32: hinge_var, gamma_shape, gamma_rate


class Nodes(NamedTuple):
    """Nodes that stand on one lattice, by place."""

    places: Int64  # (n,) ascending
    mean: Int64  # (n,) steps
    var: Int64  # (n,) steps


TileNodes = Mapping[Lattice, Nodes]
_NO_NODES = Nodes(*(np.zeros(0, np.int64),) * 3)


class Kernels(NamedTuple):
    """Nodes as kernels, hinges relative to the corner of their tile."""

    hinge_mean: Float32  # (K, 3) m
    hinge_var: Float32
    gamma_shape: Float32
    gamma_rate: Float32
    weight_mean: Float32
    weight_var: Float32


def steps_of(changes: TileChanges) -> Steps:
    """What its numbers count."""
    return Steps(changes.step, changes.var_step, changes.var_unit)


def changed_nodes(
    changes: TileChanges, before: Callable[[int], TileNodes | None], n_tiles: int
) -> list[TileNodes]:
    """The nodes of a part's tiles.

    Args:
        changes: Of the part.
        before: The nodes of one of its tiles as they are held; None where the tile is not, or in other steps.
        n_tiles: Of the part.
    Raises:
        WireError, BadReplyError: arrays of the wrong form, or changes of what is not there.
    """
    based: Bool = unpack_array(
        changes.based, "based", dtypes=(DType.BOOL,), shape=(n_tiles,), max_elements=MAX_PART_KERNELS
    )
    bases: list[TileNodes] = []
    for t in range(n_tiles):
        base = before(t) if based[t] else {}
        if base is None:
            raise BadReplyError("tiles: changes of a tile that is not held")
        bases.append(base)
    now: list[dict[Lattice, Nodes]] = [{} for _ in range(n_tiles)]
    for coded in changes.lattices:
        lattice, tiles = _lattice_of(coded, n_tiles)
        for t, nodes in zip(tiles, _changed(coded, lattice, [bases[t] for t in tiles]), strict=True):
            if lattice in now[t]:
                raise BadReplyError("tiles: a lattice came twice")
            if len(nodes.places):
                now[t][lattice] = nodes
    return list(now)


def kernels_of(nodes: TileNodes, steps: Steps) -> list[Kernels]:
    """The nodes of a tile as kernels, a set a lattice.

    Raises:
        BadReplyError: numbers that are not finite.
    """
    return [_kernels(lattice, found, steps) for lattice, found in nodes.items()]


def _kernels(lattice: Lattice, nodes: Nodes, steps: Steps) -> Kernels:
    cells = np.stack(np.unravel_index(nodes.places, lattice.cells), axis=1)
    shape = np.frombuffer(lattice.shape, np.float32)
    k = len(cells)
    with np.errstate(over="ignore"):
        kernels = Kernels(
            (np.array(lattice.offset_m) + cells * lattice.spacing_m).astype(np.float32),
            np.tile(shape[:3], (k, 1)),
            np.full(k, shape[3]),
            np.full(k, shape[4]),
            (nodes.mean * steps.step).astype(np.float32),
            (steps.var_unit * np.exp(nodes.var * steps.var_step)).astype(np.float32),
        )
    if not all(np.isfinite(numbers).all() for numbers in kernels):
        raise BadReplyError("tiles: nodes with numbers that are not finite")
    return kernels


def _lattice_of(coded: LatticeNodes, n_tiles: int) -> tuple[Lattice, list[int]]:
    shape = unpack_array(coded.shape, "shape", dtypes=(DType.FLOAT32,), shape=(5,), max_elements=5)
    tiles = _numbers(coded.tiles, "tiles", None)
    if len(tiles) and not (tiles[0] >= 0 and tiles[-1] < n_tiles and (np.diff(tiles) > 0).all()):
        raise BadReplyError("tiles: a lattice of tiles that are not in the part")
    if math.prod(coded.cells) * (n_tiles + 1) > _MOST_NUMBERS:
        raise BadReplyError(f"tiles: a lattice of {coded.cells} nodes")
    if not np.isfinite(shape).all() or (shape[3:] <= 0).any():
        raise BadReplyError("tiles: a lattice with widths that are not positive numbers")
    lattice = Lattice(coded.spacing, tuple(coded.offset), tuple(coded.cells), shape.tobytes())
    return lattice, tiles.tolist()


def _changed(coded: LatticeNodes, lattice: Lattice, bases: list[TileNodes]) -> list[Nodes]:
    """The nodes of one lattice in some tiles, after the changes."""
    n_cells = math.prod(lattice.cells)
    held = [base.get(lattice, _NO_NODES) for base in bases]
    places = np.concatenate([_NO_NODES.places, *(n.places + t * n_cells for t, n in enumerate(held))])
    gaps = _numbers(coded.toggled, "toggled", None)
    # as real numbers, whose sum cannot wrap around
    if (gaps < 1).any() or gaps.sum(dtype=np.float64) > n_cells * len(bases):
        raise BadReplyError("tiles: nodes that are not in order, or beyond their lattice")
    toggled = np.cumsum(gaps) - 1
    stays = ~np.isin(places, toggled, assume_unique=True)
    new = toggled[~np.isin(toggled, places, assume_unique=True)]
    n = int(np.count_nonzero(stays))
    steps = []
    for before, changes, fresh in (
        ([nodes.mean for nodes in held], coded.mean_changes, coded.new_means),
        ([nodes.var for nodes in held], coded.var_changes, coded.new_vars),
    ):
        old = np.concatenate([_NO_NODES.mean, *before])[stays] + _signed(changes, n)
        steps.append(np.concatenate([old, _signed(fresh, len(new))]))
    places = np.concatenate([places[stays], new])
    order = np.argsort(places, kind="stable")
    places, mean, var = places[order], steps[0][order], steps[1][order]
    cuts = np.searchsorted(places, n_cells * np.arange(len(bases) + 1))
    return [
        Nodes(places[a:b] - t * n_cells, mean[a:b].copy(), var[a:b].copy())  # not views of the whole part
        for t, (a, b) in enumerate(itertools.pairwise(cuts.tolist()))
    ]


def _signed(packed: Packed, n: int) -> Int64:
    """Numbers of either sign, of which 2 n is n and 2 n - 1 is -n."""
    numbers = _numbers(packed, "changes", n)
    if (numbers < 0).any() or (numbers > _MOST_STEPS).any():
        raise BadReplyError("tiles: weights that no map has")
    return np.where(numbers & 1, -(numbers >> 1) - 1, numbers >> 1)


def _numbers(packed: Packed, name: str, n: int | None) -> Int64:
    return unpack_array(packed, name, dtypes=(DType.INT64,), shape=(n,), max_elements=2 * MAX_PART_KERNELS)
