"""From a recipe to a dictionary: candidates of all scans, then a cover of them. Knows neither flags nor a terminal."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
from collections.abc import Callable, Iterator
from pathlib import Path

from potclient.errors import DatasetError
from potserver.atoms.build.engines import Engine
from potserver.atoms.build.recipe import Recipe, located
from potserver.atoms.build.scan_task import Candidate, Progress, ScanResult, ScanTask, learn_scan
from potserver.atoms.cover import greedy_cover
from potserver.atoms.expectation import learn_expectation
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Scan
from potserver.errors import DictionaryError, PotserverError
from potserver.numerics.surroundings import Perceptron
from potserver.recordings import Reader, open_recording, to_scan

COVERED = "near a kept atom"
OVER_LIMIT = "beyond max_atoms"
_TOLD_BY, _TOLD_BY_TOWN = (
    28,
    14,
)  # scans of a recording, about, that expectations are learned from; of a further town


@dataclasses.dataclass(slots=True)
class RecordingReport:
    """What became of one recording."""

    name: str
    n_scans: int
    n_failed: int = 0
    n_without_hits: int = 0  # sectors
    n_candidates: int = 0
    refused: collections.Counter[str] = dataclasses.field(default_factory=collections.Counter)
    kept: list[Candidate] = dataclasses.field(default_factory=list)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Built:
    """A dictionary, and how it came about."""

    dictionary: AtomDictionary
    reports: list[RecordingReport]


def scan_tasks(recipe: Recipe, folder: Path) -> list[ScanTask]:
    """Every scan that a recipe takes atoms from, in order.

    Args:
        recipe: What to build.
        folder: Where its relative paths start.
    Raises:
        DictionaryError: a recording or town cannot be opened, or has none of the scans asked for.
    """
    try:
        for town in recipe.expect_too:
            open_recording(town, Reader())
    except DatasetError as error:
        raise DictionaryError(str(error)) from error
    tasks: list[ScanTask] = []
    for index, recording in enumerate(recipe.recordings):
        found = located(recording, folder)
        try:
            numbers = recording.numbers(len(open_recording(found.dataset, found.reader)))
        except DatasetError as error:
            raise DictionaryError(str(error)) from error
        if not numbers:
            raise DictionaryError(f"{recording.dataset}: no scans in {recording.scans}")
        tasks += [
            ScanTask(
                recording=index,
                name=recording.prefix,
                dataset=found.dataset,
                reader=found.reader,
                source=recording.dataset,
                licence=recording.licence,
                dims=recording.dims,
                number=number,
                window=recording.window,
                later=tuple(numbers[i + 1 : i + 1 + recipe.later_scans]),
                settings=recipe.learner_of(recording),
                quality=recipe.quality,
                seed=recipe.seed + number,
            )
            for i, number in enumerate(numbers)
        ]
    return tasks


def build(
    recipe: Recipe,
    tasks: list[ScanTask],
    engine: Engine,
    *,
    strict: bool = False,
    threads: int = 1,
    on_scan: Callable[[ScanResult], None] | None = None,
    on_epoch: Callable[[Progress], None] | None = None,
    on_chosen: Callable[[int, int, int], None] | None = None,
) -> Built:
    """Learn the candidates, and cover them. The same tasks give the same atoms, whatever runs them.

    Args:
        recipe: What to build.
        tasks: Its `scan_tasks`.
        engine: Runs them.
        strict: Whether a scan that fails ends it all.
        threads: For the cover.
        on_scan: Called with each scan's result, in order.
        on_epoch: Called with the held-out scores of every sector as it is learned; only for an engine of this process.
        on_chosen: Called after each chosen atom with its dimensions, the number chosen, and how many are left to cover.
    Raises:
        DictionaryError: no candidate at all, a failed scan if `strict`, or what the engine raises.
    """
    reports = [
        RecordingReport(recording.prefix, sum(task.recording == i for task in tasks))
        for i, recording in enumerate(recipe.recordings)
    ]
    candidates: list[list[Candidate]] = [[] for _ in reports]
    failures: list[str] = []
    learn = learn_scan if on_epoch is None else functools.partial(learn_scan, on_epoch=on_epoch)
    for result in engine.map(learn, tasks):
        if on_scan is not None:
            on_scan(result)
        report = reports[result.task.recording]
        if result.failure is not None:
            failures.append(f"{report.name}, scan {result.task.number}: {result.failure}")
            report.n_failed += 1
            if strict:
                raise DictionaryError(failures[-1])
        report.n_without_hits += result.n_without_hits
        report.n_candidates += len(result.candidates) + len(result.refused)
        report.refused.update(result.refused.values())
        candidates[result.task.recording] += result.candidates
    if not any(candidates):
        raise DictionaryError(f"no atoms: {_why_none(reports, failures)}")
    for dims in (3, 2):
        _choose(recipe, dims, candidates, reports, threads, on_chosen)
    atoms = [candidate.atom for report in reports for candidate in report.kept]
    return Built(dictionary=AtomDictionary(atoms, expectation=expectation_of(recipe, tasks)), reports=reports)


def expectation_of(recipe: Recipe, tasks: list[ScanTask]) -> Perceptron | None:
    """What the recordings of tasks teach to expect, by scans from all over each; None if they cannot tell."""
    deep = {task.recording: task for task in tasks if task.dims != 2}
    if not deep:
        return None
    reach = max(task.settings.max_range_m for task in deep.values())
    told = [_scans_of(task.dataset, task.reader, _TOLD_BY) for task in deep.values()]
    told += [_scans_of(town, Reader(max_range_m=reach), _TOLD_BY_TOWN) for town in recipe.expect_too]
    return learn_expectation(told, max_range_m=reach, seed=recipe.seed)


def _scans_of(dataset: str, reader: Reader, n: int) -> Iterator[Scan]:
    """About n scans of a recording, evenly spread; what cannot be read is left out, for its own task reports it."""
    try:
        recording = open_recording(dataset, reader)
    except (DatasetError, OSError):
        return
    for number in range(0, len(recording), -(-len(recording) // n)):
        with contextlib.suppress(DatasetError, PotserverError, OSError):
            yield to_scan(recording[number], number)


def _choose(
    recipe: Recipe,
    dims: int,
    candidates: list[list[Candidate]],
    reports: list[RecordingReport],
    threads: int,
    on_chosen: Callable[[int, int, int], None] | None,
) -> None:
    """Cover the candidates of one number of dimensions, of all recordings together; the reports take what came of it."""
    pool = list(_of_dims(dims, candidates))
    if not pool:
        return
    atoms = [candidate.atom for _, candidate in pool]
    tolerances = [
        recipe.tolerance_of(recipe.recordings[index], candidate.atom.radius_m) for index, candidate in pool
    ]
    cover = greedy_cover(
        atoms,
        [candidate.content_nats for _, candidate in pool],
        tolerances,
        max_atoms=recipe.max_atoms,
        group=[index for index, _ in pool],
        max_of_group=[recording.max_atoms for recording in recipe.recordings],
        threads=threads,
        on_chosen=None if on_chosen is None else functools.partial(on_chosen, dims),
    )
    for i, (index, candidate) in enumerate(pool):
        if cover.covered_by[i] == i:
            noted = {"tolerance_m": f"{tolerances[i]:g}", "covers": str(int((cover.covered_by == i).sum()))}
            atom = dataclasses.replace(candidate.atom, provenance=candidate.atom.provenance | noted)
            reports[index].kept.append(candidate._replace(atom=atom))
        else:
            reports[index].refused[OVER_LIMIT if cover.covered_by[i] < 0 else COVERED] += 1


def _of_dims(dims: int, candidates: list[list[Candidate]]) -> Iterator[tuple[int, Candidate]]:
    for index, found in enumerate(candidates):
        yield from ((index, candidate) for candidate in found if candidate.atom.dims == dims)


def _why_none(reports: list[RecordingReport], failures: list[str]) -> str:
    refused: collections.Counter[str] = sum((report.refused for report in reports), collections.Counter())
    reasons = [f"{count} refused ({reason})" for reason, count in sorted(refused.items())]
    if n_without_hits := sum(report.n_without_hits for report in reports):
        reasons.append(f"{n_without_hits} sectors with too few hits")
    if failures:
        reasons.append(f"{len(failures)} scans failed, the first: {failures[0]}")
    return "; ".join(reasons)
