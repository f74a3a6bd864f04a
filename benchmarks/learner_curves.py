"""How good learned kernels are for their number, against a grid of fixed kernels with jointly solved weights.

    python benchmarks/learner_curves.py town:downtown:5 DATASET... [--scans 0,20] [--window 1] [--later 2] [-o docs/learner.png]

Both get the same labels and sample weights of the same sectors, and both are scored on the held-out beams of these sectors,
and on those beams of later scans that see a sector again.
The grid is a lattice over the data with a length scale of 0.75 spacings and the learner's own prior. "Favoured" is a grid whose
prior variance is the best of three by those very held-out beams.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.shared import keep, parser_of
from potclient.datasets import Recording, open_dataset
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import Metrics, score
from potserver.atoms.build.scan_task import SectorOf
from potserver.atoms.learning import LearningSettings, beam_weights, cut_sectors, lattice, learn_kernels
from potserver.commands.shared import table
from potserver.domain.kernel_map import KernelMap
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.warm_fit import Prior, Solver, warm_fit
from potserver.recordings import to_scan

_GRID_LENGTH = 0.75  # spacings
_POINTS_PER_KERNEL = 4  # at least, for both: sectors with few points get fewer kernels
_FAVOURED_PRIORS = (20.0, 50.0, 200.0)


class Sector(NamedTuple):
    points: np.ndarray
    occupied: np.ndarray
    test_points: np.ndarray
    test_occupied: np.ndarray
    later_points: np.ndarray
    later_occupied: np.ndarray


class Scores(NamedTuple):
    own: Metrics  # held-out beams of the scans that were learned
    later: Metrics | None  # of later ones; None where they show hits alone, free space alone, or nothing


def main() -> int:
    options = _options()
    settings = LearningSettings(n_sectors=options.sectors, max_range_m=options.max_range)
    console = Console(width=160)
    found = {}
    for dataset in options.datasets:
        recording = open_dataset(dataset, max_range_m=options.max_range)
        sectors = _sectors(recording, options, settings)
        console.print(
            f"{dataset}: {len(sectors)} sectors, {sum(len(s.test_points) for s in sectors)} held-out points"
        )
        found[dataset] = json.loads(
            json.dumps(_curves(sectors, options.kernels, settings))
        )  # keys as in a file
        console.print(_table(found[dataset]))
    for name in options.draw:
        found |= json.loads(Path(name).read_text())
    keep(options, found, lambda: _draw(found))
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__, draws=True)
    parser.add_argument("datasets", nargs="*", metavar="DATASET")
    parser.add_argument("--scans", default="0,20", help="first scans of the windows [0,20]")
    parser.add_argument("--window", type=int, default=1, help="scans learned together [1]")
    parser.add_argument("--later", type=int, default=2, help="scans after a window that judge too [2]")
    parser.add_argument("--sectors", type=int, default=6)
    parser.add_argument("--max-range", type=float, default=20.0, metavar="M")
    parser.add_argument(
        "--kernels", default="100,200,400,800", type=lambda text: [int(k) for k in text.split(",")]
    )
    parser.add_argument(
        "--draw", nargs="*", default=[], metavar="FILE", help="draw the numbers of these runs too"
    )
    return parser.parse_args()


def _sectors(recording: Recording, options: argparse.Namespace, settings: LearningSettings) -> list[Sector]:
    sectors = []
    for first in map(int, options.scans.split(",")):
        numbers = range(first, min(first + options.window, len(recording)))
        parts = [HoldOut().split(recording[number], number) for number in numbers]
        ends = range(numbers.stop, min(numbers.stop + options.later, len(recording)))
        after = [HoldOut().split(recording[number], number)[1] for number in ends]
        scans = [to_scan(scan, number) for (scan, _), number in zip(parts, numbers, strict=True)]
        for cut in cut_sectors(scans, settings, np.random.default_rng(first)):
            where = SectorOf(parts[0][0], cut.number, settings)
            own, later = _picked(where, [labels for _, labels in parts]), _picked(where, after)
            occupied = own[1]
            if cut.occupied.sum() >= settings.min_hits and occupied.any() and not occupied.all():
                sectors.append(Sector(cut.points, cut.occupied, *own, *later))
    return sectors


def _picked(where: SectorOf, held_out: list[LabelledPoints]) -> tuple[np.ndarray, np.ndarray]:
    parts = [where.pick(labels) for labels in held_out]
    if not parts:
        return np.zeros((0, 3)), np.zeros(0, bool)
    return np.concatenate([points for points, _ in parts]), np.concatenate(
        [occupied for _, occupied in parts]
    )


def _curves(sectors: list[Sector], counts: list[int], settings: LearningSettings) -> dict:
    curves: dict = {"grid": {}, "favoured": {}, "learned": {}, "seconds": {}}
    for count in track([*counts, 2 * counts[-1]], description="grid", console=Console(stderr=True)):
        both = [_grid(sector, min(count, _limit(sector)), settings) for sector in sectors]
        curves["grid"][count] = [_plain(own) for own, _ in both]
        curves["favoured"][count] = [_plain(best) for _, best in both]
    for count in track(counts, description="learned", console=Console(stderr=True)):
        rows, seconds = [], []
        for sector in sectors:
            started = time.perf_counter()
            limit = min(count, _limit(sector))
            posterior = learn_kernels(
                sector.points,
                sector.occupied,
                LearningSettings(**_with(settings, max_kernels=limit, points_per_kernel=1)),
            )
            seconds.append(time.perf_counter() - started)
            gamma = posterior.gamma_shape / posterior.gamma_rate
            rows.append(_plain(_scored(sector, posterior.hinge_mean, gamma, posterior.weight_mean)))
        curves["learned"][count], curves["seconds"][count] = rows, seconds
    return curves


def _limit(sector: Sector) -> int:
    return max(1, len(sector.points) // _POINTS_PER_KERNEL)


def _with(settings: LearningSettings, **changes: object) -> dict:
    return {name: getattr(settings, name) for name in settings.__slots__} | changes


def _grid(sector: Sector, count: int, settings: LearningSettings) -> tuple[Scores, Scores]:
    points, occupied = sector.points, sector.occupied
    if len(points) > settings.max_labelled:  # the learner draws the same ones
        drawn = np.random.default_rng(0).choice(len(points), settings.max_labelled, replace=False)
        points, occupied = points[drawn], occupied[drawn]
    hinge, started = lattice(points, count)
    gamma = started / _GRID_LENGTH**2
    corner = points.min(axis=0)
    blocks = feature_blocks(
        points - corner, hinge - corner, gamma, edge_m=float(1.0 / np.sqrt(2.0 * gamma[0])), cut=1e-3
    )
    zeros = np.zeros(len(hinge), np.float32)
    results = {}
    for prior_var in {settings.weight_var, *_FAVOURED_PRIORS}:
        solved = warm_fit(
            blocks, occupied, beam_weights(occupied, settings.free_per_beam),
            Prior(zeros, np.full(len(hinge), prior_var, np.float32)), zeros, Solver(50, 200, least_curvature=1e-5),
        )  # fmt: skip
        results[prior_var] = _scored(sector, hinge, gamma, solved.weights)
    return results[settings.weight_var], min(results.values(), key=lambda scores: scores.own.nll)


def _scored(sector: Sector, hinge: np.ndarray, gamma: np.ndarray, weight: np.ndarray) -> Scores:
    kernels = KernelMap.from_arrays(hinge, gamma, weight, np.zeros(len(weight)))
    own = score(kernels.occupancy(sector.test_points).mean, sector.test_occupied)
    if not sector.later_occupied.any() or sector.later_occupied.all():
        return Scores(own, None)
    return Scores(own, score(kernels.occupancy(sector.later_points).mean, sector.later_occupied))


def _plain(scores: Scores) -> dict[str, float]:
    own, later = scores
    plain = {"auc": own.auc, "nll": own.nll, "ece": own.ece, "accuracy": own.accuracy}
    return plain if later is None else plain | {"later_auc": later.auc, "later_nll": later.nll}


_HEADS = (
    "kernels", "grid AUC", "grid NLL", "grid ECE", "learned AUC", "learned NLL", "learned ECE", "s a sector",
    "better than the grid: AUC", "NLL", "NLL, favoured", "NLL, twice as many", "later: grid AUC", "NLL", "learned AUC",
    "NLL", "better: AUC", "NLL",
)  # fmt: skip


def _table(curves: dict) -> Table:
    lines = []
    for count, grid in curves["grid"].items():
        twice = curves["grid"].get(str(2 * int(count)))
        row = [count, *(f"{_mean(grid, key):.4f}" for key in ("auc", "nll", "ece"))]
        if count in curves["learned"]:
            learned = curves["learned"][count]
            row += [f"{_mean(learned, key):.4f}" for key in ("auc", "nll", "ece")]
            row += [f"{np.mean(curves['seconds'][count]):.1f}"]
            row += [f"{_share(learned, grid, 'auc'):.0%}", f"{_share(learned, grid, 'nll'):.0%}"]
            row += [f"{_share(learned, curves['favoured'][count], 'nll'):.0%}"]
            row += ["-" if twice is None else f"{_share(learned, twice, 'nll'):.0%}"]
            fixed, moved = ([r for r in rows if "later_nll" in r] for rows in (grid, learned))
            if fixed:
                row += [
                    f"{_mean(rows, key):.4f}" for rows in (fixed, moved) for key in ("later_auc", "later_nll")
                ]
                row += [f"{_share(moved, fixed, key):.0%}" for key in ("later_auc", "later_nll")]
        lines.append(row)
    return table(_HEADS, lines, left=())


def _mean(rows: list[dict[str, float]], key: str) -> float:
    return float(np.mean([row[key] for row in rows]))


def _share(ours: list[dict[str, float]], theirs: list[dict[str, float]], key: str) -> float:
    """Of sectors in which ours is at least as good."""
    sign = 1.0 if key.endswith("auc") else -1.0
    return float(np.mean([sign * a[key] >= sign * b[key] for a, b in zip(ours, theirs, strict=True)]))


def _draw(found: dict) -> Figure:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(
        2, len(found), figsize=(4.2 * len(found), 6.0), squeeze=False, layout="constrained"
    )
    for column, (name, curves) in enumerate(found.items()):
        for row, (key, label) in enumerate((("nll", "NLL, nats"), ("auc", "AUC"))):
            axis = axes[row, column]
            for method, colour in (("grid", "0.45"), ("learned", "tab:blue")):
                counts = [int(count) for count in curves[method]]
                values = np.array([[r[key] for r in rows] for rows in curves[method].values()])
                axis.plot(counts, values.mean(axis=1), "o-", color=colour, label=method)
                axis.fill_between(
                    counts, *np.quantile(values, (0.25, 0.75), axis=1), color=colour, alpha=0.15, lw=0
                )
            axis.set_xscale("log")
            axis.set_xticks([int(count) for count in curves["grid"]], list(curves["grid"]))
            axis.minorticks_off()
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
        axes[0, column].set_title(Path(name).name if "/" in name else name)
        axes[1, column].set_xlabel("kernels")
    axes[0, 0].legend(frameon=False)
    return figure


if __name__ == "__main__":
    sys.exit(main())
