"""What a short question waits for while others ask for much.

    python benchmarks/fairness.py --grids 8 --seconds 30

`potserver serve` runs as a process of its own, and is fed some scans. Then every asker is a process with a session of its own:
some ask for grids of 3.3 million cells again and again, one for 190,000 points, and one for 100 points, ten times a second.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

from benchmarks.server_process import serving
from benchmarks.shared import keep, parser_of
from potclient import MapClient, PotclientError
from potclient.datasets import open_dataset

_LOWER, _UPPER = np.array([-40.0, -40.0, -2.0]), np.array([40.0, 40.0, 6.0])
_TIMEOUT_S = 120.0


def main() -> int:
    """Run, and print what was measured."""
    parser = parser_of(__doc__)
    parser.add_argument("--grids", type=int, default=8, help="askers of grids (default 8)")
    parser.add_argument("--seconds", type=float, default=30.0, help="how long (default 30)")
    parser.add_argument("--scans", type=int, default=20, help="scans in the map (default 20)")
    parser.add_argument("--asker", choices=_ASKERS, help=argparse.SUPPRESS)
    parser.add_argument("--endpoint", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.asker:
        _ask(options)
        return 0
    with tempfile.TemporaryDirectory() as folder, serving("--store", folder) as endpoint:
        found = _measure(endpoint, options)
    for name, value in found.items():
        print(f"{name}: {value}")
    keep(options, found)
    return 0 if not found["points of 100"]["failed"] else 1


def _measure(endpoint: str, options: argparse.Namespace) -> dict[str, Any]:
    with MapClient(endpoint, timeout_s=_TIMEOUT_S) as client:
        client.wait_ready()
        for number, scan in zip(
            range(options.scans), open_dataset("town:suburb", n_generated=options.scans), strict=False
        ):
            client.integrate(scan.points, scan.T_map_sensor, robot="r1", seq=number)
        info = client.info()
        alone = _run(endpoint, ["points"], min(options.seconds, 10.0))
        askers = ["points", "many", *["grid"] * options.grids]
        beside = _run(endpoint, askers, options.seconds)
        counters = client.stats().counters
    ends = {name: n for name, n in counters.items() if name.startswith("queries.")}
    return {
        "kernels": info.n_kernels,
        "points of 100, alone": alone["points"],
        "points of 100": beside["points"],
        "points of 190,000": beside["many"],
        f"grids, {options.grids} askers": beside["grid"],
        "server": ends,
    }


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


def _grid(client: MapClient, rng: np.random.Generator) -> None:
    client.grid(_LOWER, _UPPER, 0.25)  # 3.3 million cells


def _many(client: MapClient, rng: np.random.Generator) -> None:
    client.occupancy(rng.uniform(_LOWER, _UPPER, (190_000, 3)))


def _points(client: MapClient, rng: np.random.Generator) -> None:
    centre = rng.uniform(_LOWER / 2, _UPPER / 2)
    client.occupancy(centre + rng.uniform(-2.0, 2.0, (100, 3)))
    time.sleep(0.1)


_ASKERS = {"grid": _grid, "many": _many, "points": _points}


def _ask(options: argparse.Namespace) -> None:
    """Ask one thing again and again; on stdout, what it met."""
    rng, ms, failed = np.random.default_rng(0), [], []
    with MapClient(options.endpoint, timeout_s=_TIMEOUT_S) as client:
        client.wait_ready()
        client.occupancy([[0.0, 0.0, 0.0]])
        until = time.monotonic() + options.seconds
        while (started := time.monotonic()) < until:
            try:
                _ASKERS[options.asker](client, rng)
            except PotclientError as error:
                failed.append(f"{type(error).__name__}: {error}")
            else:
                took = time.monotonic() - started - (0.1 if options.asker == "points" else 0.0)
                ms.append(took * 1e3)
    print(json.dumps({"ms": ms, "failed": failed}))


if __name__ == "__main__":
    sys.exit(main())
