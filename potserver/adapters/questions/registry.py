"""All kinds of questions: a new one is a file beside this one, and a line here."""

from __future__ import annotations

from typing import Any

import numpy as np

from potserver.adapters.questions import atoms, grid, info, params, points, rays, risk, tiles
from potserver.adapters.questions.question import Question
from potserver.domain.kernel_map import KernelMap
from potserver.domain.tiles import COARSE, MapKernels, Tile, TiledMap, TileGrid
from potserver.domain.types import KernelSet
from potserver.mapping.placing import kernels_at
from potserver.numerics.evidence import Rows

QUESTIONS: tuple[Question[Any], ...] = (
    points.QUESTION,
    grid.QUESTION,
    rays.QUESTION,
    risk.QUESTION,
    params.QUESTION,
    tiles.QUESTION,
    atoms.QUESTION,
    info.QUESTION,
)


def warm_up() -> None:
    """Compile what the answers use, so that the first question of a kind does not wait for that."""
    on_lattice, off_lattice = (
        kernels_at(np.full((1, 3), 0.5), 1.0, 1.0),
        kernels_at(np.zeros((1, 3)), 0.9, 1.0),
    )
    grid = TileGrid.of(10.0, 1.0)
    tile = Tile(Rows.empty(), MapKernels.new(KernelSet.concatenate([on_lattice, off_lattice]), COARSE))
    tiled = TiledMap.empty(grid).with_tiles({(0, 0, 0): tile, (9, 0, 0): tile})
    kernels = KernelMap(list(tiled.parts.values()), threads=1)
    for question in QUESTIONS:
        if question.warm_up is not None:
            question.warm_up(kernels)
