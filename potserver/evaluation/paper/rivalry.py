"""The paper's comparison: every method online, with the time a scan that POT takes."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable
from functools import partial
from statistics import median

from potclient.datasets import RecordedScan
from potserver.atoms.learning import LearningSettings
from potserver.domain.dictionary import AtomDictionary
from potserver.errors import SettingsError
from potserver.evaluation.mappers import Mapper, ServiceMap
from potserver.evaluation.paper import published
from potserver.evaluation.paper.rivals import AbhmPipeline, BhmPipeline
from potserver.evaluation.paper.scenes import REACH_M, Scene
from potserver.evaluation.paper.table import Cell, Found, Lab, Shown, Table, show_rows
from potserver.evaluation.paper.transfer import METHODS, towns_of
from potserver.evaluation.paper.trial import Row, paper_map, run_maps, scans_of
from potserver.evaluation.peers import peer_named
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings

_OGM = "octomap:0.2"
_TILE_PARTS = (10, 20, 40)  # of a tile's edge: spacings of BHM's lattices
_ABHM_KERNELS = (5, 10, 20, 40, 80, 160, 320)  # of a sector
_TRIED = 3  # scans on which a budget is tried


def _cells(lab: Lab) -> list[Cell]:
    return [
        Cell(target.name, partial(_compare, lab, target))
        for planar in (True, False)
        for target in towns_of(lab, planar=planar)
    ]


def _compare(lab: Lab, target: Scene) -> list[Row]:
    sources = {scene.name: lab.sources.of(scene) for scene in towns_of(lab, planar=target.planar)}

    def maps_of_atoms() -> list[Mapper]:
        return [
            paper_map(f"{method}, atoms of {name}", atoms, METHODS[method], threads=lab.threads)
            for method in ("RePOT", "POT")
            for name, atoms in sources.items()
        ]

    first = list(itertools.islice(scans_of(target, lab.size, lab.data), _TRIED))
    pot = maps_of_atoms()[-1]
    budget_ms = _cost_ms(pot, first)
    maps = maps_of_atoms()
    maps.append(_most(first, budget_ms, (partial(_abhm, lab, n) for n in _ABHM_KERNELS)))
    maps += [_bhm(lab, n) for n in _TILE_PARTS if _cost_ms(_bhm(lab, n), first) <= budget_ms]
    maps.append(ServiceMap("potserver, profile default", MappingService(threads=lab.threads)))
    try:
        ogm = peer_named(_OGM, threads=lab.threads)
        ogm.name = f"OGM: {ogm.name}"
        maps.append(ogm)
    except SettingsError:
        pass  # pyoctomap is an extra: the row is missing then
    rows = run_maps(maps, scans_of(target, lab.size, lab.data), lab.on_step).rows()
    return [row | {"budget_ms": budget_ms} for row in rows]


def _bhm(lab: Lab, parts: int) -> Mapper:
    spacing_m = MappingSettings.of_profile("paper").tile_size_m / parts
    make = partial(BhmPipeline, spacing_m=spacing_m)
    return paper_map(f"BHM, lattice of {spacing_m:.2f} m", AtomDictionary(), make, threads=lab.threads)


def _abhm(lab: Lab, n_kernels: int) -> Mapper:
    learning = LearningSettings(
        max_range_m=REACH_M, max_kernels=n_kernels, points_per_kernel=2, max_labelled=2_000, max_epochs=2,
        dispersion_epochs=1, steps=15,
    )  # fmt: skip
    make = partial(AbhmPipeline, learning=learning)
    return paper_map(f"ABHM, {n_kernels} kernels a sector", AtomDictionary(), make, threads=lab.threads)


def _most(
    first: list[tuple[int, RecordedScan]], budget_ms: float, ladder: Iterable[Callable[[], Mapper]]
) -> Mapper:
    """An empty map of the largest step of a ladder that keeps to the budget; of the least if none does."""
    kept: Callable[[], Mapper] | None = None
    for make in ladder:
        if kept is not None and _cost_ms(make(), first) > budget_ms:
            break
        kept = make
    assert kept is not None, "a ladder has steps"
    return kept()


def _cost_ms(mapper: Mapper, scans: list[tuple[int, RecordedScan]]) -> float:
    """Processor ms a scan, median, of a map that is thrown away."""
    spent = []
    for _, scan in scans:
        start = time.process_time()
        mapper.integrate(scan)
        spent.append(1e3 * (time.process_time() - start))
    return median(spent)


def _show(found: Found) -> list[Shown]:
    heads = ["method", *(f"Town {k + 1}: ACC, AUC, NLL" for k in range(3))]
    lines = [
        [method, *(f"{f['acc'][k]:.2f}, {f['auc'][k]:.2f}, {f['nll'][k]:.2f}" for k in range(3))]
        for method, f in published.COMPARISON.items()
    ]
    ours = show_rows(found, ("POT's ms/scan", "budget_ms", ".0f"))
    return [*ours, Shown("the paper's: RePOT from Town 1, POT from Town 3", heads, lines)]


RIVALRY = (
    Table(
        "comparison",
        "Equal time: RePOT, POT, ABHM, BHM and an occupancy grid",
        "The paper takes POT from one source and RePOT from another; here a row has one. ABHM gets as many kernels as fit "
        "into POT's time, BHM every lattice that does; the grid and `default` take what they take, as the column says.",
        "60",
        _cells,
        _show,
    ),
)
