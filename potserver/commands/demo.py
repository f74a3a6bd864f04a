"""`potserver demo`: recorded scans through a real Zenoh session, and what the maps say about beams they never saw."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import platform
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from potclient import MapClient
from potclient.datasets import Recording, open_dataset
from potclient.errors import DatasetError
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import Metrics, score
from potclient.pictures import draw_layer
from potclient.results import Receipt
from potschemas import __version__
from potschemas.messages import SectorReport
from potserver import bundled
from potserver.config import Settings
from potserver.errors import PotserverError
from potserver.log import configure_logging
from potserver.mapping.settings import PROFILES, MappingSettings
from potserver.numerics.threads import default_threads
from potserver.server import MapServer

_BUNDLED = {
    bundled.STREET: "a street, two real outdoor scans, 3D",
    bundled.ROOMS: "rooms, twelve simulated scans, 3D",
    bundled.PLAN: "the same rooms in 2D, seen from above",
}
_PICTURE_ABOVE_SENSOR_M = {bundled.ROOMS: 0.6}  # that sensor stands on the floor
_PICTURE_CELLS = 400  # along the longer side
_SPEED_POINTS = 200_000


class DemoError(PotserverError):
    """The demo cannot go on."""


@dataclasses.dataclass(frozen=True, slots=True)
class _MapResult:
    name: str
    receipts: list[Receipt]
    labels: LabelledPoints
    mean: np.ndarray[Any, np.dtype[np.float32]]
    observed: np.ndarray[Any, np.dtype[np.bool_]]
    scores: Metrics
    kernels: int
    queries_per_s: float

    @property
    def ms_per_scan(self) -> list[float]:
        return [receipt.message.integrate_ms for receipt in self.receipts]


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `potserver demo`; 0 when every scan was accepted and all files are written."""
    options = _parser().parse_args(arguments)
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    out = Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    configure_logging("warning", "console")
    try:
        recordings = _recordings(options)
    except DatasetError as error:
        raise DemoError(str(error)) from error
    maps = tuple(recordings)
    settings = Settings(
        server_id="demo", maps=maps, stats_period_s=1.0, mapping=MappingSettings.of_profile(options.profile)
    )
    console.print(
        f"[bold]potserver {__version__} demo[/bold]: a map server on loopback, and a robot that sends it "
        f"{sum(map(len, recordings.values()))} scans over Zenoh.\n"
        f"A fifth of each scan's beams is held back; at the end the maps are asked about those. Profile: {options.profile}.\n"
        + (
            ""
            if options.datasets
            else "The built-in atoms were learned in made-up towns, and some on other beams of the rooms.\n"
        )
        + "carried: kernels that the map took from transported atoms; placed: kernels added where those explain nothing;\n"
        "W2: root of the transport cost under the entropic plan, hits plus free points (never 0, the blur counts)."
    )
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
    console.print(
        f"\nresults: {out}/summary.json; pictures: {', '.join(f'{out}/{r.name}.png' for r in results)}"
    )
    return 0 if summary["receipts_accepted"] == summary["scans"] else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="potserver demo",
        description="Start a server on loopback, send it recorded scans through a real Zenoh session, and score the maps.",
        epilog="examples:\n  potserver demo\n  potserver demo --profile paper\n  potserver demo /data/kitti/00 --scans 20",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "datasets", nargs="*", metavar="DATASET", help="recordings to map in place of the bundled ones"
    )
    parser.add_argument(
        "--profile", choices=sorted(PROFILES), default="default", help="mapping profile [default]"
    )
    parser.add_argument("--scans", type=int, metavar="N", help="at most this many scans of each recording")
    parser.add_argument("--out", default="out/demo", metavar="FOLDER", help="where results go [out/demo]")
    return parser


def _recordings(options: argparse.Namespace) -> dict[str, Recording]:
    if options.datasets:
        opened = {f"map{i}": open_dataset(path) for i, path in enumerate(options.datasets)}
    else:
        opened = {name: bundled.open_bundled(name) for name in _BUNDLED}
    return {name: recording[: options.scans] for name, recording in opened.items()}


def _run_map(endpoint: str, name: str, recording: Recording, out: Path, console: Console) -> _MapResult:
    console.print(f"[bold]{name}[/bold]: {_BUNDLED.get(name, str(recording.path))}")
    table = Table(box=None, header_style="dim", pad_edge=False)
    for column in ("scan", "beams", "ms", "carried", "placed", "in map"):
        table.add_column(column, justify="right")
    table.add_column("atom and turn of each sector (kernels, W2 in m)", overflow="fold")
    hold_out = HoldOut()
    receipts: list[Receipt] = []
    held: list[LabelledPoints] = []
    hits: list[np.ndarray[Any, np.dtype[np.float64]]] = []
    track = []
    planar = False
    with MapClient(endpoint, map=name, timeout_s=60.0) as client:
        client.wait_ready(60.0)
        with console.status("") as status:
            for number, recorded in enumerate(recording):
                status.update(f"scan {number + 1} of {len(recording)}")
                scan, labels = hold_out.split(recorded)
                planar = scan.is_planar
                receipt = client.integrate(
                    scan.to_send, scan.T_map_sensor, robot="demo", is_return=scan.is_return
                )
                receipts.append(receipt)
                held.append(labels)
                hits.append(scan.in_map[scan.is_return])
                track.append(scan.T_map_sensor[:3, 3])
                m = receipt.message
                table.add_row(
                    str(number), str(m.n_points), f"{m.integrate_ms:.0f}", str(m.n_kernels_transported),
                    str(m.n_kernels_added - m.n_kernels_transported), str(m.map_kernels),
                    "  ".join(_sector(s) for s in m.sectors if s.atom_id is not None) or "none",
                )  # fmt: skip
        console.print(table)
        labels = LabelledPoints.concatenate(held)
        answer = client.occupancy(labels.points)
        scores = score(answer.mean, labels.occupied, answer.observed)
        queries_per_s = _query_speed(client, labels.points)
        echoes, sensor = np.concatenate(hits), np.stack(track)
        _draw(client, name, echoes, sensor, planar, out)
        info = client.info()
    console.print(
        f"held-out beams: ACC {scores.accuracy:.3f}  AUC {scores.auc:.3f}  NLL {scores.nll:.3f}  ECE {scores.ece:.3f}"
        f"  unknown {scores.share_unknown:.1%}  of {scores.n} points; {queries_per_s:,.0f} queries/s over Zenoh\n"
    )
    return _MapResult(
        name, receipts, labels, answer.mean, answer.observed, scores, info.n_kernels, queries_per_s
    )


def _sector(sector: SectorReport) -> str:
    w2 = math.sqrt(max(sector.w2_m2, 0.0))
    return f"{sector.atom_id} {math.degrees(sector.rotation_rad):+.0f}° ({sector.n_kernels}, {w2:.1f})"


def _query_speed(client: MapClient, points: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    """Points a second near what was seen, end to end: encode, send, compute, reply, decode."""
    rng = np.random.default_rng(0)
    asked = points[rng.integers(0, len(points), _SPEED_POINTS)] + rng.normal(0.0, 0.3, (_SPEED_POINTS, 3))
    start = time.perf_counter()
    client.occupancy(asked)
    return _SPEED_POINTS / (time.perf_counter() - start)


def _draw(
    client: MapClient,
    name: str,
    hits: np.ndarray[Any, np.dtype[np.float64]],
    track: np.ndarray[Any, np.dtype[np.float64]],
    planar: bool,
    out: Path,
) -> None:
    near = hits[np.abs(hits - track.mean(axis=0)).max(axis=1) <= 30.0]
    lower, upper = near.min(axis=0) - 1.0, near.max(axis=0) + 1.0
    cell = float((upper - lower)[:2].max()) / _PICTURE_CELLS
    level = 0.0 if planar else float(track[:, 2].mean()) + _PICTURE_ABOVE_SENSOR_M.get(name, 0.0)
    lower[2], upper[2] = level - cell / 2.0, level + cell / 2.0
    grid = client.grid(lower, upper, cell)
    draw_layer(grid, out / f"{name}.png", hits=hits, path_of_sensor=track, title=name)


def _summary(results: list[_MapResult], profile: str, elapsed_s: float) -> dict[str, Any]:
    pooled = score(
        np.concatenate([r.mean for r in results]),
        np.concatenate([r.labels.occupied for r in results]),
        np.concatenate([r.observed for r in results]),
    )
    times = [ms for r in results for ms in r.ms_per_scan]
    return {
        "version": __version__,
        "machine": f"{platform.machine()}, {default_threads()} processors, Python {platform.python_version()}",
        "profile": profile,
        "scans": sum(len(r.receipts) for r in results),
        "receipts_accepted": sum(receipt.accepted for r in results for receipt in r.receipts),
        "kernels": sum(r.kernels for r in results),
        **_scores(pooled),
        "ms_per_scan_median": float(np.median(times)),
        "queries_per_s": float(np.median([r.queries_per_s for r in results])),
        "elapsed_s": elapsed_s,
        "maps": {
            r.name: {
                "scans": len(r.receipts),
                "receipts_accepted": sum(receipt.accepted for receipt in r.receipts),
                "kernels": r.kernels,
                **_scores(r.scores),
                "ms_per_scan": r.ms_per_scan,
                "ms_per_scan_median": float(np.median(r.ms_per_scan)),
                "queries_per_s": r.queries_per_s,
                "atoms": dict(
                    Counter(s.atom_id for receipt in r.receipts for s in receipt.sectors if s.atom_id)
                ),
            }
            for r in results
        },
    }


def _scores(m: Metrics) -> dict[str, float]:
    return {
        "n_held_out": m.n, "acc": m.accuracy, "auc": m.auc, "nll": m.nll, "brier": m.brier, "ece": m.ece,
        "unknown": m.share_unknown,
    }  # fmt: skip


def _print_totals(summary: dict[str, Any], console: Console) -> None:
    table = Table(box=None, header_style="dim", pad_edge=False)
    table.add_column("map")
    for column in (
        "scans",
        "accepted",
        "kernels",
        "ms/scan",
        "ACC",
        "AUC",
        "NLL",
        "ECE",
        "unknown",
        "queries/s",
    ):
        table.add_column(column, justify="right")
    for name, row in [*summary["maps"].items(), ("all", summary)]:
        table.add_row(
            name, str(row["scans"]), str(row["receipts_accepted"]), str(row["kernels"]), f"{row['ms_per_scan_median']:.0f}",
            f"{row['acc']:.3f}", f"{row['auc']:.3f}", f"{row['nll']:.3f}", f"{row['ece']:.3f}", f"{row['unknown']:.1%}",
            f"{row['queries_per_s']:,.0f}",
        )  # fmt: skip
    console.print(table)
