"""Does transport pay when every map may take the same time? Held-out NLL against processor time a scan.

    python benchmarks/equal_time.py DATASET [--max-range 25] [--thin 4] [--json FILE] [-o docs/equal_time.png]

The overall map without transported kernels, and with them, their weights as prior or with a flat one: each with 1 to 8 Newton
steps a scan, four conjugate-gradient steps each. POT alone, which learns nothing, has one time only. All maps are fed the same
scans in turns, on one thread; curves are compared where they take as long as the map does with the settings that ship.
"""

from __future__ import annotations

import argparse
import functools
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from benchmarks.shared import keep, parser_of
from potclient.holdout import HoldOut
from potserver.commands.shared import table
from potserver.domain.dictionary import AtomDictionary
from potserver.evaluation.ablations import ABLATIONS, label_of
from potserver.evaluation.mappers import ServiceMap
from potserver.evaluation.protocol import evaluate
from potserver.mapping.default import DefaultPipeline
from potserver.mapping.fusion import FitEffort
from potserver.mapping.pipeline import Method, Pipeline
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.recordings import Reader, open_recording, scan_numbers

_STEPS = (1, 2, 3, 4, 6, 8)
_AS_SHIPPED = "as shipped"


class Point(NamedTuple):
    """One map of a curve."""

    curve: str
    steps: str
    cpu_ms: float  # a scan, median
    auc: float
    nll: float
    ece: float
    kernels: int


def main() -> int:
    options = _options()
    console = Console(width=120)
    reader = Reader(min_range_m=options.min_range, max_range_m=options.max_range)
    recording = open_recording(options.dataset, reader)
    numbers = scan_numbers(options.scans, len(recording))
    maps, names = [], []
    for curve, steps, service in _asked(AtomDictionary.builtin()):
        names.append((curve, steps))
        maps.append(ServiceMap(f"{curve}, {steps}", service))
    evaluation = evaluate(
        options.dataset, recording, numbers, maps,
        hold_out=HoldOut(0.2), thin=options.thin, on_step=lambda step: print(step, file=sys.stderr),
    )  # fmt: skip
    points = [
        Point(
            curve, steps, float(np.median(row.cpu_ms)), row.protocol_1.held_out.auc, row.protocol_1.held_out.nll,
            row.protocol_1.held_out.ece, row.size.cells,
        )
        for (curve, steps), row in zip(names, evaluation.rows, strict=True)
    ]  # fmt: skip
    console.print(f"{evaluation.n_scans} scans, {evaluation.n_beams:,} beams mapped")
    console.print(_table(points))
    for line in _at_equal_time(points):
        console.print(line)
    keep(options, [point._asdict() for point in points], lambda: _draw(points, options.dataset))
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__, draws=True)
    parser.add_argument("dataset", metavar="DATASET")
    parser.add_argument("--scans", default=":", metavar="START:STOP:STEP")
    parser.add_argument("--min-range", type=float, default=0.0, metavar="M")
    parser.add_argument("--max-range", type=float, metavar="M")
    parser.add_argument("--thin", type=int, default=1, metavar="N", help="take every Nth beam")
    return parser.parse_args()


def _asked(dictionary: AtomDictionary) -> list[tuple[str, str, MappingService]]:
    """Curve, steps, and empty map of each."""
    found = []
    shipped = MappingSettings()
    pipelines: dict[str, type[Pipeline]] = {label_of(shipped): DefaultPipeline, **ABLATIONS}
    for name, pipeline in pipelines.items():
        found.append(
            (name, _AS_SHIPPED, MappingService(dictionary, shipped, threads=1, make_pipeline=pipeline))
        )
        if pipeline.keeps_evidence:
            for n in _STEPS:
                # the same number of steps whatever they touch
                method = Method(effort=FitEffort(newton_steps=n, most_newton_steps=n))
                fixed = functools.partial(pipeline, method=method)
                found.append(
                    (name, str(n), MappingService(dictionary, shipped, threads=1, make_pipeline=fixed))
                )
    return found


def _table(points: list[Point]) -> Table:
    heads = ("map", "Newton steps", "kernels", "CPU ms/scan", "AUC", "NLL", "ECE")
    rows = [
        (
            p.curve,
            p.steps,
            f"{p.kernels:,}",
            f"{p.cpu_ms:.0f}",
            f"{p.auc:.4f}",
            f"{p.nll:.4f}",
            f"{p.ece:.4f}",
        )
        for p in points
    ]
    return table(heads, rows)


def _at_equal_time(points: list[Point]) -> list[str]:
    budget = points[0].cpu_ms
    lines = [f"in {budget:.0f} ms a scan, which {points[0].curve} takes as shipped:"]
    for name, ms, nll in _curves(points):
        if ms[0] > budget:
            lines.append(f"  {name}: takes at least {ms[0]:.0f} ms, NLL {nll[0]:.4f} then")
        else:
            lines.append(f"  {name}: NLL {np.interp(budget, ms, nll):.4f}")
    return lines


def _curves(points: list[Point]) -> list[tuple[str, list[float], list[float]]]:
    """Name, times and NLL of each curve, by time; POT's is a single point."""
    found = []
    for name in dict.fromkeys(p.curve for p in points):
        mine = [p for p in points if p.curve == name]
        mine = sorted([p for p in mine if p.steps != _AS_SHIPPED] or mine, key=lambda p: p.cpu_ms)
        found.append((name, [p.cpu_ms for p in mine], [p.nll for p in mine]))
    return found


def _draw(points: list[Point], dataset: str) -> Figure:
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
    for name, ms, nll in _curves(points):
        if len(ms) > 1:  # POT alone is far above the others
            axis.plot(ms, nll, "o-", label=name)
    axis.plot(points[0].cpu_ms, points[0].nll, "k*", ms=12, label=f"{points[0].curve}, {_AS_SHIPPED}")
    axis.set(xlabel="processor ms a scan, median", ylabel="held-out NLL, nats", title=Path(dataset).name)
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    return figure


if __name__ == "__main__":
    sys.exit(main())
