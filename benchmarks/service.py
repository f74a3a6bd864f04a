"""What the whole service costs, from a published cloud to its receipt over Zenoh, and what planners wait for meanwhile.

    python benchmarks/service.py DATASET [--seconds 60] [--hz 10] [--points 200000] [--json FILE]
    python benchmarks/service.py DATASET --sweep [-o docs/service.png] [--json FILE]

`potserver serve` runs as a process of its own, with a store. The first form is one robot at its rate and two planners at 20
questions of 1,000 points a second: `potclient load` with what it needs around it. The second sends scans one by one and
draws the server's processor time against work: points a scan, kernels of the map, robots. Processor time counts all threads
of the server; other work on the machine hardly changes it, but waiting times it does.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console

from benchmarks.server_process import ServerProcess
from benchmarks.shared import keep, machine, parser_of, spread
from potclient import MapClient
from potclient.datasets import RecordedScan, open_dataset
from potclient.loadtest import LoadReport, LoadSettings, run_load
from potclient.session import SessionOptions
from potserver.commands.shared import table

_TIMEOUT_S = 120.0
_SHARES = (0.03125, 0.125, 0.5, 1.0)  # of a scan's points
_ROBOTS = (1, 2, 4)


def main() -> int:
    options = _options()
    scans = list(open_dataset(options.dataset, min_range_m=options.min_range, max_range_m=options.max_range))
    found: dict[str, Any] = {"machine": machine(), "dataset": options.dataset}
    if options.sweep:
        found |= _sweep(scans, options)
        keep(options, found, lambda: _draw(found))
    else:
        found["load"] = _load(options)
        keep(options, found)
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__, draws=True)
    parser.add_argument("dataset", metavar="DATASET")
    parser.add_argument("--sweep", action="store_true", help="cost against work, in place of a load")
    parser.add_argument("--seconds", type=float, default=60.0, help="of load [60]")
    parser.add_argument("--hz", type=float, default=10.0, help="clouds a second [10]")
    parser.add_argument("--points", type=int, default=200_000, help="of a cloud, at most [200000]")
    parser.add_argument("--min-range", type=float, default=0.0, metavar="M")
    parser.add_argument("--max-range", type=float, default=25.0, metavar="M")
    parser.add_argument(
        "--serve", nargs=argparse.REMAINDER, default=[], help="further flags of `potserver serve`; last"
    )
    return parser.parse_args()


class _Server:
    """A server with a store, and what it has cost so far."""

    def __init__(self, folder: str, options: argparse.Namespace) -> None:
        flags = ("--listen", "tcp/127.0.0.1:0", "--store", folder, "--log-format", "json", *options.serve)
        self._process = ServerProcess("serve", *flags)
        self.endpoint = str(self._process.event("server_started")["endpoints"][0])

    def cpu_s(self) -> float:
        """Of all its threads since its start."""
        stat = Path(f"/proc/{self._process.popen.pid}/stat").read_text()
        fields = stat.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def cpu_ms_of_threads(self) -> dict[str, float]:
        """Of its threads since their start, by name; those of a pool together. Linux keeps names of 15 characters."""
        found: dict[str, float] = {}
        for task in Path(f"/proc/{self._process.popen.pid}/task").iterdir():
            head, _, rest = (task / "stat").read_text().rpartition(")")
            name, fields = head.partition("(")[2].rstrip("0123456789").rstrip("-_"), rest.split()
            ms = 1e3 * (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
            found[name] = found.get(name, 0.0) + ms
        return found

    def __enter__(self) -> _Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.end(signal.SIGTERM)


def _load(options: argparse.Namespace) -> dict[str, Any]:
    settings = LoadSettings(
        robots=1,
        rate_hz=options.hz,
        planners=2,
        planner_hz=20.0,
        duration_s=options.seconds,
        n_points=options.points,
    )
    recording = open_dataset(options.dataset, min_range_m=options.min_range, max_range_m=options.max_range)
    with tempfile.TemporaryDirectory() as folder, _Server(folder, options) as server:
        before_s, before_ms = server.cpu_s(), server.cpu_ms_of_threads()
        report = run_load(settings, recording, options=SessionOptions(connect=(server.endpoint,)))
        cpu_s = server.cpu_s() - before_s
        threads = {name: ms - before_ms.get(name, 0.0) for name, ms in server.cpu_ms_of_threads().items()}
    _say_load(report, cpu_s)
    _say_threads(threads, report)
    return report.to_json() | {"server_cpu_s": cpu_s, "cpu_ms_of_threads": threads}


def _say_threads(cpu_ms: dict[str, float], report: LoadReport) -> None:
    """What each thread needed of a scan; those that answer questions need it of so many questions."""
    n_scans = max(report.clouds.accepted, 1)
    whole = sum(cpu_ms.values())
    rows = [
        (name, f"{ms / n_scans:.1f}", f"{ms / whole:.0%}")
        for name, ms in sorted(cpu_ms.items(), key=lambda item: -item[1])
        if ms >= 0.005 * whole
    ]
    Console(width=100).print(table(("thread", "CPU ms a scan", "share"), rows, left=(0,)))
    print(f"{report.queries.n / n_scans:.1f} questions a scan")


def _say_load(report: LoadReport, cpu_s: float) -> None:
    c = report.clouds
    print(
        f"{c.offered} clouds: {c.accepted} in the map, {c.dropped_by_client} dropped by the robot, {c.dropped} by the server"
    )
    for name, p in (
        ("receipt", report.receipts),
        ("integrate", report.integrate),
        ("question", report.queries),
    ):
        print(f"{name}: {p.n}, p50 {p.p50_ms:.1f}, p95 {p.p95_ms:.1f}, p99 {p.p99_ms:.1f} ms")
    print(f"the server's processor time: {cpu_s:.1f} s in {report.elapsed_s:.1f} s")


def _sweep(scans: list[RecordedScan], options: argparse.Namespace) -> dict[str, Any]:
    """Processor ms of the server a scan, each to its receipt."""
    by_points = []
    for share in _SHARES:
        ms, sizes = zip(*_costs([_thinned(scan, share) for scan in scans], options), strict=True)
        by_points.append({"points": len(scans[0].points) * share, "cpu_ms": ms, "kernels": sizes})
        print(f"{share:7.1%} of the points: {spread(ms)} CPU ms a scan")
    by_robots = []
    for n in _ROBOTS:
        ms, _ = zip(*_costs([_thinned(scan, _SHARES[1]) for scan in scans], options, n_robots=n), strict=True)
        by_robots.append({"robots": n, "cpu_ms": ms})
        print(f"{n} robots: {spread(ms)} CPU ms a scan")
    return {"points": by_points, "robots": by_robots}


def _costs(
    scans: list[RecordedScan], options: argparse.Namespace, n_robots: int = 1
) -> Iterator[tuple[float, int]]:
    """Processor ms of each scan, and the kernels of the map after it."""
    with (
        tempfile.TemporaryDirectory() as folder,
        _Server(folder, options) as server,
        MapClient(server.endpoint, timeout_s=_TIMEOUT_S) as client,
    ):
        client.wait_ready(_TIMEOUT_S)
        for k, scan in enumerate(scans):
            before_s = server.cpu_s()
            receipt = client.integrate(
                scan.points, scan.T_map_sensor, is_return=scan.is_return, robot=f"r{k % n_robots}"
            )
            yield (server.cpu_s() - before_s) * 1e3, receipt.message.map_kernels


def _thinned(scan: RecordedScan, share: float) -> RecordedScan:
    every = round(1.0 / share)
    return dataclasses.replace(scan, points=scan.points[::every], is_return=scan.is_return[::every])


def _draw(found: dict[str, Any]) -> Figure:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12.0, 3.4), layout="constrained", sharey=True)
    points, full = found["points"], found["points"][-1]
    _band(axes[0], [p["points"] / 1e3 for p in points], [p["cpu_ms"] for p in points])
    axes[0].set_xlabel("points of a scan, thousands")
    axes[0].set_ylabel("processor ms of the server a scan")
    axes[1].plot(np.array(full["kernels"]) / 1e3, full["cpu_ms"], "o", label="scan after scan")
    axes[1].set_xlabel("kernels of the map, thousands")
    _band(axes[2], [r["robots"] for r in found["robots"]], [r["cpu_ms"] for r in found["robots"]])
    axes[2].set_xlabel("robots, an eighth of the points")
    for axis in axes:
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    figure.suptitle(f"{found['dataset'].rsplit('/', 1)[-1]}: {found['machine']}", fontsize=9)
    return figure


def _band(axis: Any, x: list[float], series: list[Any]) -> None:
    low, middle, high = np.array([np.quantile(values, (0.1, 0.5, 0.9)) for values in series]).T
    axis.plot(x, middle, "o-")
    axis.fill_between(x, low, high, alpha=0.15, lw=0)


if __name__ == "__main__":
    sys.exit(main())
