"""`potserver eval`: flags to maps, results to tables and files."""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potclient.commands.output_files import output_file
from potclient.datasets import FORMATS, FRAMES
from potclient.errors import DatasetError, UsageError
from potclient.holdout import HoldOut
from potschemas import __version__
from potserver import bundled
from potserver.commands import eval_paper
from potserver.commands.eval_tables import tables_of
from potserver.commands.shared import (
    EXIT_OK,
    add_mapping_flags,
    add_verb,
    dictionary_of,
    positive_int,
    results_console,
    settings_of,
    table,
)
from potserver.errors import SettingsError

if TYPE_CHECKING:
    from rich.console import Console

    from potserver.config import Settings
    from potserver.domain.dictionary import AtomDictionary
    from potserver.evaluation.mappers import Mapper
    from potserver.evaluation.protocol import Evaluation
    from potserver.mapping.settings import MappingSettings

_ABOUT = """\
Measure maps on beams that they never saw: a fifth of each scan's beams is kept back, all scans go through the map scan
by scan, and then it is asked about those beams' ends (occupied) and points before them (free), near the ends too.

The headline is (H + N) / 2. H: NLL of the ends and a point at least 0.5 m before each, by protocol 1. N: NLL of the
ends and a point 0.05 to 0.5 m before each, on beams that meet their surface at less than 60 degrees. Thick walls help H
and harm N.

Towns and the gauntlet (doorways, poles and wires) are asked about their exact truth too. Times are of maps that take
turns, scan by scan, in this process.
--peers needs the extra `peers` for OctoMap.

`potserver eval paper` is another thing: the tables of the paper and of its text, on made-up towns in 2D and 3D and on
recordings, the paper's figures beside ours. It lists them; --table runs one. What was found is kept in --out, and a run
that was stopped goes on from there."""

_EXAMPLES = """\
examples:
  potserver eval /data/kitti/00 --scans 20 --max-range 25
  potserver eval /data/kitti/00 --scans 20 --max-range 25 --peers octomap:0.1,octomap:0.2,bgk:0.2,grid
  potserver eval town:terraces:dynamic:7 --scans 25 --max-range 25 --ablations --json out/town.json
  potserver eval town:suburb:7 --profile paper --set mapping.max_range_m=15
  potserver eval gauntlet:vlp16 --peers octomap:0.05
  potserver eval /data/kitti/00 --scans 1 --rings 4
  potserver eval bundled:rooms --peers grid
  potserver eval paper --table towns --size small --out out/paper
  potserver eval paper --all --data /data"""

_COLUMNS = 160  # of the tables in a pipe


def add(commands: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        commands, "eval", _run, help="measure maps on held-out beams, beside other kinds of maps", description=_ABOUT,
        epilog=_EXAMPLES,
    )  # fmt: skip
    parser.add_argument(
        "datasets",
        nargs="+",
        metavar="DATASET",
        help=f"recordings, as `potclient publish` takes them, or bundled:NAME ({', '.join(bundled.NAMES)})",
    )
    maps = parser.add_argument_group("maps")
    add_mapping_flags(maps)
    maps.add_argument(
        "--ablations", action="store_true", help="rows for POT and RePOT with its priors as well"
    )
    maps.add_argument(
        "--peers",
        type=lambda text: [name for name in text.split(",") if name],
        default=[],
        metavar="LIST",
        help="other maps: octomap:METRES, bgk:METRES, bgk-gap:METRES, grid; with commas",
    )
    _add_beam_flags(parser.add_argument_group("beams"))
    out = parser.add_argument_group("results")
    out.add_argument(
        "--json", type=output_file, metavar="FILE", help="all numbers, with the machine and the options"
    )
    out.add_argument("--markdown", type=output_file, metavar="FILE", help="the tables, for a document")
    eval_paper.add_flags(
        parser.add_argument_group("the paper's tables, with `paper` in place of a recording")
    )


def _add_beam_flags(beams: Any) -> None:
    beams.add_argument("--hold-out", type=float, default=0.2, metavar="SHARE", help="of the beams [0.2]")
    beams.add_argument(
        "--rings",
        type=positive_int,
        metavar="N",
        help="leave every Nth ring out of every scan, and score it apart (2D: every Nth sector of 5 degrees)",
    )
    beams.add_argument(
        "--scans", default=":", metavar="N", help="the first N of each recording, or START:STOP:STEP [all]"
    )
    beams.add_argument(
        "--thin", type=positive_int, default=1, metavar="N", help="every Nth beam of a scan [1]"
    )
    beams.add_argument(
        "--min-range", type=float, default=0.0, metavar="M", help="nearer beams are dropped [0]"
    )
    beams.add_argument(
        "--max-range", type=float, metavar="M", help="longer beams are free up to here, without an echo"
    )
    beams.add_argument(
        "--no-return", type=float, metavar="M", help="of CARMEN logs: readings from here on are no echoes"
    )
    beams.add_argument("--format", choices=FORMATS, default="auto", help="of the recordings [auto]")
    beams.add_argument(
        "--frame", choices=FRAMES, default="auto", help="of PCD files: where their points are [auto]"
    )


def _run(options: argparse.Namespace) -> int:
    """Evaluate on every dataset: tables as they are known, files at the end."""
    if eval_paper.WORD in options.datasets:
        return eval_paper.run(options)
    eval_paper.refuse_flags(options)
    from potserver.log import configure_logging
    from potserver.numerics.threads import default_threads, use_one_blas_thread

    use_one_blas_thread()
    settings = settings_of(options)
    configure_logging("warning", "console")
    dictionary = dictionary_of(settings.dictionary)
    threads = settings.threads or default_threads()
    console = results_console(_COLUMNS)
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
        options.json.write_text(json.dumps(_report(found, options, threads), indent=1) + "\n")
    if options.markdown is not None:
        options.markdown.write_text(to_markdown(found))
    return EXIT_OK


def _evaluate(
    dataset: str, options: argparse.Namespace, settings: Settings, dictionary: AtomDictionary, threads: int
) -> Evaluation:
    from potserver.evaluation.ablations import ABLATIONS, label_of
    from potserver.evaluation.mappers import ServiceMap
    from potserver.evaluation.peers import peer_named
    from potserver.evaluation.protocol import evaluate
    from potserver.evaluation.rings import LeftOutRings
    from potserver.mapping.service import MakePipeline, MappingService, pipeline_of
    from potserver.recordings import Reader, open_recording, scan_numbers

    reader = Reader(
        format=options.format,
        frame=options.frame,
        no_return_m=options.no_return,
        min_range_m=options.min_range,
        max_range_m=options.max_range,
    )
    recording = open_recording(dataset, reader)
    numbers = scan_numbers(options.scans, len(recording))
    mapping = settings.mapping
    rows: dict[str, MakePipeline] = {label_of(mapping): pipeline_of}
    if options.ablations:
        if mapping.profile != "default":
            raise SettingsError(
                f"--ablations take parts out of profile `default`, not of `{mapping.profile}`"
            )
        rows |= ABLATIONS
    maps: list[Mapper] = [
        ServiceMap(name, MappingService(dictionary, mapping, threads=threads, make_pipeline=make_pipeline))
        for name, make_pipeline in rows.items()
    ]
    maps += [peer_named(name, threads=threads) for name in options.peers]
    with _progress(dataset, len(numbers) + len(maps)) as on_step:
        return evaluate(
            dataset,
            recording,
            numbers,
            maps,
            hold_out=HoldOut(options.hold_out),
            left_out=None if options.rings is None else LeftOutRings(options.rings),
            thin=options.thin,
            on_step=on_step,
        )


@contextmanager
def _progress(dataset: str, steps: int) -> Iterator[Callable[[str], None]]:
    """A bar on stderr: a step a scan, and one a map that is judged."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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
    for name, heads, lines in tables_of(evaluation):
        console.print(name)
        console.print(table(heads, lines))
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


def to_markdown(evaluations: Sequence[Evaluation]) -> str:
    """The tables as in a document."""
    parts = []
    for evaluation in evaluations:
        parts.append(f"**{_title(evaluation)}**\n")
        for name, heads, lines in tables_of(evaluation):
            parts.append(f"{name}\n")
            rows = [heads, ["---"] * len(heads), *lines]
            parts.append("\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n")
    return "\n".join(parts)


def _title(evaluation: Evaluation) -> str:
    return (
        f"{evaluation.dataset}: {evaluation.n_scans} scans, {evaluation.n_beams:,} beams mapped, "
        f"{evaluation.rows[0].scores.protocol_1.held_out.n:,} held-out points, {evaluation.path_m:.0f} m of way"
    )


def _machine(threads: int) -> str:
    return (
        f"potserver {__version__}, {platform.machine()}, {os.cpu_count()} processors, {threads} threads, "
        f"Python {platform.python_version()}, load {os.getloadavg()[0]:.1f}"
    )


def _report(found: list[Evaluation], options: argparse.Namespace, threads: int) -> dict[str, Any]:
    shown = {
        key: str(value) if isinstance(value, Path) else value
        for key, value in vars(options).items()
        if key != "run"
    }
    return {
        "machine": _machine(threads),
        "options": shown,
        "evaluations": [evaluation.to_json() for evaluation in found],
    }
