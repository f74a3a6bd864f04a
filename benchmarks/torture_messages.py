"""Hostile messages: golden ones, cut off, flipped, spliced, nested and swollen, sent to a server over Zenoh.

Every query must get an answer or a typed error, every cloud a receipt; none may meet a bug, and the map must answer after
as before.
"""

from __future__ import annotations

import queue
import random
from collections.abc import Callable

import numpy as np
import zenoh

from benchmarks.torture_store import Outcomes
from potclient import MapClient
from potschemas import keys, messages, wire
from potschemas.examples import examples
from potserver.config import load_settings
from potserver.server import MapServer

OPS = ("points", "grid", "rays", "risk", "params", "tiles", "atoms", "info")
_ANSWER_S = 30.0
_ROBOT = "mallory"
_SETTINGS = {
    "mapping.max_range_m": 15.0,
    "mapping.beams_per_scan": 100,
    "mapping.tile_size_m": 10.0,
    "queries.max_rate_hz": 1e6,
}


def torture_messages(n: int, seed: int, show: Callable[[str], None]) -> list[Outcomes]:
    """Send `n` hostile messages, a third of them clouds."""
    rng = random.Random(seed)
    golden = [wire.encode(message) for message in examples().values()]
    clouds = [wire.encode(m) for m in examples().values() if isinstance(m, messages.Cloud)]
    queries, receipts = Outcomes("hostile queries"), Outcomes("hostile clouds")
    with (
        MapServer(load_settings(overrides=_SETTINGS), listen="tcp/127.0.0.1:0") as server,
        MapClient(server.endpoint) as client,
        zenoh.open(config_of(server.endpoint)) as session,
    ):
        map_keys = keys.MapKeys(keys.DEFAULT_ROOT, "default")
        told: queue.Queue[messages.Receipt] = queue.Queue()
        channel = session.declare_subscriber(map_keys.receipt(_ROBOT), lambda s: told.put(_receipt(s)))
        points = np.random.default_rng(seed).normal(size=(500, 3)) * [5.0, 5.0, 0.5]
        client.integrate(points, np.eye(4), robot="r1")
        for i in range(n):
            if i % 3:
                op = rng.choice(OPS)
                fitting = [wire.encode(m) for m in examples().values() if m.schema == f"pot.{op}_query.v1"]
                payload = mutated(rng.choice(fitting if rng.random() < 0.8 else golden), golden, rng)
                _note(queries, _asked(session, map_keys.query(op), payload), f"{op}: {payload[:60]!r}")
            else:
                payload = mutated(rng.choice(clouds), golden, rng)
                session.put(map_keys.cloud(_ROBOT), payload)
                receipt = told.get(timeout=_ANSWER_S)
                _note(receipts, receipt.reason or receipt.status.value, f"cloud: {payload[:60]!r}")
            if i % 500 == 0:
                show(f"{i} of {n} messages, {len(queries.wrong) + len(receipts.wrong)} wrong")
        channel.undeclare()
        after = client.occupancy(points)
        if not np.isfinite(after.mean).all() or client.info().n_scans < 1:
            queries.wrong.append("the map does not answer after it as before")
    return [queries, receipts]


def mutated(payload: bytes, others: list[bytes], rng: random.Random) -> bytes:
    """A message that is none any more, or one with other numbers."""
    data = bytearray(payload)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        place = rng.randrange(len(data) + 1)
        kind = rng.choice((0, 1, 1, 2, 3, 4, 5, 6, 6, 6))
        if kind == 0:
            del data[place:]
        elif kind == 1 and place < len(data):
            data[place] ^= 1 << rng.randrange(8)
        elif kind == 2:
            data[place:place] = rng.randbytes(rng.randint(1, 8))
        elif kind == 3:
            other = rng.choice(others)
            data[place:] = other[rng.randrange(len(other)) :]
        elif kind == 4:  # a length that is not there: bin, array, map and string headers of 32 bits
            data[place : place + 5] = bytes([rng.choice((0xC6, 0xDD, 0xDF, 0xDB))]) + rng.randbytes(4)
        elif kind == 5:  # deeper than any message
            data[place:place] = bytes([rng.choice((0x91, 0x81))]) * rng.randint(10, 3000)
        else:  # NaN, infinity, and the largest of numbers
            special = rng.choice((b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"\xff\xff\x7f\x7f"))
            data[place : place + 4] = special
    return bytes(data)


def _note(outcome: Outcomes, word: str, what: str) -> None:
    outcome.counts[word] += 1
    if word in ("internal", "no answer"):
        outcome.wrong.append(f"{word}: {what}")


def _asked(session: zenoh.Session, key: str, payload: bytes) -> str:
    """What became of a query: `ok`, the code of its error, or `no answer`."""
    word = "no answer"
    for reply in session.get(key, payload=payload, timeout=_ANSWER_S):
        if reply.ok is not None:
            word = "ok"
        elif reply.err is not None:
            word = wire.decode(reply.err.payload.to_bytes(), messages.ErrorReply).code.value
    return word


def _receipt(sample: zenoh.Sample) -> messages.Receipt:
    return wire.decode(sample.payload.to_bytes(), messages.Receipt)


def config_of(endpoint: str) -> zenoh.Config:
    """Of a client's session."""
    config: zenoh.Config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    return config
