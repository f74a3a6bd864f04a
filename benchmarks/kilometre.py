"""A kilometre of a made-up town: what memory its map takes, whether a road driven again adds to it, and what a restart takes.

    python benchmarks/kilometre.py [--scans 1000] [--again 200] [--sensor hdl64] [--json FILE]

`potserver serve` runs as a process of its own with a store. A robot drives the kilometre once, and then the beginning of the
same road again with other noise. The server's memory is read from its statistics, in kilobytes from the first scan on. Then
the server ends and starts anew, and is killed and starts anew, by the times in its own log.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import signal
import sys
import tempfile
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.server_process import ServerProcess
from benchmarks.shared import keep, parser_of
from potclient import MapClient
from potclient.datasets import RecordedScan, open_dataset

_EVERY = 100  # scans between two readings
_TIMEOUT_S = 120.0


def main() -> int:
    options = _options()
    recording = open_dataset(
        f"town:{options.style}:{options.sensor}:{options.length:g}m:{options.seed}", max_range_m=25.0
    )
    numbers = np.linspace(0, len(recording) - 1, options.scans).astype(int).tolist()
    with tempfile.TemporaryDirectory() as folder:
        flags = ("serve", "--listen", "tcp/127.0.0.1:0", "--store", folder, "--log-format", "json")
        server = ServerProcess(*flags)
        try:
            found = _drive(server, recording, numbers, options)
            found["restart"] = {}
            for name, number in (("after its end", signal.SIGTERM), ("after a kill", signal.SIGKILL)):
                server.end(number)
                server = ServerProcess(*flags)
                found["restart"][name] = _start(server)
        finally:
            server.close()
    _print(found)
    keep(options, found)
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("--style", default="terraces")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--sensor", default="hdl64")
    parser.add_argument("--length", type=float, default=1000.0, metavar="M", help="of the drive [1000]")
    parser.add_argument("--scans", type=int, default=1000, help="on it [1000]")
    parser.add_argument("--again", type=int, default=200, help="scans of its beginning once more [200]")
    return parser.parse_args()


def _drive(
    server: ServerProcess, recording: Any, numbers: list[int], options: argparse.Namespace
) -> dict[str, Any]:
    """Every scan to its receipt; the memory on the way."""
    endpoint = str(server.event("server_started")["endpoints"][0])
    readings: list[dict[str, Any]] = []
    times_ms = []
    with MapClient(endpoint, timeout_s=_TIMEOUT_S) as client:
        client.wait_ready(_TIMEOUT_S)
        before = client.stats().rss_bytes
        drive = [*numbers, *numbers[: options.again]]
        for k, number in enumerate(track(drive, description="scans", console=Console(stderr=True))):
            scan = recording[number] if k < len(numbers) else _shaken(recording[number], number)
            began_s = time.perf_counter()
            client.integrate(scan.points, scan.T_map_sensor, is_return=scan.is_return)
            times_ms.append((time.perf_counter() - began_s) * 1e3)
            if (k + 1) % _EVERY == 0:
                kb = (client.stats().rss_bytes - before) / 1e3
                readings.append({"scans": k + 1, "kb": round(kb), "kernels": client.info().n_kernels})
                print(_line(readings[-1]), flush=True)
    return {"before_kb": round(before / 1e3), "readings": readings, "integrate_ms": times_ms}


def _shaken(scan: RecordedScan, seed: int) -> RecordedScan:
    """The scan with two centimetres of noise along its beams: nobody measures the same twice."""
    range_m = np.linalg.norm(scan.points, axis=1, keepdims=True)
    noise = np.random.default_rng(seed).normal(0.0, 0.02, range_m.shape)
    return dataclasses.replace(scan, points=(scan.points * (1.0 + noise / range_m)).astype(np.float32))


def _start(server: ServerProcess) -> dict[str, float]:
    """Seconds of the processor and of the clock until a server is there, and of that for its map."""
    began = server.event("server_starting")
    restored = server.event("map_restored")
    ready = server.event("server_started")
    return {
        "ready_s": (_at(ready) - _at(began)).total_seconds(),
        "map_s": restored["elapsed_ms"] / 1e3,
        "replayed": restored["n_replayed"],
    }


def _at(event: dict[str, Any]) -> datetime.datetime:
    return datetime.datetime.fromisoformat(event["timestamp"].replace("Z", "+00:00"))


def _line(reading: dict[str, Any]) -> str:
    return f"{reading['scans']:5d} scans: {reading['kb'] / 1e3:+.0f} MB, {reading['kernels']:,} kernels"


def _print(found: dict[str, Any]) -> None:
    print(f"before the first scan: {found['before_kb'] / 1e3:.0f} MB")
    print(f"a scan to its receipt: median {np.median(found['integrate_ms']):.0f} ms")
    for name, start in found["restart"].items():
        print(f"restart {name}: " + ", ".join(f"{key} {value:g}" for key, value in start.items()))


if __name__ == "__main__":
    sys.exit(main())
