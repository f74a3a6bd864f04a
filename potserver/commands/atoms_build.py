"""`potserver atoms build`: flags to a recipe, results to a progress bar and a table."""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib.util
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from potclient.commands.output_files import output_file
from potclient.extras import how_to_install
from potserver.commands.shared import (
    EXIT_FORCED,
    EXIT_OK,
    add_verb,
    results_console,
    say,
    table,
)
from potserver.errors import DictionaryError
from potserver.toml import toml_value

if TYPE_CHECKING:
    from rich.console import Console

    from potclient.metrics import Metrics
    from potserver.atoms.build.builder import Built, RecordingReport
    from potserver.atoms.build.engines import Engine
    from potserver.atoms.build.recipe import Recipe
    from potserver.atoms.build.scan_task import Progress, ScanResult

_ABOUT = """\
Learn a dictionary: atoms of all sectors of the recordings' scans, scored on beams that they never saw. Of the good ones
so many are kept that each of the others has a kept atom within the tolerance.

The same recipe gives the same file, however many workers there are, on one machine with the same versions."""

_EXAMPLES = """\
examples:
  potserver atoms build /data/kitti/00 --scans 0:1000:10 --licence "CC BY-NC-SA 3.0" -o kitti.atoms
  potserver atoms build town:terraces:1 town:suburb:2 --learner n_sectors=8 -o towns.atoms
  potserver atoms build --recipe site.toml -o site.atoms      a recipe: see docs/dictionary.md
  potserver atoms build --recipe site.toml -o site.atoms --ray auto
                                                              on a Ray cluster, with recordings at the same paths"""


def add(commands: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        commands, "build", _run, help="learn a dictionary from recordings", description=_ABOUT, epilog=_EXAMPLES
    )  # fmt: skip
    parser.add_argument("datasets", nargs="*", metavar="DATASET", help="recordings to learn from")
    parser.add_argument(
        "-o", "--out", type=output_file, required=True, metavar="FILE", help="dictionary file to write"
    )
    parser.add_argument("--recipe", metavar="FILE", help="TOML file that says what to learn from, and how")
    parser.add_argument(
        "--builtin", action="store_true", help="the recipe of the dictionary that the package ships"
    )
    parser.add_argument("--strict", action="store_true", help="end at the first scan that fails")
    running = parser.add_argument_group("where it runs")
    running.add_argument(
        "--watch", action="store_true", help="in this process, with each sector's held-out scores as it learns"
    )  # fmt: skip
    running.add_argument("--workers", type=int, metavar="N", help="scans learned at once [all processors]")
    running.add_argument(
        "--ray", metavar="ADDRESS", help="on a Ray cluster; `local` starts one here (needs potserver[ray])"
    )
    without = parser.add_argument_group("without a recipe")
    without.add_argument(
        "--scans", metavar="N", help="the first N of each recording, or START:STOP:STEP [all]"
    )
    without.add_argument(
        "--tolerance", type=float, metavar="M", help="of the cover, m [0.15 of the atoms' radius]"
    )
    without.add_argument(
        "--max-atoms", type=int, metavar="N", help="kept in each number of dimensions [no limit]"
    )
    without.add_argument(
        "--licence", metavar="TEXT", help="of the recordings, kept with the atoms [not stated]"
    )
    without.add_argument(
        "--learner", action="append", default=[], metavar="KEY=VALUE", help="a setting of the learner; repeatable"
    )  # fmt: skip


def _run(options: argparse.Namespace) -> int:
    from potserver.log import configure_logging

    configure_logging("warning", "console")
    try:
        built = _build(options)
    except KeyboardInterrupt:  # Ctrl-C or SIGTERM
        say("potserver: interrupted, nothing was written", sys.stderr)
        return EXIT_FORCED
    n_kernels = sum(len(atom.kernels) for atom in built.dictionary)
    say(f"{len(built.dictionary)} atoms, {n_kernels} kernels, written to {options.out}")
    return EXIT_OK


def _build(options: argparse.Namespace) -> Built:
    """Learn, choose, save.

    Raises:
        DictionaryError: nothing to learn from, or nothing learned.
        SettingsError: the recipe is wrong, or there is nowhere to write.
        KeyboardInterrupt: at Ctrl-C or SIGTERM; nothing is written then.
    """
    check_installed("torch", "open3d")
    from potserver.atoms.build.builder import build, scan_tasks

    recipe, folder = recipe_of(options)
    workers = _workers(options)
    console = results_console()
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
    built.dictionary.save(options.out)
    _print_summary(built, console)
    console.print(f"{time.monotonic() - started:.0f} s")
    return built


def _workers(options: argparse.Namespace) -> int:
    from potserver.numerics.threads import default_threads

    if options.watch and (options.workers is not None or options.ray is not None):
        raise DictionaryError("--watch learns in this process alone: leave out --workers and --ray")
    if options.watch:
        return 1
    workers = default_threads() if options.workers is None else options.workers
    if workers < 1:
        raise DictionaryError(f"--workers {workers}: need at least 1")
    return int(workers)


def check_installed(*packages: str) -> None:
    """Refuse before any work.

    Args:
        packages: That learning needs.

    Raises:
        DictionaryError: a package that learning needs is missing.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise DictionaryError(f"learning atoms needs {' and '.join(missing)}: {how_to_install('learn')}")


def recipe_of(options: argparse.Namespace) -> tuple[Recipe, Path]:
    """The recipe that the flags name or spell out, and the folder where its relative paths start.

    Raises:
        DictionaryError: the flags name none, or two. SettingsError: it is wrong.
    """
    from potserver.atoms.build.recipe import builtin_recipe, parse_recipe, read_recipe

    if sum((bool(options.datasets), options.builtin, options.recipe is not None)) != 1:
        raise DictionaryError(
            "name recordings to learn from, or --recipe FILE, or --builtin, and not two of them"
        )
    stated: dict[str, Any] = {
        "tolerance_m": options.tolerance,
        "max_atoms": options.max_atoms,
        "scans": options.scans,
        "licence": options.licence,
        "learner": dict(map(_assignment, options.learner)) or None,
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


def _assignment(text: str) -> tuple[str, Any]:
    """KEY=VALUE with the value as in TOML."""
    key, _, value = text.partition("=")
    try:
        return key, toml_value(value)
    except ValueError as error:
        raise DictionaryError(f"--learner {text!r}: need KEY=VALUE, the value as in TOML") from error


def _engine(options: argparse.Namespace, workers: int) -> contextlib.AbstractContextManager[Engine]:
    from potserver.atoms.build.engines import in_turn, processes, ray_cluster

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
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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

    def epoch(self, at: Progress) -> None:
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
    heads = ("recording", "scans", "failed", "candidates", "refused", "kept", *_SCORES)
    rows = [
        (
            report.name, str(report.n_scans), str(report.n_failed), str(report.n_candidates),
            str(report.refused.total()), str(len(report.kept)), *_scores(report),
        )
        for report in built.reports
    ]  # fmt: skip
    console.print(table(heads, rows))
    refused: collections.Counter[str] = sum((r.refused for r in built.reports), collections.Counter())
    for reason, count in sorted(refused.items(), key=lambda item: (-item[1], item[0])):
        console.print(f"refused {count}: {reason}")
    if n_without_hits := sum(report.n_without_hits for report in built.reports):
        console.print(f"sectors with too few hits to learn from: {n_without_hits}")
    console.print(
        "scores: means over the kept atoms, each on held-out beams of its own sector, of its own and of later scans"
    )


_SCORES = ("ACC", "AUC", "NLL", "ECE", "later AUC", "later NLL")


def _scores(report: RecordingReport) -> list[str]:
    own = [candidate.scores for candidate in report.kept]
    later = [candidate.later for candidate in report.kept if candidate.later is not None]
    columns = [(own, name) for name in ("accuracy", "auc", "nll", "ece")] + [(later, "auc"), (later, "nll")]
    return [_mean(scores, name) for scores, name in columns]


def _mean(scores: list[Metrics], name: str) -> str:
    """The mean weighted by the number of points; "-" where there are no scores."""
    n = sum(s.n for s in scores)
    return f"{sum(s.n * getattr(s, name) for s in scores) / n:.3f}" if n else "-"
