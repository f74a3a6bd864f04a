"""What sessions leave behind in a server, and how their processes end.

    python benchmarks/sessions.py --sessions 500 --at-once 4

`potserver serve` runs as a process of its own. Robots come one after the other, each a process with a session of its own,
which sends ten clouds of 60 kilobytes, follows its receipts, asks, and closes its client and leaves while one of its threads is
asking still. The server's memory is read from its statistics; every exit code but 0 is told.
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import contextlib
import subprocess
import sys
import threading
from typing import Any

import numpy as np

from benchmarks.server_process import serving
from benchmarks.shared import keep, parser_of
from potclient import MapClient, PotclientError

_SCENE_POINTS = 5_000  # on a sphere: the map is done after the first few


def main() -> int:
    """Run, and print what was measured."""
    parser = parser_of(__doc__)
    parser.add_argument("--sessions", type=int, default=500, help="how many (default 500)")
    parser.add_argument("--at-once", type=int, default=2, help="at the same time (default 2)")
    parser.add_argument("--shm", action="store_true", help="with shared memory")
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    parser.add_argument("--robot", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.endpoint:
        _live(options)
        return 0
    found = measure(options.sessions, options.at_once, shm=options.shm)
    for name, value in found.items():
        print(f"{name}: {value}")
    keep(options, found)
    return 1 if set(found["exit codes"]) - {"0"} else 0


def measure(sessions: int, at_once: int, *, shm: bool = False) -> dict[str, Any]:
    """Let sessions come and go: their exit codes, and the server's memory after some of them."""
    with serving("--in-memory", *(("--shm",) if shm else ())) as endpoint:
        return _measure(endpoint, sessions, at_once, shm)


def _measure(endpoint: str, sessions: int, at_once: int, shm: bool) -> dict[str, Any]:
    codes: collections.Counter[str] = collections.Counter()
    rss_mb: dict[int, float] = {}
    command = [sys.executable, __file__, "--endpoint", endpoint, *(["--shm"] if shm else [])]

    def live(number: int) -> str:
        run = subprocess.run([*command, "--robot", f"r{number % 4}"], capture_output=True, timeout=300)
        return f"{run.returncode}" if run.returncode == 0 else f"{run.returncode} {run.stderr[-300:]!r}"

    with (
        MapClient(endpoint, timeout_s=60.0) as client,
        concurrent.futures.ThreadPoolExecutor(at_once) as pool,
    ):
        client.wait_ready(60.0)
        for number, code in enumerate(pool.map(live, range(sessions)), start=1):
            codes[code] += 1
            if number in (20, 50, 100, 200) or number == sessions:
                rss_mb[number] = round(client.stats().rss_bytes / 2**20, 1)
    return {"exit codes": dict(codes), "server's memory after so many sessions, MiB": rss_mb}


def _live(options: argparse.Namespace) -> None:
    """One robot's session."""
    from potclient.session import SessionOptions

    rng = np.random.default_rng(1)
    directions = rng.normal(size=(_SCENE_POINTS, 3))
    points = (5.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    session = SessionOptions(connect=(options.endpoint,), shared_memory=True if options.shm else None)
    with MapClient(options=session, timeout_s=60.0) as client:
        client.wait_ready(60.0)
        for _ in range(10):  # shared memory comes into use with the third or so
            client.publish(points, np.eye(4), robot=options.robot, wait=True)
        client.flush(60.0)
        client.watch_revisions(lambda _: None)
        asking = threading.Thread(target=_ask, args=(client, points), daemon=True)
        asking.start()
        client.publish(points, np.eye(4), robot=options.robot)  # has no receipt when the client closes
        client.occupancy(points[:100])


def _ask(client: MapClient, points: np.ndarray) -> None:
    """Is in the middle of a question when the client closes."""
    with contextlib.suppress(PotclientError):
        while True:
            client.occupancy(np.tile(points, (10, 1)))


if __name__ == "__main__":
    sys.exit(main())
