"""What scans cost, in counts that no machine changes: rows, kernels, tiles and bytes, each at most a fifth more than it was."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import pytest

from potclient.mirror import MapMirror
from potschemas import wire
from potschemas.messages import TilesPart, TilesQuery
from potserver.adapters.questions.tiles import decode_tiles, encode_part
from potserver.adapters.receipts import Waited, encode_accepted, encode_params
from potserver.asking.tile_codes import TileMemory
from potserver.bundled import ROOMS, open_bundled
from potserver.codec.clouds import encode_cloud
from potserver.domain.types import MapUpdate, Scan
from potserver.limits import Limits
from potserver.mapping.service import MappingService
from potserver.recordings import to_scan
from potserver.storage.tile_codec import encode_tile

N_SCANS = 4  # of a room; the fourth comes a second time at the end


@dataclasses.dataclass(frozen=True)
class Done:
    """What was mapped, and what a mirror that followed was sent."""

    service: MappingService
    scan: Scan
    first: MapUpdate  # of the fourth scan
    again: MapUpdate  # of the same scan
    mirror: MapMirror
    update_bytes: list[int]


@pytest.fixture(scope="module")
def done() -> Done:
    service, memory, sizes = MappingService(threads=1), TileMemory(), []

    def ask(query: TilesQuery) -> Iterator[tuple[TilesPart, int]]:
        plan = decode_tiles(query).plan(service.state, Limits(), memory, tile_size_m=10.0)
        for number, run in enumerate(plan.parts()):
            payload = wire.encode(encode_part(plan, number, run))
            yield wire.decode(payload, TilesPart), len(payload)

    mirror = MapMirror(ask, step=0.0625)
    recording = open_bundled(ROOMS)
    scans = [to_scan(recording[min(k, N_SCANS - 1)], k) for k in range(N_SCANS + 1)]
    updates = []
    for scan in scans:
        updates.append(service.integrate(scan))
        sizes.append(mirror.update().n_bytes)
    return Done(service, scans[-1], updates[-2], updates[-1], mirror, sizes)


def counted(done: Done) -> dict[str, float]:
    tiles: dict[Any, Any] = dict(done.service.state.tiled.tiles)  # type: ignore[union-attr]
    n_rows = sum(len(tile.rows.kind) for tile in tiles.values())
    n_kernels = len(done.service.snapshot)
    receipt = encode_accepted("m", done.scan, done.again, Waited(0, 0.0), 1.0, with_kernels=False)
    return {
        "rows a kernel": n_rows / n_kernels,
        "kernels": n_kernels,
        "bytes of a row and kernel in memory": sum(t.n_bytes for t in tiles.values()) / n_kernels,
        "bytes a kernel on the disk": sum(len(encode_tile(i, t)) for i, t in tiles.items()) / n_kernels,
        "bytes a point in the journal": len(encode_cloud(done.scan)) / len(done.scan.points),
        "bytes of a receipt": len(receipt.payload),
        "bytes a returned kernel": len(encode_params("m", done.scan, done.again).payload)
        / len(done.again.kernels),
        "tiles that the same scan changes": len(done.again.changed.tiles) / len(done.first.changed.tiles),
        "kernels that the same scan adds": done.again.n_kernels_added / n_kernels,
        "bytes a kernel of a new mirror": done.update_bytes[0] / len(done.mirror.kernels),
        "bytes a kernel of a mirror's update": done.update_bytes[-1] / len(done.mirror.kernels),
    }


BOUNDS = {
    "rows a kernel": 7.3,
    "kernels": 3_720,
    "bytes of a row and kernel in memory": 373,
    "bytes a kernel on the disk": 106,
    "bytes a point in the journal": 12.2,
    "bytes of a receipt": 270,
    "bytes a returned kernel": 27,
    "tiles that the same scan changes": 1.0,
    "kernels that the same scan adds": 0.01,
    "bytes a kernel of a new mirror": 2.2,
    "bytes a kernel of a mirror's update": 1.15,
}


def test_nothing_costs_more_than_it_did(done: Done) -> None:
    found = counted(done)
    assert found.keys() == BOUNDS.keys()
    assert {name: value for name, value in found.items() if value > BOUNDS[name]} == {}
