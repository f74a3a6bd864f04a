"""What has changed of tiles, for the wire."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from potschemas import messages
from potschemas.wire import pack_array
from potserver.asking.tile_codes import Lattice, NodeCodes, Steps, shape_of
from potserver.asking.tiles import Change
from potserver.numerics.arrays import Int64

_NONE = NodeCodes(*(np.zeros(0, np.int64),) * 3)


def code_changes(changes: Sequence[Change], steps: Steps) -> messages.TileChanges:
    """The nodes of some tiles, each relative to its base; see `messages.LatticeNodes`."""
    lattices = {
        lattice: None for c in changes for codes in (c.codes, c.base) if codes for lattice in codes.nodes
    }
    return messages.TileChanges(
        step=steps.mean,
        var_step=steps.var,
        var_unit=steps.var_unit,
        based=pack_array(np.array([c.base is not None for c in changes], np.bool_)),
        lattices=[_lattice_nodes(lattice, changes) for lattice in lattices],
    )


def _lattice_nodes(lattice: Lattice, changes: Sequence[Change]) -> messages.LatticeNodes:
    """One lattice in the tiles that have it now, or had it."""
    both = [
        (c.codes.nodes.get(lattice), None if c.base is None else c.base.nodes.get(lattice)) for c in changes
    ]
    tiles = [t for t, (now, before) in enumerate(both) if now is not None or before is not None]
    now, before = (_joined([both[t][side] for t in tiles], int(np.prod(lattice.cells))) for side in (0, 1))
    toggled = np.setxor1d(now.places, before.places, assume_unique=True)
    _, stays, stayed = np.intersect1d(now.places, before.places, assume_unique=True, return_indices=True)
    is_new = np.ones(len(now.places), np.bool_)
    is_new[stays] = False
    return messages.LatticeNodes(
        shape=pack_array(shape_of(lattice)),
        spacing=lattice.spacing_m,
        offset=list(lattice.offset_m),
        cells=list(lattice.cells),
        tiles=pack_array(np.array(tiles, np.int64)),
        toggled=pack_array(np.diff(toggled, prepend=-1)),
        mean_changes=_packed(now.mean[stays] - before.mean[stayed]),
        var_changes=_packed(now.var[stays] - before.var[stayed]),
        new_means=_packed(now.mean[is_new]),
        new_vars=_packed(now.var[is_new]),
    )


def _joined(sides: Sequence[NodeCodes | None], n_cells: int) -> NodeCodes:
    """The nodes of tile after tile, their places numbered on."""
    found = [codes or _NONE for codes in sides]
    places = [codes.places + t * n_cells for t, codes in enumerate(found)]
    return NodeCodes(
        np.concatenate(places),
        *(np.concatenate([getattr(c, name) for c in found]) for name in ("mean", "var")),
    )


def _packed(signed: Int64) -> messages.Packed:
    """Small numbers of either sign as small numbers without one."""
    return pack_array(np.where(signed >= 0, 2 * signed, -2 * signed - 1))
