"""How long do ghosts live: what maps say of places that a car has left, against how often later scans saw through them.

    python benchmarks/ghosts.py [DATASET] [--scans 0:160:2] [--json FILE] [-o docs/ghosts.png]

In a dynamic town, end points of beams on cars and people are followed: of those that pass while the sensor drives, and of a
parked car that leaves while the sensor stands. Once the solids have gone from there, and nothing else is near, the maps are
asked after every scan how likely the place still is occupied. A scan sees through a place if one of its beams passes nearer
than 0.15 m to it and ends at least 0.3 m beyond, or does not end.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial import cKDTree

from benchmarks.shared import keep, parser_of
from potclient.datasets import RecordedScan, open_dataset
from potclient.towns import PERIOD_S, Town, TownRecording
from potclient.towns.solids import SolidSet
from potserver import AtomDictionary, MappingService, MappingSettings
from potserver.commands.shared import table
from potserver.evaluation.mappers import Mapper, ServiceMap
from potserver.evaluation.peers import peer_named

_INSIDE_M = 0.1  # along the beam: an end point moved so far is inside what it met
_CLEAR_M = 0.4  # around a ghost nothing else may be
_PASSES_M, _BEYOND_M = 0.15, 0.3
_PASSED, _STOOD = "passed by", "stood there"
_SCANS_STOOD = 5  # that found a place occupied: from there on its car stood
_BEFORE_S, _AFTER_S = 2.5, 6.0  # about the moment at which a parked car leaves
_A_SCAN = 200  # places that are followed from each scan on, at most
_MOST = 20  # scans that saw through
_SHOWN = (0, 1, 2, 3, 5, 8, 12, 16, 20)


@dataclasses.dataclass
class Places:
    """End points of beams on what moves."""

    points: np.ndarray  # (N, 3) m
    inside: np.ndarray  # (N, 3) m
    n_occupied: np.ndarray  # (N,) scans at whose time it was
    left: np.ndarray  # (N,) bool
    n_through: np.ndarray  # (N,) scans since then that saw through

    @classmethod
    def none(cls) -> Places:
        nothing = np.zeros((0, 3))
        return cls(nothing, nothing, np.zeros(0, int), np.zeros(0, bool), np.zeros(0, int))

    def take(self, chosen: np.ndarray) -> Places:
        return Places(*(getattr(self, field.name)[chosen] for field in dataclasses.fields(self)))

    def add(self, points: np.ndarray, inside: np.ndarray) -> Places:
        n = len(points)
        more = (points, inside, np.zeros(n, int), np.zeros(n, bool), np.zeros(n, int))
        return Places(
            *(
                np.concatenate([getattr(self, f.name), m])
                for f, m in zip(dataclasses.fields(self), more, strict=True)
            )
        )


def main() -> int:
    options = _options()
    console = Console(width=120)
    driven, stood = _town(options.dataset, options), _town(options.leaving, options)
    first, last, step = (int(n) for n in options.scans.split(":"))
    runs = {
        _PASSED: (driven, range(len(driven))[first:last:step]),
        _STOOD: (stood, _standing(stood.town, step)),
    }
    report: dict[str, Any] = {"places": {}}
    for kind, (recording, numbers) in runs.items():
        report[kind], report["places"][kind] = _follow(recording, numbers, kind, options)
    names = list(report[_PASSED])
    console.print(
        f"driving: {options.dataset}, {options.scans}; standing: {options.leaving}, {len(runs[_STOOD][1])} scans"
    )
    console.print(_table(report, names))
    keep(options, report, lambda: _draw(report, names))
    return 0


def _town(dataset: str, options: argparse.Namespace) -> TownRecording:
    recording = open_dataset(dataset, max_range_m=options.max_range)
    if not isinstance(recording, TownRecording) or not recording.town.dynamic:
        raise SystemExit(f"{dataset}: need a dynamic town, such as town:terraces:dynamic:7")
    return recording


def _standing(town: Town, step: int) -> range:
    """Stops the sensor where it comes nearest to a car as that leaves; the scans from before that moment to after it."""
    starts = town.traffic.start_s
    parked = np.flatnonzero(
        np.isfinite(starts) & (starts > _BEFORE_S) & (starts + _AFTER_S < town.duration_s)
    )
    if not len(parked):
        raise SystemExit("--leaving: no car leaves in time in this town; take another seed")
    away = [np.hypot(*(town.pose(starts[k])[:2, 3] - town.traffic.base[k])) for k in parked]
    start_s = starts[parked[int(np.argmin(away))]]
    pose = town.pose(start_s)
    town.pose = lambda time_s: pose  # type: ignore[method-assign]
    return range(round((start_s - _BEFORE_S) / PERIOD_S), round((start_s + _AFTER_S) / PERIOD_S), step)


def _follow(
    recording: TownRecording, numbers: range, kind: str, options: argparse.Namespace
) -> tuple[dict[str, list[float]], list[int]]:
    """Mean probability of each map by the count of scans that saw through, and how many places it is the mean of."""
    maps = _maps(options)
    sums = {a_map.name: np.zeros((_MOST + 1, 2)) for a_map in maps}
    places, rng = Places.none(), np.random.default_rng(0)
    for number in track(numbers, description=kind, console=Console(stderr=True)):
        scan = recording[number]
        for a_map in maps:
            a_map.integrate(scan)
        places = _followed(places, recording.town, scan)
        chosen = places.take(places.left & ((places.n_occupied >= _SCANS_STOOD) == (kind == _STOOD)))
        for a_map in maps:
            p = a_map.ask(chosen.points).mean
            np.add.at(sums[a_map.name], chosen.n_through, np.stack([p, np.ones(len(p))], 1))
        places = places.add(*_on_movers(recording.town, scan, rng))
    means = {name: (s[:, 0] / np.maximum(s[:, 1], 1)).tolist() for name, s in sums.items()}
    return means, next(iter(sums.values()))[:, 1].astype(int).tolist()


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__, draws=True)
    parser.add_argument("dataset", nargs="?", default="town:terraces:dynamic:vlp16:200m:7")
    parser.add_argument("--leaving", default="town:terraces:dynamic:vlp16:200m:3", metavar="DATASET")
    parser.add_argument("--scans", default="0:160:2", metavar="START:STOP:STEP")
    parser.add_argument("--max-range", type=float, default=25.0, metavar="M")
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args()


def _maps(options: argparse.Namespace) -> list[Mapper]:
    atoms, settings = AtomDictionary.builtin(), MappingSettings()
    never = dataclasses.replace(settings, gone_odds=0.0)
    maps: list[Mapper] = [
        ServiceMap("ours", MappingService(atoms, settings, threads=options.threads)),
        ServiceMap("ours, gone_odds 0", MappingService(atoms, never, threads=options.threads)),
        peer_named("octomap:0.2", threads=options.threads),
    ]
    for a_map in maps:
        a_map.warm_up(planar=False)
    return maps


def _on_movers(town: Town, scan: RecordedScan, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """End points on what moves, and points inside it behind them."""
    origin = scan.T_map_sensor[:3, 3]
    ends = scan.in_map[scan.is_return]
    ends = ends[rng.permutation(len(ends))]
    beams = ends - origin
    inside = ends + _INSIDE_M * beams / np.linalg.norm(beams, axis=1, keepdims=True)
    lower, upper = ends[:, :2].min(axis=0), ends[:, :2].max(axis=0)
    moving = SolidSet(town.moving(scan.stamp_ns / 1e9, lower, upper))
    chosen = np.flatnonzero(moving.contains(inside))[:_A_SCAN]
    return ends[chosen], inside[chosen]


def _followed(places: Places, town: Town, scan: RecordedScan) -> Places:
    """The places after one more scan: which have been left, how often they were seen through. Those taken again drop out."""
    if not len(places.points):
        return places
    time_s = scan.stamp_ns / 1e9
    occupied = town.occupied(places.inside, time_s)
    around = np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))]) * _CLEAR_M
    clear = ~np.any([town.occupied(places.points + offset, time_s) for offset in around], axis=0)
    places.n_occupied += occupied & ~places.left
    gone = ~occupied & clear
    places.n_through += gone & _seen_through(places.points, scan)
    keep = gone | ~places.left  # a car that pulls out is near for a while
    places.left |= gone
    return places.take(keep & (places.n_through <= _MOST))


def _seen_through(points: np.ndarray, scan: RecordedScan) -> np.ndarray:
    origin = scan.T_map_sensor[:3, 3]
    beams, ways = scan.in_map - origin, points - origin
    length, distance = np.linalg.norm(beams, axis=1), np.linalg.norm(ways, axis=1)
    apart, nearest = cKDTree(beams / length[:, None]).query(ways / distance[:, None])
    return (apart * distance < _PASSES_M) & (length[nearest] > distance + _BEYOND_M)


def _table(report: dict[str, Any], names: list[str]) -> Table:
    rows = []
    for kind in (_PASSED, _STOOD):
        for name in names:
            rows.append([f"{kind}: {name}", *(_mean(report, kind, name, c) for c in _SHOWN)])
        rows.append([f"{kind}: places", *(f"{report['places'][kind][c]:,}" for c in _SHOWN)])
    made = table(["scans that saw through", *map(str, _SHOWN)], rows)
    made.title = "mean P(occupied) where something has left"
    return made


def _mean(report: dict[str, Any], kind: str, name: str, count: int) -> str:
    return f"{report[kind][name][count]:.2f}" if report["places"][kind][count] else "-"


def _draw(report: dict[str, Any], names: list[str]) -> Figure:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.4), sharey=True, layout="constrained")
    for axis, kind in zip(axes, (_PASSED, _STOOD), strict=True):
        enough = np.array(report["places"][kind]) >= 30
        count = np.arange(_MOST + 1)
        for name in names:
            axis.plot(count[enough], np.array(report[kind][name])[enough], "o-", ms=3, label=name)
        axis.set_title(f"a car or person that {kind}")
        axis.set_xlabel("scans since then that saw through")
        axis.set_ylim(0, 1)
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("mean P(occupied)")
    axes[0].legend(frameon=False)
    return figure


if __name__ == "__main__":
    sys.exit(main())
