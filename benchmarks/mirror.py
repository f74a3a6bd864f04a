"""How many bytes it takes to keep a copy of a map that grows: one update of a mirror after each scan, through a server.

    python benchmarks/mirror.py DATASET [--max-range 25] [--step 0.0625 | --exact] [--every 1] [--json FILE]

The server runs in this process, the client asks it over loopback. A fifth of each scan's beams is held out, so that the map is
the one of the accuracy tables; at those points the mirror's answers are compared with the server's own.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time

import numpy as np
from rich.console import Console
from rich.progress import track

from benchmarks.shared import keep, parser_of
from potclient import MapClient
from potclient.datasets import open_dataset
from potclient.holdout import HoldOut
from potclient.questions.tiles import MIRROR_STEP
from potserver.config import Settings
from potserver.mapping.settings import MappingSettings
from potserver.server import MapServer

_COMPARED = 20_000  # points at most
_TIMEOUT_S = 120.0


def main() -> int:
    options = _options()
    recording = open_dataset(options.dataset, min_range_m=options.min_range, max_range_m=options.max_range)
    settings = dataclasses.replace(Settings(), mapping=MappingSettings(max_range_m=options.max_range))
    hold_out, held, updates = HoldOut(), [], []
    with (
        MapServer(settings, listen="tcp/127.0.0.1:0") as server,
        MapClient(server.endpoint, timeout_s=_TIMEOUT_S) as client,
    ):
        mirror = client.mirror(step=None if options.exact else options.step)
        numbers = range(0, len(recording), options.every)
        for k in track(numbers, description=options.dataset, console=Console(stderr=True)):
            scan, labels = hold_out.split(recording[k], k)
            held.append(labels.points)
            client.integrate(scan.to_send, scan.T_map_sensor, is_return=scan.is_return)
            started = time.perf_counter()
            update = mirror.update()
            updates.append((update.n_bytes, update.n_kernels, (time.perf_counter() - started) * 1e3))
        at_once = client.mirror(step=None if options.exact else options.step).update()
        points = np.concatenate(held)
        points = points[np.random.default_rng(0).permutation(len(points))[:_COMPARED]]
        here, there = mirror.occupancy(points), client.occupancy(points)
        both = here.observed & there.observed
        off = np.abs(here.mean - there.mean)[both]
        found = {
            "scans": len(updates),
            "kernels": len(mirror.kernels),
            "bytes_at_once": at_once.n_bytes,
            "update_bytes": [n for n, _, _ in updates],
            "update_kernels": [n for _, n, _ in updates],
            "update_ms": [ms for _, _, ms in updates],
            "largest_difference": float(off.max()),
            "mean_difference": float(off.mean()),
            "observed_by_one_alone": float((here.observed != there.observed).mean()),
        }
    _print(found, options)
    keep(options, found)
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("dataset", metavar="DATASET")
    parser.add_argument("--min-range", type=float, default=0.0, metavar="M")
    parser.add_argument("--max-range", type=float, default=25.0, metavar="M")
    parser.add_argument("--every", type=int, default=1, help="take every so many scans [1]")
    parser.add_argument("--step", type=float, default=MIRROR_STEP, help=f"of the weights [{MIRROR_STEP}]")
    parser.add_argument("--exact", action="store_true", help="weights as they are")
    return parser.parse_args()


def _print(found: dict, options: argparse.Namespace) -> None:
    size, took = np.array(found["update_bytes"]), np.array(found["update_ms"])
    kernels, at_once = found["kernels"], found["bytes_at_once"]
    weights = "exact weights" if options.exact else f"weights in steps of {options.step:g}"
    print(f"{options.dataset}: {found['scans']} scans, {kernels:,} kernels, {weights}")
    print(
        f"at once {at_once / 1e3:.0f} kB, {at_once / kernels:.1f} bytes a kernel ({40 * kernels / 1e3:.0f} kB plain)"
    )
    print(
        f"an update: median {np.median(size) / 1e3:.0f} kB [{size.min() / 1e3:.0f}-{size.max() / 1e3:.0f}],"
        f" {np.median(took):.0f} ms [{took.min():.0f}-{took.max():.0f}]"
    )
    print(
        f"the mirror's probabilities are off by {found['largest_difference']:.2g} at most,"
        f" {found['mean_difference']:.2g} on average; of {found['observed_by_one_alone']:.2%} of the points only one side says"
        " anything"
    )


if __name__ == "__main__":
    sys.exit(main())
