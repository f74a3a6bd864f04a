"""Tables of atoms that go from one domain to another: towns, dynamic scenes, the first frames, simulation to reality."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from statistics import fmean, median, pstdev

import numpy as np

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.evaluation.mappers import Answer, Mapper
from potserver.evaluation.paper import published
from potserver.evaluation.paper.scenes import (
    CARS,
    KITTI,
    KITTI_RING,
    RECORDED,
    TOWNS_2D,
    TOWNS_3D,
    Scene,
)
from potserver.evaluation.paper.table import Cell, Found, Lab, Shown, Table, score_cells, show_rows
from potserver.evaluation.paper.trial import (
    OurMap,
    Row,
    fitted,
    paper_map,
    run_maps,
    scans_of,
    scored,
)
from potserver.evaluation.repot import FlatRePotPipeline, RePotPipeline
from potserver.mapping.service import MakePipeline, pipeline_of

METHODS: dict[str, MakePipeline] = {
    "POT": pipeline_of,
    "RePOT": RePotPipeline,
    "RePOT, flat prior": FlatRePotPipeline,
}
ON_TEST = "RePOT fitted to the test points"


def towns_of(lab: Lab, *, planar: bool) -> tuple[Scene, ...]:
    """The towns of one number of dimensions that the size takes."""
    return (TOWNS_2D if planar else TOWNS_3D)[: lab.size.towns]


def maps_of(lab: Lab, atoms: AtomDictionary) -> list[Mapper]:
    """A map of each method."""
    return [paper_map(name, atoms, make, threads=lab.threads) for name, make in METHODS.items()]


# --- intra- and inter-domain ---------------------------------------------------------------------------------------------


def _town_cells(lab: Lab) -> list[Cell]:
    return [
        Cell(f"{source.name} to {target.name}", partial(_town_pair, lab, source, target))
        for planar in (True, False)
        for source in towns_of(lab, planar=planar)
        for target in towns_of(lab, planar=planar)
    ]


def _town_pair(lab: Lab, source: Scene, target: Scene) -> list[Row]:
    maps = maps_of(lab, lab.sources.of(source))
    run = run_maps(maps, scans_of(target, lab.size, lab.data), lab.on_step)
    rows = run.rows()
    pot = maps[0].kernel_map
    assert pot is not None
    ask = fitted(pot.kernels, run.labels.points, run.labels.occupied, threads=lab.threads)
    rows.append(rows[0] | {"map": ON_TEST} | scored(ask(run.labels.points), run.labels))
    return rows


def _show_towns(found: Found) -> list[Shown]:
    shown = []
    for dims in ("2D", "3D"):
        for method in (*METHODS, ON_TEST):
            figures = published.TOWNS.get("RePOT" if method == ON_TEST else method)
            for metric in ("acc", "auc", "nll"):
                heads = ["source", *(f"to Town {k + 1}" for k in range(3))]
                lines = [
                    [
                        f"Town {s + 1}",
                        *(_beside(found, method, metric, dims, s, t, figures) for t in range(3)),
                    ]
                    for s in range(3)
                ]
                shown.append(Shown(f"{dims}, {method}, {metric.upper()}: ours (the paper's)", heads, lines))
    return [*shown, *show_rows(found, ("NLL, clip 1e-15", "nll_authors_clip", ".2f"))]


def _beside(found: Found, method: str, metric: str, dims: str, s: int, t: int, figures: object) -> str:
    key = f"Town {s + 1}, {dims} to Town {t + 1}, {dims}"
    rows = [row for row in found.get(key, []) if row["map"] == method]
    ours = f"{rows[0][metric]:.2f}" if rows else "not run"
    if dims == "3D" or not isinstance(figures, dict):
        return ours
    return f"{ours} ({figures[metric][s][t]:.2f})"


# --- instantaneous maps ---------------------------------------------------------------------------------------------------


def _instant_cells(lab: Lab) -> list[Cell]:
    cells = []
    for target in (CARS, KITTI_RING, KITTI):
        for source in towns_of(lab, planar=target.planar):
            cells.append(Cell(f"{source.name} to {target.name}", partial(_instant, lab, source, target)))
    return cells


def _instant(lab: Lab, source: Scene, target: Scene) -> list[Row]:
    """A new map for each scan, asked about that scan's held-out beams."""
    scans = list(scans_of(target, lab.size, lab.data))
    atoms = lab.sources.of(source)
    found: dict[str, list[Row]] = {name: [] for name in METHODS}
    for numbered in scans:
        run = run_maps(maps_of(lab, atoms), iter([numbered]), lab.on_step)
        for row, mapper in zip(run.rows(), run.maps, strict=True):
            assert isinstance(mapper, OurMap)
            update = mapper.updates[0]
            own = KernelMap(update.kernels, rule=update.rule, threads=lab.threads).occupancy(
                run.labels.points
            )
            answer = Answer(own.mean, own.observed)
            found[mapper.name].append(row | scored(answer, run.labels) | {"kernels": len(update.kernels)})
    return [_mean_row(name, rows) for name, rows in found.items()]


def _mean_row(name: str, rows: list[Row]) -> Row:
    """Means over scans, and standard deviations of the scores."""
    made: Row = {"map": name, "scans": len(rows)}
    for field in ("acc", "auc", "nll", "ece", "unknown", "kernels", "cpu_ms", "nll_authors_clip"):
        values = [row[field] for row in rows if not np.isnan(row[field])]
        made[field] = median(values) if field == "cpu_ms" else fmean(values)
        made[f"{field}_sd"] = pstdev(values)
    return made


def _show_instant(found: Found) -> list[Shown]:
    lines = []
    for key, rows in found.items():
        source, _, target = key.partition(" to ")
        figures = published.INSTANTANEOUS.get(target)
        number = int(source.split(",")[0].split()[-1]) - 1
        for row in rows:
            theirs = "-"
            if figures is not None and row["map"] == "POT":
                theirs = ", ".join(
                    "{:.2f} +- {:.2f}".format(*figures[m][number]) for m in ("acc", "auc", "nll")
                )
            lines.append([key, row["map"], *score_cells(row), theirs])
    heads = ["domains", "map", "ACC", "AUC", "NLL", "ECE", "the paper's POT: ACC, AUC, NLL"]
    return [Shown("one map a scan: mean +- standard deviation over scans", heads, lines)]


# --- first frames, simulation to reality -----------------------------------------------------------------------------------


def _frame_cells(lab: Lab) -> list[Cell]:
    return [
        Cell(f"{scene.name}, first {n} frames", partial(_first_frames, lab, scene, n))
        for planar in (True, False)
        for scene in towns_of(lab, planar=planar)[:1]
        for n in lab.size.frames
    ]


def _first_frames(lab: Lab, scene: Scene, frames: int) -> list[Row]:
    atoms = lab.sources.of(scene, frames)
    run = run_maps(maps_of(lab, atoms), scans_of(scene, lab.size, lab.data), lab.on_step)
    return [row | {"frames": frames, "atoms": len(atoms)} for row in run.rows()]


def _real_cells(lab: Lab) -> list[Cell]:
    cells = []
    for target in RECORDED:
        for source in (*towns_of(lab, planar=target.planar), target):
            cells.append(Cell(f"{source.name} to {target.name}", partial(_to_real, lab, source, target)))
    return cells


def _to_real(lab: Lab, source: Scene, target: Scene) -> list[Row]:
    """The recording's own atoms are of its first frames, which are then no targets."""
    scans = scans_of(target, lab.size, lab.data, first=lab.size.source_frames)
    return run_maps(maps_of(lab, lab.sources.of(source)), scans, lab.on_step).rows()


def _plain(*extra: tuple[str, str, str]) -> Callable[[Found], list[Shown]]:
    return lambda found: show_rows(found, *extra)


TRANSFER = (
    Table(
        "towns",
        "Intra- and inter-domain transfer",
        "Made-up towns stand for CARLA's, so levels differ; compare patterns: within against between towns, POT against RePOT. "
        "The paper's RePOT rows are fitted to the test points; beside them stands our row of that name. RePOT is honest.",
        "90",
        _town_cells,
        _show_towns,
    ),
    Table(
        "instantaneous",
        "Instantaneous maps in dynamic scenes",
        "The paper's dynamic town has 120 cars in CARLA, ours traffic in a made-up town. KITTI is another "
        "drive than the paper's, and its ring is the one nearest to level; 3D has no figure in the paper.",
        "30",
        _instant_cells,
        _show_instant,
    ),
    Table(
        "first-frames",
        "Atoms of the first frames of the target's own domain",
        "The paper takes the first 10 frames and gives one figure; its code has six atoms picked by hand.",
        "20",
        _frame_cells,
        _plain(("atoms", "atoms", "d")),
        x="frames",
    ),
    Table(
        "sim-to-real",
        "Simulation to reality",
        "The paper's figures are of instantaneous maps; these are overall maps, with the recording's own atoms beside.",
        "30",
        _real_cells,
        _plain(),
    ),
)
