"""One map through one domain: scan by scan, a fifth of each scan's beams kept back, and then the scores on those."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import score
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet, MapUpdate
from potserver.evaluation.mappers import Answer, Mapper, ServiceMap
from potserver.evaluation.paper.scenes import Scene, open_scene
from potserver.evaluation.paper.sizes import Size
from potserver.mapping.paper import PAPER
from potserver.mapping.refinement import Effort, refine
from potserver.mapping.service import MakePipeline, MappingService, pipeline_of
from potserver.mapping.settings import MappingSettings
from potserver.recordings import to_scan

AUTHORS_CLIP = 1e-15  # of probabilities in the NLL of the authors' code
_TEST_EFFORT = Effort(newton_steps=12, gradient_steps=20)
_CUBE_M = 1.0

Row = dict[str, Any]  # what one map scored, by name


class OurMap(ServiceMap):
    """A map of the service that keeps what each scan's report says."""

    def __init__(self, name: str, service: MappingService) -> None:
        super().__init__(name, service)
        self.updates: list[MapUpdate] = []
        self._service_of = service

    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        update = self._service_of.integrate(to_scan(scan, len(self.updates)))
        self.updates.append(update)
        return update.timings_ms


def paper_map(
    name: str, atoms: AtomDictionary, make_pipeline: MakePipeline = pipeline_of, *, threads: int
) -> OurMap:
    """An empty map of profile `paper`, or of another pipeline with its settings."""
    settings = MappingSettings.of_profile("paper")
    return OurMap(name, MappingService(atoms, settings, threads=threads, make_pipeline=make_pipeline))


def scans_of(
    scene: Scene, size: Size, data: Path | None, *, first: int | None = None
) -> Iterator[tuple[int, RecordedScan]]:
    """Numbers and scans of a target domain.

    Raises:
        NoDataError: the recording is not there.
    """
    recording = open_scene(scene, data, size.drive)
    numbers = range(len(recording))[scene.first if first is None else first :: scene.every]
    for number in numbers[: size.scans]:
        scan = recording[number]
        thin = -(-len(scan) // size.most_beams)
        yield number, dataclasses.replace(scan, points=scan.points[::thin], is_return=scan.is_return[::thin])


def scored(answer: Answer, labels: LabelledPoints) -> Row:
    """ACC, AUC, NLL and ECE, and the NLL with the authors' clip."""
    found = score(answer.mean, labels.occupied, answer.observed)
    told = np.where(labels.occupied, answer.mean, 1.0 - answer.mean)
    strict = -np.log(np.clip(np.where(answer.observed, told, 0.5), AUTHORS_CLIP, 1.0)).mean()
    return {
        "acc": found.accuracy,
        "auc": found.auc,
        "nll": found.nll,
        "nll_authors_clip": float(strict),
        "ece": found.ece,
        "unknown": found.share_unknown,
        "points": found.n,
    }


class Run(NamedTuple):
    """Maps after all scans, and what they are asked."""

    maps: list[Mapper]
    labels: LabelledPoints
    cpu_ms: list[list[float]]  # a scan, of each map

    def rows(self) -> list[Row]:
        """Scores of each map."""
        rows = []
        for mapper, times in zip(self.maps, self.cpu_ms, strict=True):
            size = mapper.size()
            row = {"map": mapper.name} | scored(mapper.ask(self.labels.points), self.labels)
            rows.append(row | {"kernels": size.cells, "cpu_ms": float(np.median(times)), "scans": len(times)})
        return rows


def run_maps(
    maps: list[Mapper], scans: Iterator[tuple[int, RecordedScan]], on_scan: Callable[[], None] = lambda: None
) -> Run:
    """Feed all maps the same scans, without a fifth of the beams. The first scan pays for what is compiled: see medians."""
    hold_out = HoldOut()
    labels: list[LabelledPoints] = []
    times: list[list[float]] = [[] for _ in maps]
    for number, scan in scans:
        given, kept_back = hold_out.split(scan, number)
        labels.append(kept_back)
        for mapper, spent in zip(maps, times, strict=True):
            start = time.process_time()
            mapper.integrate(given)
            spent.append(1e3 * (time.process_time() - start))
        on_scan()
    return Run(maps, LabelledPoints.concatenate(labels), times)


def fitted(
    kernels: KernelSet, points: Float64, occupied: Bool, *, threads: int
) -> Callable[[Float64], Answer]:
    """What a map says once its weights are fitted to labelled points, its present weights as the prior.

    Asked about the same points it repeats how the paper's RePOT rows were made. That is no test.

    Args:
        kernels: Of the map.
        points: (N, 3) m, map frame.
        occupied: (N,) their labels.
        threads: Of the solve.
    """
    ones = np.ones(len(points), np.float32)
    found = refine(kernels, points, occupied, ones, edge_m=_CUBE_M, effort=_TEST_EFFORT, threads=threads)
    solved = KernelMap(found.kernels, rule=PAPER.rule, threads=threads)

    def ask(at: Float64) -> Answer:
        answer = solved.occupancy(at)
        return Answer(answer.mean, answer.observed)

    return ask
