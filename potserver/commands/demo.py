"""`potserver demo`: recorded scans through a real Zenoh session, and what the maps say about beams they never saw."""

from __future__ import annotations

import argparse
import json
import math
import platform
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potclient import MapClient
from potclient.commands.output_files import output_folder
from potclient.datasets import RecordedScan, Recording, open_dataset
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import Metrics, score
from potclient.pictures import draw_layer
from potclient.results import Receipt
from potschemas import __version__
from potschemas.messages import SectorReport
from potserver import bundled
from potserver.commands.shared import (
    EXIT_OK,
    EXIT_UNCLEAN,
    add_verb,
    file_errors,
    positive_int,
    results_console,
    table,
)

if TYPE_CHECKING:
    from rich.console import Console

_ABOUT = (
    "Start a server on loopback, send it recorded scans through a real Zenoh session, and score the maps."
)
_EXAMPLES = """\
examples:
  potserver demo
  potserver demo --scans 2                  a short one
  potserver demo --profile paper
  potserver demo /data/kitti/00 --scans 20"""

_BUNDLED = {
    bundled.STREET: "a street, two real outdoor scans, 3D",
    bundled.ROOMS: "rooms, twelve simulated scans, 3D",
    bundled.PLAN: "the same rooms in 2D, seen from above",
}
_PICTURE_ABOVE_SENSOR_M = {bundled.ROOMS: 0.6}  # that sensor stands on the floor
_PICTURE_CELLS = 400  # along the longer side
_PICTURE_REACH_M = 30.0  # from the middle of the sensor's way
_SPEED_POINTS = 200_000
_SECTORS = "atom and turn of each sector (kernels, W2 in m)"


class _Fed(NamedTuple):
    """A scan that was sent."""

    scan: RecordedScan
    held_out: LabelledPoints
    receipt: Receipt


class _MapResult(NamedTuple):
    name: str
    receipts: list[Receipt]
    labels: LabelledPoints
    mean: NDArray[np.float32]
    observed: NDArray[np.bool_]
    scores: Metrics
    kernels: int
    queries_per_s: float

    @property
    def ms_per_scan(self) -> list[float]:
        return [receipt.message.integrate_ms for receipt in self.receipts]


def add(commands: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        commands, "demo", _run, help="map recorded scans through a real server, and score the maps",
        description=_ABOUT, epilog=_EXAMPLES,
    )  # fmt: skip
    parser.add_argument(
        "datasets", nargs="*", metavar="DATASET", help="recordings to map in place of the bundled ones"
    )
    parser.add_argument("--profile", default="default", metavar="NAME", help="mapping profile [default]")
    parser.add_argument(
        "--scans", type=positive_int, metavar="N", help="at most this many scans of each recording"
    )
    parser.add_argument(
        "--out", type=output_folder, default="out/demo", metavar="FOLDER", help="where results go [out/demo]"
    )


def _run(options: argparse.Namespace) -> int:
    """Map and score; EXIT_OK when every scan was accepted and all files are written."""
    from potserver.config import Settings
    from potserver.log import configure_logging
    from potserver.mapping.settings import MappingSettings
    from potserver.server import MapServer

    console = results_console()
    configure_logging("warning", "console")
    recordings = _recordings(options)
    mapping = MappingSettings.of_profile(options.profile)
    settings = Settings(server_id="demo", maps=tuple(recordings), mapping=mapping)
    out = options.out
    with file_errors(f"make {out}"):
        out.mkdir(parents=True, exist_ok=True)
    _introduce(options, recordings, console)
    started = time.perf_counter()
    with console.status("starting the server (the first time, this compiles the numerics: half a minute)"):
        server = MapServer(settings, listen="tcp/127.0.0.1:0")
        server.start()
    console.print(f"server ready after {time.perf_counter() - started:.1f} s at {server.endpoint}\n")
    try:
        results = [
            _run_map(server.endpoint, name, recording, out, console) for name, recording in recordings.items()
        ]
    finally:
        server.stop()
    summary = _summary(results, options.profile, time.perf_counter() - started)
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    _print_totals(summary, console)
    pictures = ", ".join(f"{out}/{result.name}.png" for result in results)
    console.print(f"\nresults: {out}/summary.json; pictures: {pictures}")
    return EXIT_OK if summary["receipts_accepted"] == summary["scans"] else EXIT_UNCLEAN


def _recordings(options: argparse.Namespace) -> dict[str, Recording]:
    if options.datasets:
        opened = {f"map{i}": open_dataset(path) for i, path in enumerate(options.datasets)}
    else:
        opened = {name: bundled.open_bundled(name) for name in _BUNDLED}
    return {name: recording[: options.scans] for name, recording in opened.items()}


def _introduce(options: argparse.Namespace, recordings: dict[str, Recording], console: Console) -> None:
    console.print(
        f"[bold]potserver {__version__} demo[/bold]: a map server on loopback, and a robot that sends it "
        f"{sum(map(len, recordings.values()))} scans over Zenoh.\n"
        f"A fifth of each scan's beams is held back; at the end the maps are asked about those. Profile: {options.profile}."
    )
    if not options.datasets:
        console.print(
            "The built-in atoms were learned in made-up towns, and some on other beams of the rooms."
        )
    console.print(
        "Here receipts bring kernels carried from atoms; unasked they bring kernels fitted to the scan, which cost less.\n"
        "carried: kernels that the map took from transported atoms; placed: kernels added where those explain nothing;\n"
        "W2: root of the transport cost under the entropic plan, hits plus free points (never 0, the blur counts)."
    )


def _run_map(endpoint: str, name: str, recording: Recording, out: Path, console: Console) -> _MapResult:
    console.print(f"[bold]{name}[/bold]: {_BUNDLED.get(name, str(recording.path))}")
    with MapClient(endpoint, map=name, timeout_s=60.0) as client:
        client.wait_ready(60.0)
        fed = _feed(client, recording, console)
        heads = ("scan", "beams", "ms", "carried", "placed", "in map", _SECTORS)
        console.print(table(heads, [_cells(n, each.receipt) for n, each in enumerate(fed)], left=(6,)))
        labels = LabelledPoints.concatenate([each.held_out for each in fed])
        answer = client.occupancy(labels.points)
        scores = score(answer.mean, labels.occupied, answer.observed)
        queries_per_s = _query_speed(client, labels.points)
        _draw(client, name, [each.scan for each in fed], out)
        n_kernels = client.info().n_kernels
    console.print(
        f"held-out beams: ACC {scores.accuracy:.3f}  AUC {scores.auc:.3f}  NLL {scores.nll:.3f}  ECE {scores.ece:.3f}"
        f"  unknown {scores.share_unknown:.1%}  of {scores.n} points; {queries_per_s:,.0f} queries/s over Zenoh\n"
    )
    receipts = [each.receipt for each in fed]
    return _MapResult(name, receipts, labels, answer.mean, answer.observed, scores, n_kernels, queries_per_s)


def _feed(client: MapClient, recording: Recording, console: Console) -> list[_Fed]:
    """Send all scans without their held-out beams, each when the one before is in the map."""
    hold_out = HoldOut()
    fed = []
    with console.status("") as status:
        for number, recorded in enumerate(recording):
            status.update(f"scan {number + 1} of {len(recording)}")
            scan, labels = hold_out.split(recorded)
            receipt = client.integrate(
                scan.to_send,
                scan.T_map_sensor,
                robot="demo",
                is_return=scan.is_return,
                params="transported",  # to show which atoms fit: by default fitted kernels come back, for half the work
            )
            fed.append(_Fed(scan, labels, receipt))
    return fed


def _cells(number: int, receipt: Receipt) -> list[str]:
    m = receipt.message
    counts = (m.n_kernels_transported, m.n_kernels_added - m.n_kernels_transported, m.map_kernels)
    sectors = "  ".join(map(_sector, (s for s in m.sectors if s.atom_id is not None))) or "none"
    return [str(number), str(m.n_points), f"{m.integrate_ms:.0f}", *map(str, counts), sectors]


def _sector(sector: SectorReport) -> str:
    w2 = math.sqrt(max(sector.w2_m2, 0.0))
    return f"{sector.atom_id} {math.degrees(sector.rotation_rad):+.0f}° ({sector.n_kernels}, {w2:.1f})"


def _query_speed(client: MapClient, points: NDArray[np.float64]) -> float:
    """Points a second near what was seen, end to end: encode, send, compute, reply, decode."""
    rng = np.random.default_rng(0)
    asked = points[rng.integers(0, len(points), _SPEED_POINTS)] + rng.normal(0.0, 0.3, (_SPEED_POINTS, 3))
    start = time.perf_counter()
    client.occupancy(asked)
    return _SPEED_POINTS / (time.perf_counter() - start)


def _draw(client: MapClient, name: str, scans: list[RecordedScan], out: Path) -> None:
    """Draw the layer of the map at the sensor's height."""
    hits = np.concatenate([scan.in_map[scan.is_return] for scan in scans])
    track = np.stack([scan.T_map_sensor[:3, 3] for scan in scans])
    near = hits[np.abs(hits - track.mean(axis=0)).max(axis=1) <= _PICTURE_REACH_M]
    lower, upper = near.min(axis=0) - 1.0, near.max(axis=0) + 1.0
    cell = float((upper - lower)[:2].max()) / _PICTURE_CELLS
    level = 0.0
    if not scans[-1].is_planar:
        level = float(track[:, 2].mean()) + _PICTURE_ABOVE_SENSOR_M.get(name, 0.0)
    lower[2], upper[2] = level - cell / 2.0, level + cell / 2.0
    grid = client.grid(lower, upper, cell)
    draw_layer(grid, out / f"{name}.png", hits=hits, path_of_sensor=track, title=name)


def _summary(results: list[_MapResult], profile: str, elapsed_s: float) -> dict[str, Any]:
    from potserver.numerics.threads import default_threads

    pooled = score(
        np.concatenate([r.mean for r in results]),
        np.concatenate([r.labels.occupied for r in results]),
        np.concatenate([r.observed for r in results]),
    )
    receipts = [receipt for r in results for receipt in r.receipts]
    speeds = [r.queries_per_s for r in results]
    return {
        "version": __version__,
        "machine": f"{platform.machine()}, {default_threads()} processors, Python {platform.python_version()}",
        "profile": profile,
        **_numbers(receipts, sum(r.kernels for r in results), pooled, float(np.median(speeds))),
        "elapsed_s": elapsed_s,
        "maps": {
            r.name: {
                **_numbers(r.receipts, r.kernels, r.scores, r.queries_per_s),
                "ms_per_scan": r.ms_per_scan,
                "atoms": dict(
                    Counter(s.atom_id for receipt in r.receipts for s in receipt.sectors if s.atom_id)
                ),
            }
            for r in results
        },
    }


def _numbers(receipts: list[Receipt], kernels: int, m: Metrics, queries_per_s: float) -> dict[str, Any]:
    return {
        "scans": len(receipts),
        "receipts_accepted": sum(receipt.accepted for receipt in receipts),
        "kernels": kernels,
        "n_held_out": m.n, "acc": m.accuracy, "auc": m.auc, "nll": m.nll, "brier": m.brier, "ece": m.ece,
        "unknown": m.share_unknown,
        "ms_per_scan_median": float(np.median([receipt.message.integrate_ms for receipt in receipts])),
        "queries_per_s": queries_per_s,
    }  # fmt: skip


def _print_totals(summary: dict[str, Any], console: Console) -> None:
    heads = (
        "map", "scans", "accepted", "kernels", "ms/scan", "ACC", "AUC", "NLL", "ECE", "unknown", "queries/s",
    )  # fmt: skip
    rows = [
        (
            name, str(row["scans"]), str(row["receipts_accepted"]), str(row["kernels"]),
            f"{row['ms_per_scan_median']:.0f}", f"{row['acc']:.3f}", f"{row['auc']:.3f}", f"{row['nll']:.3f}",
            f"{row['ece']:.3f}", f"{row['unknown']:.1%}", f"{row['queries_per_s']:,.0f}",
        )
        for name, row in [*summary["maps"].items(), ("all", summary)]
    ]  # fmt: skip
    console.print(table(heads, rows))
