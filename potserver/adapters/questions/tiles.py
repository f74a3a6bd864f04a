"""`q/tiles`: what of the map's tiles differs from what the asker has, in parts."""

from __future__ import annotations

import numpy as np

from potschemas import messages, wire
from potschemas.messages import DType
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.tiles import KnownTiles, TileRun, Tiles, TilesPlan
from potserver.codec.base import typed_errors
from potserver.codec.kernels import code_kernels, encode_lean
from potserver.codec.tile_changes import code_changes
from potserver.errors import BadMessageError
from potserver.limits import Limits


def decode_tiles(query: messages.TilesQuery) -> Tiles:
    """What is asked.

    Raises:
        BadMessageError: tiles are known, and their epoch is not said.
        ShapeError, TooLargeError: of the known tiles.
    """
    known = None
    if query.known is not None:
        if query.epoch is None:
            raise BadMessageError("pot.tiles_query.v1: `known` needs the `epoch` that its revisions are of")
        with typed_errors():
            columns = wire.unpack_array(
                query.known,
                "known",
                dtypes=(DType.INT64,),
                shape=(4, None),
                max_elements=4 * Limits.max_query_tiles,
            )
        known = KnownTiles(query.epoch, columns[:3].T, columns[3])
    step = None if query.step is messages.ABSENT else query.step
    return Tiles(known, query.lower, query.upper, step)


def encode_part(plan: TilesPlan, number: int, run: TileRun) -> messages.TilesPart:
    """One part of the reply; the tiles that are gone travel in part 0."""
    return messages.TilesPart(
        part=number,
        n_parts=plan.n_parts,
        epoch=plan.epoch,
        map_revision=plan.map_revision,
        whole=plan.is_whole,
        tile_size_m=float(plan.tile_size_m),
        tiles=wire.pack_array(np.vstack([run.indices.T, run.revisions])),
        counts=wire.pack_array(run.counts),
        gone=wire.pack_array(plan.gone.T) if number == 0 and len(plan.gone) else None,
        kernels=code_kernels(run.kernels, plan.spacings_m),
        changes=messages.ABSENT if plan.coding is None else code_changes(run.changes, plan.coding.steps),
        lean=messages.ABSENT if run.leans is None else encode_lean(*run.leans),
        **plan.rule.fields(),
    )


def _plan(asked: Asked, query: messages.TilesQuery) -> TilesPlan:
    size_m = asked.served.mapper.settings.tile_size_m
    return decode_tiles(query).plan(asked.state, asked.limits, asked.served.tiles, tile_size_m=size_m)


# the plan looks at every tile of the map
QUESTION = Question(op="tiles", query=messages.TilesQuery, plan=_plan, each=encode_part, is_quick=False)
