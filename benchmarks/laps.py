"""The same loop again and again: does the map stay as large, as fast and as good?

    python benchmarks/laps.py [--laps 20] [--sensor vlp16] [--json FILE] [-o docs/laps.png]

A car drives round one block of a made-up town, some 200 m. The rays of a lap are cast once; noise is drawn anew each lap. The
same fifth of the beams is held out on every lap, so none of them was ever learned; after each lap the map is asked about
those of that lap.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.shared import keep, parser_of
from potclient.datasets import RecordedScan
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import score
from potclient.towns import PERIOD_S, SENSORS, Town, TownRecording
from potclient.towns.streets import Drive
from potserver import MappingService, MappingSettings
from potserver.commands.shared import table
from potserver.recordings import to_scan

_LOOP_M = 200.0
_SEARCHED = range(-12, 12)  # cells, for the block whose loop is nearest to that length
_SETTLED = 3  # laps: from there on nothing should change
_ALLOWED = 0.10


def main() -> int:
    options = _options()
    console = Console(width=120)
    ways, noise_m = _cast_once(options)
    service = MappingService(settings=MappingSettings(max_range_m=options.max_range), threads=options.threads)
    service.warm_up()
    hold_out = HoldOut()
    laps = []
    for lap in track(range(options.laps), description="laps", console=Console(stderr=True)):
        times, labels = [], []
        for k, exact in enumerate(ways):
            scan, held = hold_out.split(_with_noise(exact, noise_m, options.max_range, (lap, k)), k)
            labels.append(held)
            start = time.process_time()  # other programs on the machine hardly change it
            service.integrate(to_scan(scan, lap * len(ways) + k))
            times.append((time.process_time() - start) * 1e3)
        tests = LabelledPoints.concatenate(labels)
        answer = service.snapshot.occupancy(tests.points)
        metrics = score(answer.mean, tests.occupied, answer.observed)
        tiles = list(service.state.tiled.tiles.values())
        laps.append(
            {
                "kernels": len(service.snapshot),
                "kernel_bytes": _bytes_of([tile.kernels for tile in tiles]),
                "evidence_bytes": _bytes_of([tile.rows for tile in tiles]),
                "cpu_ms": times,
                **metrics._asdict(),
            }
        )
    console.print(
        f"{len(ways)} scans a lap, {sum(map(len, ways)):,} beams, {options.sensor}, {options.threads} threads"
    )
    console.print(_table(laps))
    for line in _verdict(laps):
        console.print(line)
    keep(options, laps, lambda: _draw(laps))
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__, draws=True)
    parser.add_argument("--style", default="terraces")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--every", type=float, default=4.0, metavar="M", help="distance of scans [4]")
    parser.add_argument(
        "--sensor", choices=sorted(n for n, s in SENSORS.items() if not s.is_planar), default="vlp16"
    )
    parser.add_argument("--max-range", type=float, default=25.0, metavar="M")
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args()


def _cast_once(options: argparse.Namespace) -> tuple[list[RecordedScan], float]:
    """The scans of one lap without noise, and the sensor's noise, m."""
    town = Town(options.style, options.seed, length_m=1.0)
    town.drive = _loop(town)
    sensor = SENSORS[options.sensor]
    exact = dataclasses.replace(sensor, noise_m=0.0, dropout=0.0, max_range_m=options.max_range)
    step = max(1, round(options.every / (town.style.speed_m_s * PERIOD_S)))
    n_scans = int(town.drive.length_m / (town.style.speed_m_s * PERIOD_S))
    return list(TownRecording(town, exact, range(0, n_scans, step))), sensor.noise_m


def _loop(town: Town) -> Drive:
    """Round the block whose loop is nearest to 200 m, clockwise in the right-hand lane."""
    radius = town.style.turn_right_m

    def corners(cell: tuple[int, int]) -> list[np.ndarray]:
        lower, upper = town.grid.bounds(cell)
        west, south = (lower[a] + town.grid.lane_m(a, cell[a]) for a in (0, 1))
        east, north = (upper[a] - town.grid.lane_m(a, cell[a] + 1) for a in (0, 1))
        begin = np.array([west, (south + north) / 2])
        turns = [(west, north), (east, north), (east, south), (west, south)]
        return [begin, *map(np.array, turns), begin]

    def length_m(cell: tuple[int, int]) -> float:
        straight = np.diff(np.stack(corners(cell)), axis=0)
        return float(np.abs(straight).sum() - 4 * (2 - np.pi / 2) * radius)

    cell = min(((i, j) for i in _SEARCHED for j in _SEARCHED), key=lambda c: abs(length_m(c) - _LOOP_M))
    return Drive(corners(cell), [0.0, radius, radius, radius, radius, 0.0], length_m(cell) - 1e-6)


def _with_noise(
    scan: RecordedScan, noise_m: float, max_range_m: float, seed: tuple[int, int]
) -> RecordedScan:
    range_m = np.linalg.norm(scan.points, axis=1)
    measured = range_m + np.where(
        scan.is_return, np.random.default_rng(seed).normal(0.0, noise_m, len(range_m)), 0.0
    )
    share = np.clip(measured, 0.1, max_range_m) / range_m
    return dataclasses.replace(scan, points=(scan.points * share[:, None]).astype(np.float32))


def _bytes_of(parts: list[Any]) -> int:
    """Of all arrays in tuples and dataclasses."""

    def count(part: Any) -> int:
        if isinstance(part, np.ndarray):
            return part.nbytes
        if dataclasses.is_dataclass(part):
            return sum(count(getattr(part, field.name)) for field in dataclasses.fields(part))
        return sum(map(count, part)) if isinstance(part, (tuple, list)) else 0

    return count(parts)


def _table(laps: list[dict[str, Any]]) -> Table:
    heads = ("lap", "kernels", "their MB", "evidence MB", "CPU ms/scan", "95 %", "ACC", "AUC", "NLL", "ECE")
    rows = [
        (
            str(k + 1), f"{lap['kernels']:,}", f"{lap['kernel_bytes'] / 1e6:.2f}",
            f"{lap['evidence_bytes'] / 1e6:.2f}", f"{np.median(lap['cpu_ms']):.0f}",
            f"{np.quantile(lap['cpu_ms'], 0.95):.0f}", f"{lap['accuracy']:.4f}", f"{lap['auc']:.5f}", f"{lap['nll']:.4f}",
            f"{lap['ece']:.4f}",
        )
        for k, lap in enumerate(laps)
    ]  # fmt: skip
    return table(heads, rows, left=())


def _verdict(laps: list[dict[str, Any]]) -> list[str]:
    settled = laps[_SETTLED - 1 :]
    if len(settled) < 2:
        return [f"nothing to compare before lap {_SETTLED + 1}"]
    lines = []
    for name, worse, value in (
        ("kernels", 1, lambda lap: lap["kernels"]),
        ("kernels' bytes", 1, lambda lap: lap["kernel_bytes"]),
        ("evidence's bytes", 1, lambda lap: lap["evidence_bytes"]),
        ("all bytes", 1, lambda lap: lap["kernel_bytes"] + lap["evidence_bytes"]),
        ("CPU ms/scan", 1, lambda lap: float(np.median(lap["cpu_ms"]))),
        ("NLL", 1, lambda lap: lap["nll"]),
        ("AUC", -1, lambda lap: lap["auc"]),
    ):
        series = np.array([value(lap) for lap in settled], np.float64) / value(settled[0]) - 1
        lines.append(
            f"{name}: from lap {_SETTLED} on {series.min():+.1%} to {series.max():+.1%}, at last {series[-1]:+.1%}"
            + ("" if (worse * series).max() <= _ALLOWED else "  <-- worse by more than 10 %")
        )
    return lines


def _draw(laps: list[dict[str, Any]]) -> Figure:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 4, figsize=(14.0, 3.2), layout="constrained")
    number = np.arange(1, len(laps) + 1)
    axes[0].plot(number, [lap["kernels"] / 1e4 for lap in laps], "o-", label="kernels, ten thousands")
    axes[0].plot(number, [lap["kernel_bytes"] / 1e6 for lap in laps], "s-", label="their arrays, MB")
    axes[0].plot(number, [lap["evidence_bytes"] / 1e6 for lap in laps], "^-", label="evidence, MB")
    times = [lap["cpu_ms"] for lap in laps]
    axes[1].plot(number, [np.median(ms) for ms in times], "o-", label="processor ms a scan, median")
    axes[1].fill_between(
        number,
        [np.quantile(ms, 0.05) for ms in times],
        [np.quantile(ms, 0.95) for ms in times],
        alpha=0.15,
        lw=0,
    )
    axes[2].plot(number, [lap["nll"] for lap in laps], "o-", color="tab:red", label="held-out NLL, nats")
    axes[3].plot(number, [lap["auc"] for lap in laps], "o-", color="tab:green", label="held-out AUC")
    for axis in axes:
        axis.set_xlabel("lap")
        axis.grid(alpha=0.3)
        axis.legend(frameon=False)
    for axis in axes[:3]:
        axis.set_ylim(bottom=0)
    return figure


if __name__ == "__main__":
    sys.exit(main())
