"""What a short question waits for while others ask for much, and while all goes wrong that may.

    python benchmarks/fairness.py --grids 8 --seconds 30
    python benchmarks/fairness.py --grids 8 --seconds 30 --faults
    python benchmarks/fairness.py --grids 0 --beside rays rays risk risk params params tiles tiles

`potserver serve` runs as a process of its own, and is fed some scans. Then every asker is a process with a session of its own:
some ask for grids of 3.3 million cells again and again, one for 190,000 points, and one for 100 points, ten times a second.
With `--faults` a robot sends clouds, sessions come and go, somebody sends hostile messages, and every other two seconds the
disk refuses all that the server writes; or only some of that, by name. `--beside` adds askers of the largest questions that
a server takes: rays of 4 million steps, paths of 5,000 poses, all kernels, and what differs from 100,000 tiles.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
import json
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import zenoh

from benchmarks.server_process import ServerProcess
from benchmarks.shared import keep, parser_of
from benchmarks.torture_messages import OPS, config_of, mutated
from potclient import MapClient, MapServerError, PotclientError
from potclient.datasets import open_dataset
from potschemas import messages, wire
from potschemas.examples import examples

_LOWER, _UPPER = np.array([-40.0, -40.0, -2.0]), np.array([40.0, 40.0, 6.0])
_TIMEOUT_S = 120.0
FAULTS = ("robot", "churn", "hostile", "disk")
_DISK_S = 2.0  # that the disk refuses, and then takes


def main() -> int:
    """Run, and print what was measured."""
    parser = parser_of(__doc__)
    parser.add_argument("--grids", type=int, default=8, help="askers of grids (default 8)")
    parser.add_argument("--seconds", type=float, default=30.0, help="how long (default 30)")
    parser.add_argument("--scans", type=int, default=20, help="scans in the map (default 20)")
    parser.add_argument(
        "--faults",
        nargs="*",
        choices=FAULTS,
        help="what goes wrong beside (default: nothing; without names: all)",
    )
    parser.add_argument("--beside", nargs="+", choices=LARGE, default=[], help="more askers, one a name")
    parser.add_argument("--asker", choices=_ASKERS, help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.asker:
        _ask(options)
        return 0
    faults = () if options.faults is None else tuple(options.faults) or FAULTS
    found = measure(options.grids, options.seconds, scans=options.scans, faults=faults, beside=options.beside)
    for name, value in found.items():
        print(f"{name}: {value}")
    keep(options, found)
    return 0 if not found["points of 100"]["failed"] else 1


def measure(
    grids: int, seconds: float, *, scans: int = 20, faults: Sequence[str] = (), beside: Sequence[str] = ()
) -> dict[str, Any]:
    """What every kind of asker met, and the server's counters."""
    flags = ("serve", "--listen", "tcp/127.0.0.1:0", "--log-format", "json", "--store")
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(ServerProcess(*flags, folder)) as server:
        endpoint = str(server.event("server_started")["endpoints"][0])
        with MapClient(endpoint, timeout_s=_TIMEOUT_S) as client:
            client.wait_ready()
            for number, scan in zip(
                range(scans), open_dataset("town:suburb", n_generated=scans), strict=False
            ):
                client.integrate(scan.points, scan.T_map_sensor, robot="r1", seq=number)
            info = client.info()
            alone = _run(endpoint, ["points"], min(seconds, 10.0))
            askers = [
                "points",
                "many",
                *["grid"] * grids,
                *beside,
                *(name for name in faults if name in _ASKERS),
            ]
            with _disk_that_refuses(server.popen.pid) if "disk" in faults else contextlib.nullcontext():
                met = _run(endpoint, askers, seconds)
            counters = client.stats().counters
        server.end(signal.SIGTERM)
    return {
        "kernels": info.n_kernels,
        "points of 100, alone": alone["points"],
        "points of 100": met["points"],
        "points of 190,000": met["many"],
        f"grids, {grids} askers": met.get("grid"),
        **{name: met[name] for name in (*dict.fromkeys(beside), *faults) if name in met},
        "server": {
            name: n for name, n in counters.items() if name.startswith(("queries.", "clouds.", "store."))
        },
    }


@contextlib.contextmanager
def _disk_that_refuses(pid: int) -> Iterator[None]:
    """Let no file of a process grow, every other `_DISK_S`."""
    ended = threading.Event()
    hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]

    def run() -> None:
        for size in itertools.cycle((1, hard)):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, hard))
            if ended.wait(_DISK_S):
                break
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (hard, hard))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _run(endpoint: str, askers: list[str], seconds: float) -> dict[str, Any]:
    """What each kind of asker met."""
    command = [sys.executable, __file__, "--endpoint", endpoint, "--seconds", str(seconds), "--asker"]
    processes = [(kind, subprocess.Popen([*command, kind], stdout=subprocess.PIPE)) for kind in askers]
    found: dict[str, list[dict[str, Any]]] = {}
    for kind, process in processes:
        out, _ = process.communicate()
        found.setdefault(kind, []).append(json.loads(out))
    return {kind: _joined(runs) for kind, runs in found.items()}


def _joined(runs: list[dict[str, Any]]) -> dict[str, Any]:
    ms = np.concatenate([run["ms"] for run in runs])
    quantiles = np.percentile(ms, (50, 95, 99, 100)).round(1).tolist() if len(ms) else None
    return {
        "answered": len(ms),
        "by asker": [len(run["ms"]) for run in runs],
        "failed": [error for run in runs for error in run["failed"]],
        "ms p50 p95 p99 max": quantiles,
    }


def _grid(client: MapClient, rng: np.random.Generator, _endpoint: str) -> None:
    client.grid(_LOWER, _UPPER, 0.25)  # 3.3 million cells


def _many(client: MapClient, rng: np.random.Generator, _endpoint: str) -> None:
    client.occupancy(rng.uniform(_LOWER, _UPPER, (190_000, 3)))


def _points(client: MapClient, rng: np.random.Generator, _endpoint: str) -> None:
    centre = rng.uniform(_LOWER / 2, _UPPER / 2)
    client.occupancy(centre + rng.uniform(-2.0, 2.0, (100, 3)))
    time.sleep(0.1)


def _rays(client: MapClient, rng: np.random.Generator, _endpoint: str) -> None:
    directions = rng.normal(size=(15_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    client.rays(rng.uniform(-2.0, 2.0, (15_000, 3)), directions, 25.0, step_m=0.1)


def _risk(client: MapClient, rng: np.random.Generator, _endpoint: str) -> None:
    path = np.tile(np.eye(4), (5_000, 1, 1))
    path[:, :3, 3] = np.linspace(
        [-20.0, rng.uniform(-5.0, 5.0), 1.0], [20.0, rng.uniform(-5.0, 5.0), 1.0], 5_000
    )
    client.risk(path, [[x, 0.0, 0.0, 0.3] for x in np.linspace(-1.0, 1.0, 8)])


def _params(client: MapClient, rng: np.random.Generator, _endpoint: str) -> None:
    client.params()


def _tiles(client: MapClient, rng: np.random.Generator, endpoint: str) -> None:
    epoch = getattr(_tiles, "epoch", 0)
    known = np.append(rng.integers(-10_000, 10_000, (3, 100_000)), np.ones((1, 100_000), np.int64), axis=0)
    query = wire.encode(messages.TilesQuery(known=wire.pack_array(known), epoch=epoch))
    for reply in _mallory(endpoint)[0].get(client.keys.query("tiles"), payload=query, timeout=_TIMEOUT_S):
        if reply.ok is None:
            raise MapServerError(str(reply.err))
        _tiles.epoch = wire.decode(reply.ok.payload.to_bytes(), messages.TilesPart).epoch  # type: ignore[attr-defined]


def _robot(client: MapClient, rng: np.random.Generator, _endpoint: str) -> None:
    points = rng.normal(size=(5000, 3)) * [8.0, 6.0, 0.5]
    with contextlib.suppress(MapServerError):  # the disk refused it: it says so
        client.integrate(points, np.eye(4), robot="r2")


def _churn(_client: MapClient, rng: np.random.Generator, endpoint: str) -> None:
    with MapClient(endpoint, timeout_s=_TIMEOUT_S) as another:
        another.occupancy(rng.uniform(-2.0, 2.0, (100, 3)))


def _hostile(client: MapClient, rng: np.random.Generator, endpoint: str) -> None:
    session, golden, chance = _mallory(endpoint)
    payload = mutated(chance.choice(golden), golden, chance)
    list(session.get(client.keys.query(chance.choice(OPS)), payload=payload, timeout=_TIMEOUT_S))


@functools.cache
def _mallory(endpoint: str) -> tuple[zenoh.Session, list[bytes], random.Random]:
    golden = [wire.encode(message) for message in examples().values()]
    return zenoh.open(config_of(endpoint)), golden, random.Random(0)


LARGE = ("rays", "risk", "params", "tiles")
_ASKERS: dict[str, Callable[[MapClient, np.random.Generator, str], None]] = {
    "grid": _grid,
    "many": _many,
    "points": _points,
    "rays": _rays,
    "risk": _risk,
    "params": _params,
    "tiles": _tiles,
    "robot": _robot,
    "churn": _churn,
    "hostile": _hostile,
}


def _ask(options: argparse.Namespace) -> None:
    """Ask one thing again and again; on stdout, what it met."""
    rng, ms, failed = np.random.default_rng(0), [], []
    with MapClient(options.endpoint, timeout_s=_TIMEOUT_S) as client:
        client.wait_ready()
        client.occupancy([[0.0, 0.0, 0.0]])
        until = time.monotonic() + options.seconds
        while (started := time.monotonic()) < until:
            try:
                _ASKERS[options.asker](client, rng, options.endpoint)
            except PotclientError as error:
                failed.append(f"{type(error).__name__}: {error}")
            else:
                took = time.monotonic() - started - (0.1 if options.asker == "points" else 0.0)
                ms.append(took * 1e3)
    print(json.dumps({"ms": ms, "failed": failed}))


if __name__ == "__main__":
    sys.exit(main())
