"""What `potserver atoms build` is told and what it shows: flags to a recipe, results to a progress bar and tables."""

from __future__ import annotations

import argparse
import collections
import contextlib
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from potclient.metrics import Metrics
from potserver.atoms.build.builder import Built, RecordingReport, build, scan_tasks
from potserver.atoms.build.engines import Engine, in_turn, processes, ray_cluster
from potserver.atoms.build.recipe import Recipe, builtin_recipe, parse_recipe, read_recipe, tomllib
from potserver.atoms.build.scan_task import Progress as LearningProgress
from potserver.atoms.build.scan_task import ScanResult
from potserver.domain.dictionary import AtomDictionary
from potserver.errors import DictionaryError
from potserver.numerics.threads import default_threads


def run(options: argparse.Namespace) -> AtomDictionary:
    """Learn, choose, save.

    Raises:
        DictionaryError: nothing to learn from, nothing learned, or nowhere to write.
        SettingsError: the recipe is wrong.
        KeyboardInterrupt: at Ctrl-C or SIGTERM; nothing is written then.
    """
    recipe, folder = _recipe(options)
    out = Path(options.out)
    if not out.absolute().parent.is_dir():  # asked before the work, not after it
        raise DictionaryError(f"cannot write {out}: no folder {out.absolute().parent}")
    workers = default_threads() if options.workers is None else options.workers
    if workers < 1:
        raise DictionaryError(f"--workers {workers}: need at least 1")
    if options.watch and (options.workers is not None or options.ray is not None):
        raise DictionaryError("--watch learns in this process alone: leave out --workers and --ray")
    if options.watch:
        workers = 1
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
    started = time.monotonic()
    tasks = scan_tasks(recipe, folder)
    console.print(
        f"{len(tasks)} scans of {len(recipe.recordings)} recordings, "
        + (f"on Ray at {options.ray}" if options.ray else f"{workers} at a time")
    )
    with (
        _terminated_as_interrupted(),
        _engine(options, workers) as engine,
        _Shown(console, len(tasks)) as shown,
    ):
        built = build(
            recipe,
            tasks,
            engine,
            strict=options.strict,
            threads=workers,
            on_scan=shown.scan,
            on_epoch=shown.epoch if options.watch else None,
            on_chosen=shown.chosen,
        )
    built.dictionary.save(out)
    _print_summary(built, console)
    console.print(f"{time.monotonic() - started:.0f} s")
    return built.dictionary


def _recipe(options: argparse.Namespace) -> tuple[Recipe, Path]:
    """The recipe that the flags name or spell out, and the folder where its relative paths start."""
    if sum((bool(options.datasets), options.builtin, options.recipe is not None)) != 1:
        raise DictionaryError(
            "name recordings to learn from, or --recipe FILE, or --builtin, and not two of them"
        )
    stated: dict[str, Any] = {
        "tolerance_m": options.tolerance,
        "max_atoms": options.max_atoms,
        "scans": None if options.scans is None else _int_if_it_is_one(options.scans),
        "licence": options.licence,
        "learner": dict(_assignment(text) for text in options.learner) or None,
    }
    stated = {key: value for key, value in stated.items() if value is not None}
    if not options.datasets:
        if stated:
            raise DictionaryError(f"{', '.join(sorted(stated))}: stated by the recipe, not by flags")
        if options.builtin:
            return builtin_recipe(), Path.cwd()
        return read_recipe(options.recipe), Path(options.recipe).absolute().parent
    each = {key: stated.pop(key) for key in ("scans", "licence") if key in stated}
    tree = stated | {"recordings": [{"dataset": dataset, **each} for dataset in options.datasets]}
    return parse_recipe(tree, "flags"), Path.cwd()


def _int_if_it_is_one(text: str) -> int | str:
    return int(text) if text.isdecimal() else text


def _assignment(text: str) -> tuple[str, Any]:
    """KEY=VALUE with the value as in TOML."""
    key, _, value = text.partition("=")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError as error:
        raise DictionaryError(f"--learner {text!r}: need KEY=VALUE, the value as in TOML") from error


def _engine(options: argparse.Namespace, workers: int) -> contextlib.AbstractContextManager[Engine]:
    if options.watch:
        return in_turn()
    return processes(workers) if options.ray is None else ray_cluster(options.ray, workers)


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM ends the work the way Ctrl-C does: workers first."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


class _Shown:
    """A bar for the scans and one for the cover, and a line for every scan that fails."""

    def __init__(self, console: Console, n_scans: int) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[found]}"),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
        )
        self._learning = self._progress.add_task("scans learned", total=n_scans, found="")
        self._choosing = self._learning
        self._n_of = {2: 0, 3: 0}
        self._n_failed = 0
        self._n_done, self._n_scans = 0, n_scans

    def __enter__(self) -> _Shown:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def scan(self, result: ScanResult) -> None:
        if result.failure is not None:
            self._n_failed += 1
            self._progress.console.print(
                f"[yellow]failed[/yellow] {result.task.name}, scan {result.task.number}: {result.failure}",
                soft_wrap=True,
            )
        for candidate in result.candidates:
            self._n_of[candidate.atom.dims] += 1
        failed = f", {self._n_failed} scans failed" if self._n_failed else ""
        found = f"{sum(self._n_of.values())} atoms found{failed}"
        self._progress.update(self._learning, advance=1, found=found)
        if not self._progress.console.is_terminal:  # a bar that nobody sees move
            self._n_done += 1
            self._progress.console.print(f"{self._n_done} of {self._n_scans} scans learned, {found}")

    def epoch(self, at: LearningProgress) -> None:
        scores = "no held-out points"
        if at.scores is not None:
            s = at.scores
            scores = f"ACC {s.accuracy:.3f}  AUC {s.auc:.4f}  NLL {s.nll:.3f}  ECE {s.ece:.3f}  of {s.n} held-out points"
        sector = f"{at.task.name}-{at.task.number}-s{at.sector}"
        self._progress.console.print(f"{sector}  epoch {at.epoch:2d}  {scores}", soft_wrap=True)

    def chosen(self, dims: int, n_chosen: int, n_open: int) -> None:
        if n_chosen == 1:
            self._choosing = self._progress.add_task(f"{dims}D covered", total=self._n_of[dims], found="")
        self._progress.update(
            self._choosing, completed=self._n_of[dims] - n_open, found=f"{n_chosen} atoms kept"
        )


def _print_summary(built: Built, console: Console) -> None:
    table = Table(box=None, header_style="dim", pad_edge=False)
    table.add_column("recording")
    for column in (
        "scans",
        "failed",
        "candidates",
        "refused",
        "kept",
        "ACC",
        "AUC",
        "NLL",
        "ECE",
        "later AUC",
        "later NLL",
    ):
        table.add_column(column, justify="right")
    for report in built.reports:
        table.add_row(
            report.name, str(report.n_scans), str(report.n_failed), str(report.n_candidates),
            str(report.refused.total()), str(len(report.kept)), *_scores(report),
        )  # fmt: skip
    console.print(table)
    refused: collections.Counter[str] = sum((r.refused for r in built.reports), collections.Counter())
    for reason, count in sorted(refused.items(), key=lambda item: (-item[1], item[0])):
        console.print(f"refused {count}: {reason}")
    if n_without_hits := sum(report.n_without_hits for report in built.reports):
        console.print(f"sectors with too few hits to learn from: {n_without_hits}")
    console.print(
        "scores: means over the kept atoms, each on held-out beams of its own sector, of its own and of later scans"
    )


def _scores(report: RecordingReport) -> list[str]:
    own = [candidate.scores for candidate in report.kept]
    later = [candidate.later for candidate in report.kept if candidate.later is not None]
    columns = [(own, name) for name in ("accuracy", "auc", "nll", "ece")] + [(later, "auc"), (later, "nll")]
    return [_mean(scores, name) for scores, name in columns]


def _mean(scores: list[Metrics], name: str) -> str:
    """The mean weighted by the number of points; "-" where there are no scores."""
    if not scores:
        return "-"
    return f"{np.average([getattr(s, name) for s in scores], weights=[s.n for s in scores]):.3f}"
