"""A robot that stands: what its hundredth scan of the same place costs, step by step.

    python benchmarks/standing.py DATASET [--times 100] [--noise 0.02] [--json FILE]

The same scan enters a map again and again, each time with other noise along its beams, on one thread. Its processor time is
dealt out to the steps by their clocks. What a server adds is timed beside it: decoding, bytes for the journal and back.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.shared import keep, parser_of
from potclient.datasets import open_dataset
from potserver import MappingService, MappingSettings
from potserver.adapters.receipts import Waited, encode_accepted, encode_params
from potserver.codec.clouds import encode_cloud, read_cloud
from potserver.commands.shared import table
from potserver.domain.types import MapUpdate, Scan
from potserver.numerics.threads import use_one_blas_thread
from potserver.recordings import to_scan
from potserver.storage.seal import sealed


def main() -> int:
    use_one_blas_thread()
    options = _options()
    recording = open_dataset(options.dataset, min_range_m=options.min_range, max_range_m=options.max_range)
    first = to_scan(recording[0], 0)
    service = MappingService(settings=MappingSettings(max_range_m=options.max_range), threads=1)
    service.warm_up()
    steps = []
    for k in track(range(options.times), description="scans", console=Console(stderr=True)):
        scan = _shaken(first, options.noise, k)
        began_s = time.process_time()
        update = service.integrate(scan)
        cpu_ms = (time.process_time() - began_s) * 1e3
        share = cpu_ms / sum(update.timings_ms.values())
        of_steps = {name: ms * share for name, ms in update.timings_ms.items()}
        steps.append({**of_steps, "all of the map": cpu_ms, **_around(scan, update)})
    _print(steps)
    keep(options, steps)
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("dataset", metavar="DATASET")
    parser.add_argument("--times", type=int, default=100, help="[100]")
    parser.add_argument("--noise", type=float, default=0.02, metavar="M", help="along the beams [0.02]")
    parser.add_argument("--min-range", type=float, default=2.5, metavar="M")
    parser.add_argument("--max-range", type=float, default=25.0, metavar="M")
    return parser.parse_args()


def _shaken(scan: Scan, noise_m: float, number: int) -> Scan:
    range_m = np.linalg.norm(scan.points, axis=1, keepdims=True)
    noise = np.random.default_rng(number).normal(0.0, noise_m, range_m.shape)
    points = (scan.points * (1.0 + noise / np.maximum(range_m, 0.1))).astype(np.float32)
    return dataclasses.replace(scan, points=points, seq=number, stamp_ns=number * 100_000_000)


def _around(scan: Scan, update: MapUpdate) -> dict[str, float]:
    """Processor ms of what a server does beside the map."""
    found = {}

    def timed(name: str, work: Any) -> Any:
        began_s = time.process_time()
        done = work()
        found[name] = (time.process_time() - began_s) * 1e3
        return done

    payload = timed("encode cloud", lambda: encode_cloud(scan))
    timed("decode cloud", lambda: read_cloud(payload))
    timed("seal for the journal", lambda: sealed(payload))
    timed("receipt", lambda: encode_accepted("m", scan, update, Waited(0, 0.0), 1.0, with_kernels=False))
    timed("parameters", lambda: encode_params("m", scan, update))
    return found


def _print(steps: list[dict[str, float]]) -> None:
    spans = {"first": steps[:1], "2 to 10": steps[1:10], f"last {min(10, len(steps))}": steps[-10:]}
    rows = [
        (name, *(f"{np.median([step[name] for step in some]):.1f}" for some in spans.values()))
        for name in steps[0]
    ]
    Console(width=100).print(table(("ms, medians", *spans), rows, left=(0,)))


if __name__ == "__main__":
    sys.exit(main())
