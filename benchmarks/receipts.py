"""What a robot gets back for a scan: how good it is, its bytes, and what it costs.

    python benchmarks/receipts.py kitti_raw_drive0005 --min-range 2.5 [--every 4]
    python benchmarks/receipts.py town:terraces:300m:11 --json receipts.json

Each scan is the first of a map of its own. A fifth of its beams is held back; their ends, and a point on each, uniform from the
sensor to .05 m (protocol 2) or .5 m (protocol 1) before the end, are asked of the kernels that a receipt brings, as a client
decodes them. Beside them: the same fit without the dictionary, and a plain lattice of as many kernels, solved on all beams to
the end. Processor time is that of the parameters alone and of their bytes, on one thread; median of three runs.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.shared import keep, parser_of
from potclient.datasets import RecordedScan
from potclient.kernels import KernelSet
from potclient.metrics import score
from potschemas import messages, wire
from potserver.codec.kernels import encode_own_map
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Float64, ParamsKind
from potserver.evaluation.peers.grid import GridMap
from potserver.mapping.default import DefaultPipeline
from potserver.mapping.fusion import grid_for
from potserver.mapping.pipeline import DEFAULT_RULE, rule_of
from potserver.mapping.sampling import Draws
from potserver.mapping.settings import MappingSettings
from potserver.mapping.stopwatch import Stopwatch
from potserver.recordings import Reader, open_recording, to_scan

GAPS_M = (0.05, 0.5)  # before an end, where no free point is asked about
ASKED_BEAMS = 3_000
HELD_BACK = 0.2
REPEATS = 3


class Told(NamedTuple):
    """What came back."""

    kernels: KernelSet
    n_bytes: int
    cpu_ms: float


def main() -> int:
    options = _options()
    reader = Reader(min_range_m=options.min_range, max_range_m=options.max_range, n_generated=100)
    recording = open_recording(options.dataset, reader)
    rows: list[dict[str, Any]] = []
    last = len(recording) - 1
    for number in np.unique(np.linspace(0.1 * last, last, options.scans).astype(int)).tolist():
        rows += rows_of(recording[number], number, options)
    show(rows)
    keep(options, rows)
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("dataset", metavar="DATASET")
    parser.add_argument("--scans", type=int, default=8, help="of the recording [8]")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="take every n-th beam [1]")
    parser.add_argument("--min-range", type=float, default=0.3, metavar="M")
    parser.add_argument("--max-range", type=float, default=25.0, metavar="M")
    return parser.parse_args()


def rows_of(whole: RecordedScan, number: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """One scan's numbers, a row a way."""
    rng = np.random.default_rng((number, 7))
    beams = np.arange(0, len(whole), options.every)
    is_held = rng.random(len(beams)) < HELD_BACK
    given, held = taken(whole, beams[~is_held]), beams[is_held]
    asked = taken(whole, np.sort(rng.permutation(held)[:ASKED_BEAMS]))
    labels = [labels_on(asked, gap_m, rng) for gap_m in GAPS_M]
    settings = MappingSettings(min_range_m=options.min_range, max_range_m=options.max_range)
    builtin, empty = AtomDictionary.builtin(), AtomDictionary()
    fitted = told(given, settings, builtin, ParamsKind.FITTED)
    ways = {
        "transported": told(given, settings, builtin, ParamsKind.TRANSPORTED),
        "fitted": fitted,
        "fitted, no dictionary": told(given, settings, empty, ParamsKind.FITTED),
    }
    rows = []
    for name, way in ways.items():
        answers = [way.kernels.occupancy(points) for points, _ in labels]
        has_lean = way.kernels.lean is not None
        nll = [
            score(a.mean, occupied, None if has_lean else a.observed).nll
            for a, (_, occupied) in zip(answers, labels, strict=True)
        ]
        rows.append(row(name, number, len(way.kernels), way.n_bytes, way.cpu_ms, nll))
    grid = GridMap(threads=1)
    began_s = time.process_time()
    grid.integrate(given)
    grid.finish(len(fitted.kernels))
    cpu_ms = (time.process_time() - began_s) * 1e3
    nll = [score((a := grid.ask(points)).mean, occupied, a.observed).nll for points, occupied in labels]
    size = grid.size()
    return [*rows, row("plain lattice, all beams", number, size.cells, size.n_bytes, cpu_ms, nll)]


def row(way: str, scan: int, n: int, n_bytes: int, cpu_ms: float, nll: list[float]) -> dict[str, Any]:
    numbers = {"kernels": n, "bytes": n_bytes, "cpu_ms": cpu_ms, "nll": nll[0], "nll_protocol_1": nll[1]}
    return {"way": way, "scan": scan, **numbers}


def told(
    given: RecordedScan, settings: MappingSettings, dictionary: AtomDictionary, kind: ParamsKind
) -> Told:
    """What a server sends for the first scan of a map."""
    pipeline, scan = DefaultPipeline(settings, threads=1, seed=0), to_scan(given, 0)
    carrier, spent_ms = pipeline.carrier(dictionary), []
    for _ in range(REPEATS + 1):  # the first one compiles
        seen = pipeline.label(scan, Draws.of(0, 0))
        expected = pipeline.expect(seen, carrier).place
        resolution_m = grid_for(seen.beams.learned, settings.tile_size_m).fine_m
        began_s = time.process_time()
        own = pipeline.own_map(kind, seen, expected, carrier, resolution_m, Stopwatch())
        payload = wire.encode(encode_own_map(own, rule_of(own, DEFAULT_RULE)))
        spent_ms.append((time.process_time() - began_s) * 1e3)
    kernels = KernelSet.from_message(wire.decode(payload, messages.Kernels))
    return Told(kernels, len(payload), float(np.median(spent_ms[1:])))


def taken(scan: RecordedScan, members: Any) -> RecordedScan:
    return dataclasses.replace(scan, points=scan.points[members], is_return=scan.is_return[members])


def labels_on(scan: RecordedScan, gap_m: float, rng: np.random.Generator) -> tuple[Float64, Any]:
    """Ends of beams, and a free point on each; (N, 3) m, map frame, and which are occupied."""
    eye, ends = scan.T_map_sensor[:3, 3], scan.in_map
    length = np.linalg.norm(ends - eye, axis=1)
    share = (rng.random(len(ends)) * (length - gap_m) / length)[:, None]
    free = (eye + share * (ends - eye))[length > gap_m]
    hits = ends[scan.is_return]
    return np.concatenate([hits, free]), np.arange(len(hits) + len(free)) < len(hits)


def show(rows: list[dict[str, Any]]) -> None:
    table = Table(title="what a receipt brings, means over scans +- their deviation")
    for head in ("way", "kernels", "bytes", "CPU ms", "NLL", "protocol 1"):
        table.add_column(head, justify="left" if head == "way" else "right")
    for way in dict.fromkeys(row["way"] for row in rows):
        mine = [row for row in rows if row["way"] == way]
        mean = {name: np.mean([row[name] for row in mine]) for name in mine[0] if name != "way"}
        sd = {name: np.std([row[name] for row in mine]) for name in ("nll", "nll_protocol_1")}
        table.add_row(
            way, f"{mean['kernels']:,.0f}", f"{mean['bytes']:,.0f}", f"{mean['cpu_ms']:.1f}",
            *(f"{mean[name]:.3f} +- {sd[name]:.3f}" for name in sd),
        )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    sys.exit(main())
