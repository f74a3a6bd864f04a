"""Processor time of a scan against other maps', in pairs: each scan enters every map before the next one comes.

    python benchmarks/ratios.py DATASET [--max-range 25] [--peers octomap:0.2,bgk-gap:0.2] [--rounds 3] [--json FILE]

What else the machine does changes both sides of a pair alike, so ratios hold where times do not. All maps have one thread.
DATASET may be a bundled one, as for `potserver eval`.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.shared import keep, machine, parser_of, spread
from potclient.datasets import RecordedScan
from potserver import MappingService
from potserver.commands.shared import table
from potserver.evaluation.mappers import Mapper, ServiceMap
from potserver.evaluation.peers import peer_named
from potserver.numerics.threads import use_one_blas_thread
from potserver.recordings import Reader, open_recording


def main() -> int:
    use_one_blas_thread()
    options = _options()
    reader = Reader(min_range_m=options.min_range, max_range_m=options.max_range)
    scans = list(open_recording(options.dataset, reader))
    found: dict[str, Any] = {"machine": machine(), "dataset": options.dataset, "cpu_ms": {}}
    for _ in track(range(options.rounds), description="rounds", console=Console(stderr=True)):
        for name, cpu_ms in _round(scans, options).items():
            found["cpu_ms"].setdefault(name, []).extend(cpu_ms)
    _print(found)
    keep(options, found)
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("dataset", metavar="DATASET")
    parser.add_argument("--peers", default="octomap:0.2", help="as for `potserver eval` [octomap:0.2]")
    parser.add_argument(
        "--rounds", type=int, default=3, help="through the whole dataset, into empty maps [3]"
    )
    parser.add_argument("--min-range", type=float, default=0.0, metavar="M")
    parser.add_argument("--max-range", type=float, metavar="M")
    return parser.parse_args()


def _round(scans: list[RecordedScan], options: argparse.Namespace) -> dict[str, list[float]]:
    """Processor ms of each scan, by map."""
    mappers: list[Mapper] = [ServiceMap("default", MappingService(threads=1))]
    mappers += [peer_named(text, threads=1) for text in options.peers.split(",")]
    for mapper in mappers:
        mapper.warm_up(planar=scans[0].is_planar)
    cpu_ms: dict[str, list[float]] = {mapper.name: [] for mapper in mappers}
    for scan in scans:
        for mapper in mappers:
            began_s = time.process_time()
            mapper.integrate(scan)
            cpu_ms[mapper.name].append((time.process_time() - began_s) * 1e3)
    return cpu_ms


def _print(found: dict[str, Any]) -> None:
    ours = np.array(found["cpu_ms"]["default"])
    rows = [
        (name, spread(ms), "" if name == "default" else spread(ours / np.array(ms), digits=2))
        for name, ms in found["cpu_ms"].items()
    ]
    console = Console(width=100)
    console.print(table(("map", "CPU ms a scan", "ours / its"), rows, left=(0,)))
    console.print(f"{found['dataset'].rsplit('/', 1)[-1]}, {len(ours)} pairs: {found['machine']}")


if __name__ == "__main__":
    sys.exit(main())
