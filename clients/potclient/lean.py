"""The lean of a map's tiles, from messages and back."""

from __future__ import annotations

import numpy as np

from potclient.errors import BadReplyError
from potschemas.lean import LeanTiles, TileIndex
from potschemas.messages import DType, Lean
from potschemas.wire import WireError, pack_array, unpack_array

_MOST_TILES, _MOST_NODES = 100_000, 2**28  # of one message


def lean_from_message(message: Lean) -> tuple[LeanTiles, dict[TileIndex, int]]:
    """The leans in a message, and the revisions of their tiles.

    Raises:
        BadReplyError: arrays of the wrong form, too few nodes, or a tile twice.
    """
    try:
        columns = unpack_array(
            message.tiles, "lean.tiles", dtypes=(DType.INT64,), shape=(4, None), max_elements=4 * _MOST_TILES
        )
        nodes = unpack_array(
            message.nodes,
            "lean.nodes",
            dtypes=(DType.UINT8,),
            shape=(columns.shape[1], None, None, None),
            max_elements=_MOST_NODES,
        )
    except WireError as error:
        raise BadReplyError(str(error)) from error
    rows = [((x, y, z), revision) for x, y, z, revision in columns.T.tolist()]
    found = {index: own.copy() for (index, _), own in zip(rows, nodes, strict=True)}
    if len(found) != len(rows) or min(nodes.shape[1:]) < 2:
        raise BadReplyError("lean: a tile that comes twice, or fewer than two nodes along an axis")
    return LeanTiles(message.tile_size_m, found), dict(rows)


def lean_to_message(lean: LeanTiles) -> Lean:
    """The wire form of at least one tile's lean; revisions are 0."""
    index = np.array(list(lean.nodes), np.int64)
    return Lean(
        tile_size_m=lean.tile_size_m,
        tiles=pack_array(np.column_stack([index, np.zeros(len(index), np.int64)]).T),
        nodes=pack_array(np.stack(list(lean.nodes.values())), repeats=True),
    )
