"""What `potserver eval` is told and what it shows: flags to maps, results to tables and files."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from potclient.errors import DatasetError, UsageError
from potclient.holdout import HoldOut
from potschemas import __version__
from potserver.atoms.build.recipe import Reader, RecordingRecipe, open_recording, parse_recipe
from potserver.config import Settings
from potserver.domain.dictionary import AtomDictionary
from potserver.errors import SettingsError
from potserver.evaluation.ablations import ABLATIONS
from potserver.evaluation.mappers import Mapper, ServiceMap
from potserver.evaluation.peers import peer_named
from potserver.evaluation.protocol import Evaluation, Row, evaluate
from potserver.mapping.settings import MappingSettings
from potserver.numerics.threads import default_threads

_HELD_OUT = (
    "map",
    "kernels",
    "bytes",
    "ms/scan",
    "[range]",
    "CPU ms",
    "ACC",
    "AUC",
    "NLL",
    "Brier",
    "ECE",
    "unknown",
)
_TRUTH = {"uniform": "uniform", "near_surfaces": "near surfaces"}


def run(options: argparse.Namespace, settings: Settings) -> list[Evaluation]:
    """Evaluate on every dataset; tables as they are known, files at the end.

    Raises:
        SettingsError: the flags name no map, no dataset, or no place to write to.
        PotserverError: a map refuses a scan.
    """
    for name in (options.json, options.markdown):
        if (
            name is not None and not Path(name).absolute().parent.is_dir()
        ):  # asked before the work, not after it
            raise SettingsError(f"cannot write {name}: no folder {Path(name).absolute().parent}")
    dictionary = AtomDictionary.load(settings.dictionary) if settings.dictionary else AtomDictionary.builtin()
    threads = settings.threads or default_threads()
    console = Console(highlight=False, width=None if sys.stdout.isatty() else 160)
    console.print(_machine(threads))
    found = []
    for dataset in options.datasets:
        try:
            evaluation = _evaluate(dataset, options, settings, dictionary, threads)
        except (DatasetError, UsageError) as error:
            told = str(error)
            raise SettingsError(told if dataset in told else f"{dataset}: {told}") from error
        found.append(evaluation)
        _print(evaluation, console, settings.mapping)
    if options.json is not None:
        Path(options.json).write_text(json.dumps(_report(found, options, threads), indent=1) + "\n")
    if options.markdown is not None:
        Path(options.markdown).write_text(to_markdown(found))
    return found


def our_maps(options: argparse.Namespace, settings: Settings, dictionary: AtomDictionary) -> list[Mapper]:
    """The map that is asked for and, on request, what it is made of.

    Raises:
        SettingsError: ablations of another profile than `default`.
    """
    mapping, threads = settings.mapping, settings.threads or default_threads()
    maps: list[Mapper] = [ServiceMap(mapping.profile, mapping, dictionary, threads=threads)]
    if options.ablations:
        if mapping.profile != "default":
            raise SettingsError(
                f"--ablations take parts out of profile `default`, not of `{mapping.profile}`"
            )
        maps += [
            ServiceMap(name, mapping, dictionary, threads=threads, make_pipeline=make_pipeline)
            for name, make_pipeline in ABLATIONS.items()
        ]
    return maps


def to_markdown(evaluations: Sequence[Evaluation]) -> str:
    """The tables as in a document."""
    parts = []
    for evaluation in evaluations:
        parts.append(f"**{_title(evaluation)}**\n")
        for heads, lines in _tables(evaluation):
            rows = [heads, ["---"] * len(heads), *lines]
            parts.append("\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n")
    return "\n".join(parts)


def _evaluate(
    dataset: str,
    options: argparse.Namespace,
    settings: Settings,
    dictionary: AtomDictionary,
    threads: int,
) -> Evaluation:
    reader = Reader(
        format=options.format,
        frame=options.frame,
        no_return_m=options.no_return,
        min_range_m=options.min_range,
        max_range_m=options.max_range,
    )
    recording = open_recording(dataset, reader)
    numbers = asked_scans(dataset, options.scans).numbers(len(recording))
    maps = our_maps(options, settings, dictionary)
    maps += [peer_named(name, threads=threads) for name in options.peers]
    with _progress(dataset, len(numbers) + len(maps)) as on_step:
        return evaluate(
            dataset,
            recording,
            numbers,
            maps,
            hold_out=HoldOut(options.hold_out),
            thin=options.thin,
            on_step=on_step,
        )


def asked_scans(dataset: str, text: str | None) -> RecordingRecipe:
    """The recording with the scans that a flag asks for, all of them by default."""
    scans: int | str = ":" if text is None else int(text) if text.isdecimal() else text
    return parse_recipe({"recordings": [{"dataset": dataset, "scans": scans}]}, "flags").recordings[0]


@contextmanager
def _progress(dataset: str, steps: int) -> Iterator[Callable[[str], None]]:
    """A bar on stderr: a step a scan and one a map that is judged."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(dataset, total=steps)
        done = -1

        def on_step(what: str) -> None:
            nonlocal done
            done += 1
            bar.update(task, completed=done, description=f"{dataset}: {what}")

        yield on_step


# --- what is shown -------------------------------------------------------------------------------------------------------


def _print(evaluation: Evaluation, console: Console, mapping: MappingSettings) -> None:
    console.print(f"\n[bold]{_title(evaluation)}[/bold]")
    for heads, lines in _tables(evaluation):
        table = Table(box=None, pad_edge=False, header_style="dim")
        for k, head in enumerate(heads):
            table.add_column(head.replace("[", r"\["), justify="left" if k == 0 else "right", no_wrap=k == 0)
        for line in lines:
            table.add_row(*(cell.replace("[", r"\[") for cell in line))
        console.print(table)
    if evaluation.reach_m > mapping.max_range_m * 1.001:
        console.print(
            f"Our maps look {mapping.max_range_m:g} m far, the held-out beams are up to {evaluation.reach_m:.1f} m long: "
            "set --max-range, or mapping.max_range_m."
        )
    stages = evaluation.rows[0].stage_ms
    if stages:
        console.print(
            f"{evaluation.rows[0].name}, median ms: "
            + ", ".join(f"{stage} {ms:.0f}" for stage, ms in stages.items())
        )


def _title(evaluation: Evaluation) -> str:
    return (
        f"{evaluation.dataset}: {evaluation.n_scans} scans, {evaluation.n_beams:,} beams mapped, "
        f"{evaluation.rows[0].held_out.n:,} held-out points, {evaluation.path_m:.0f} m of way"
    )


def _tables(evaluation: Evaluation) -> Iterator[tuple[list[str], list[list[str]]]]:
    """Heads and rows: the held-out points; then what only some maps or datasets have."""
    yield list(_HELD_OUT), [_held_out_cells(row) for row in evaluation.rows]
    truths = list(evaluation.rows[0].truth)
    heads = ["map"]
    for name in truths:
        heads += [f"{_TRUTH[name]}: ACC", "AUC", "NLL", "unknown"]
    heads += ["P(return) of beams without one", "range error, m"]
    lines = []
    for row in evaluation.rows:
        cells = [row.name]
        for name in truths:
            m = row.truth[name]
            cells += [f"{m.accuracy:.3f}", f"{m.auc:.4f}", f"{m.nll:.3f}", f"{m.share_unknown:.1%}"]
        if row.rays is not None:
            cells += [_number(row.rays.false_return), _number(row.rays.range_error_m)]
        elif truths:
            cells += ["-", "-"]
        else:
            continue
        lines.append(cells)
    if lines:
        yield heads, lines


def _held_out_cells(row: Row) -> list[str]:
    m = row.held_out
    spread = "batch" if row.is_batch else f"[{min(row.scan_ms):.0f}-{max(row.scan_ms):.0f}]"
    times = [f"{np.median(row.scan_ms):.0f}", spread, f"{np.median(row.cpu_ms):.0f}"]
    scores = [f"{m.accuracy:.3f}", f"{m.auc:.4f}", f"{m.nll:.3f}", f"{m.brier:.3f}", f"{m.ece:.3f}"]
    return [
        row.name,
        f"{row.size.cells:,}",
        f"{row.size.n_bytes:,}",
        *times,
        *scores,
        f"{m.share_unknown:.1%}",
    ]


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


def _machine(threads: int) -> str:
    return (
        f"potserver {__version__}, {platform.machine()}, {os.cpu_count()} processors, {threads} threads, "
        f"Python {platform.python_version()}, load {os.getloadavg()[0]:.1f}"
    )


def _report(found: list[Evaluation], options: argparse.Namespace, threads: int) -> dict[str, Any]:
    shown = {key: value for key, value in vars(options).items() if key != "run"}
    return {
        "machine": _machine(threads),
        "options": shown,
        "evaluations": [evaluation.to_json() for evaluation in found],
    }
