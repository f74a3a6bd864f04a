"""Small tiled maps, and the answer to `q/tiles` about them without Zenoh: through the server's codec and the wire."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping

import numpy as np

from potclient.mirror import Ask
from potschemas import messages, wire
from potschemas.answers import AnswerRule
from potserver.adapters.questions.tiles import decode_tiles, encode_part
from potserver.asking.tile_codes import TileMemory
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.tiles import COARSE, MapKernels, Tile, TiledMap, TileGrid, TileIndex
from potserver.domain.types import KernelSet
from potserver.limits import Limits
from potserver.mapping.placing import kernels_at
from potserver.numerics.evidence import Rows

GRID = TileGrid.of(8.0, 0.4)


def lattice_kernels(
    k: int, seed: int = 0, spacing_m: float = GRID.fine_m, *, planar: bool = False
) -> KernelSet:
    """Up to k kernels of a lattice in a tile, with random weights."""
    rng = np.random.default_rng(seed)
    cells = np.unique(rng.integers(0, round(GRID.size_m / spacing_m), (k, 3)), axis=0)
    hinge = (cells + 0.5) * spacing_m
    if planar:
        hinge[:, 2] = 0.3
    n = len(hinge)
    return kernels_at(hinge, spacing_m, 10.0).replace(
        weight_mean=rng.normal(0, 3, n).astype(np.float32),
        weight_var=rng.gamma(2.0, 1.0, n).astype(np.float32),
    )


def free_kernels(k: int, seed: int = 0) -> KernelSet:
    """k kernels in a tile with nothing in common."""
    rng = np.random.default_rng(seed)
    return KernelSet(
        hinge_mean=rng.uniform(0, GRID.size_m, (k, 3)),
        hinge_var=rng.random((k, 3)).astype(np.float32),
        gamma_shape=rng.uniform(1, 9, k).astype(np.float32),
        gamma_rate=rng.uniform(1, 9, k).astype(np.float32),
        weight_mean=rng.normal(size=k).astype(np.float32),
        weight_var=rng.random(k).astype(np.float32),
    )


def tiled_state(
    tiles: Mapping[TileIndex, tuple[KernelSet, int]], *, epoch: int = 1, revision: int = 1
) -> MapState:
    """A map of tiles, each with kernels relative to its corner and the revision at which it was made."""
    placed = {
        index: Tile(Rows.empty(), MapKernels.new(kernels, COARSE), made)
        for index, (kernels, made) in tiles.items()
    }
    moved = [kernels.moved(np.array(index) * GRID.size_m) for index, (kernels, _) in tiles.items()]
    snapshot = KernelMap(
        KernelSet.concatenate(moved),
        rule=AnswerRule(residual_var=20.0, mean_moderation=0.05),
        map_revision=revision,
        threads=1,
    )
    return MapState(snapshot=snapshot, tiled=TiledMap(GRID, placed, {}), epoch=epoch)


def parts_about(
    state: MapState,
    query: messages.TilesQuery,
    part_kernels: int = 20_000,
    memory: TileMemory | None = None,
) -> list[messages.TilesPart]:
    """What a server that holds this map answers."""
    asked = decode_tiles(wire.decode(wire.encode(query), messages.TilesQuery))
    plan = asked.plan(
        state, Limits(), memory or TileMemory(), tile_size_m=GRID.size_m, part_kernels=part_kernels
    )
    parts = [encode_part(plan, number, run) for number, run in enumerate(plan.parts())]
    return [wire.decode(wire.encode(part), messages.TilesPart) for part in parts]


def asking(
    state_now: Callable[[], MapState],
    *,
    part_kernels: int = 20_000,
    spoil: Callable[[list[messages.TilesPart]], Iterable[messages.TilesPart]] = lambda parts: parts,
    memory: TileMemory | None = None,
) -> Ask:
    """The server's side of a mirror; `spoil` may change the reply on its way."""
    remembered = memory or TileMemory()

    def ask(query: messages.TilesQuery) -> Iterator[tuple[messages.TilesPart, int]]:
        for part in spoil(parts_about(state_now(), query, part_kernels, remembered)):
            yield part, len(wire.encode(part))

    return ask
