"""What several commands need: the connection, arguments, tables, JSON, progress."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from potclient.arrays import Float64
from potclient.client import MapClient
from potclient.commands.output_files import output_file, text_file
from potclient.datasets import (
    FORMATS,
    FRAMES,
    LAYOUTS,
    ODOMETRIES,
    Reading,
    Recording,
    open_dataset,
    recording_of_bag,
)
from potclient.datasets.bags import is_bag
from potclient.errors import UsageError
from potclient.feed import FeedOptions
from potclient.session import add_zenoh_arguments, options_from_arguments
from potschemas import messages
from potschemas.keys import DEFAULT_ROOT

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 0, 1, 2, 130


def add_command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    *,
    timeout_s: float = 10.0,
    **texts: str,
) -> Any:
    """A command that asks a server: its parser, with the flags of the map, the time-out and the Zenoh session."""
    parser = commands.add_parser(name, formatter_class=argparse.RawDescriptionHelpFormatter, **texts)
    parser.set_defaults(command=run, map="default", root=DEFAULT_ROOT, timeout=timeout_s)
    _add_server_arguments(parser, timeout_s)
    return parser


def add_verb(
    verbs: Any, name: str, run: Callable[[argparse.Namespace], int], *, timeout_s: float = 10.0, **texts: str
) -> Any:
    """A verb of a command that `add_command` made: its parser, with the same flags, which may stand before the verb too.

    Args:
        verbs: What the command's `add_subparsers` returned.
        name: Of the verb.
        run: Takes the parsed flags, returns the exit status.
        timeout_s: The command's, for the help.
        texts: `help`, `description` and `epilog`.
    """
    parser = verbs.add_parser(
        name,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,  # the command's defaults hold
        **texts,
    )
    parser.set_defaults(command=run)
    _add_server_arguments(parser, timeout_s)
    return parser


def _add_server_arguments(parser: argparse.ArgumentParser, timeout_s: float) -> None:
    group = parser.add_argument_group("server")
    group.add_argument("--map", metavar="ID", help="id of the map (default: default)")
    group.add_argument("--root", help=f"root of all keys (default {DEFAULT_ROOT})")
    group.add_argument(
        "--timeout", type=positive, metavar="SECONDS", help=f"of one answer (default {timeout_s:g})"
    )
    add_zenoh_arguments(parser)


def add_json_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--json FILE`."""
    parser.add_argument(
        "--json",
        type=text_file,
        metavar="FILE",
        help="write everything as JSON; - is stdout, instead of text",
    )


def add_box_arguments(parser: argparse.ArgumentParser, text: str) -> None:
    """Add `--lower X Y Z` and `--upper X Y Z`."""
    parser.add_argument("--lower", type=float, nargs=3, metavar=("X", "Y", "Z"), help=text)
    parser.add_argument("--upper", type=float, nargs=3, metavar=("X", "Y", "Z"))


def add_unknown_argument(parser: argparse.ArgumentParser, default: str) -> None:
    """Add `--unknown`."""
    parser.add_argument(
        "--unknown",
        choices=[kind.value for kind in messages.Unknown],
        default=default,
        help=f"what unobserved space is taken for (default {default}; prior = what is expected there, or 0.5)",
    )


def add_evidence_only_argument(parser: argparse.ArgumentParser) -> None:
    """Add `--evidence-only`."""
    parser.add_argument(
        "--evidence-only", action="store_true", help="borrow nothing from what the dictionary expects"
    )


def add_recording_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    """Add what `open_recording` reads: the dataset, how it is read, and which of its scans."""
    parser.add_argument("dataset", metavar=name)
    group = parser.add_argument_group("recording")
    group.add_argument("--format", choices=FORMATS, default="auto", help="default: look at it")
    group.add_argument("--topic", metavar="TOPIC", help="bags: of the scans, if there are several")
    group.add_argument(
        "--tf",
        nargs="?",
        const="",
        metavar="FRAME",
        help="bags: poses in this frame from /tf and /tf_static (default: the topmost)",
    )
    group.add_argument(
        "--poses",
        metavar="FILE",
        help="pose file to use instead of the usual one: KITTI, TUM, a graph's vertices, or a bag's topic",
    )
    _add_placing(group)
    group.add_argument(
        "--frame",
        choices=FRAMES,
        default="auto",
        help="files of points: where their points are (default auto)",
    )
    group.add_argument(
        "--world-frame", action="store_const", const="world", dest="frame", help="the same as --frame world"
    )
    group.add_argument(
        "--no-return",
        type=positive,
        metavar="METRES",
        help="CARMEN: readings from here on are no echoes (default 50)",
    )
    group.add_argument(
        "--max-range",
        type=positive,
        metavar="METRES",
        help="beams beyond are free up to here and have no echo",
    )
    group.add_argument(
        "--min-range", type=float, default=0.0, metavar="METRES", help="drop points nearer than this"
    )
    group.add_argument("--skip", type=int, default=0, metavar="N", help="leave out the first N scans")
    group.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th scan")
    group.add_argument("--limit", type=int, metavar="N", help="take at most N scans")


def _add_placing(group: Any) -> None:
    group.add_argument(
        "--odometry",
        choices=ODOMETRIES,
        help="let LiDAR odometry place the scans of a folder or bag without poses; it closes no loops",
    )
    group.add_argument(
        "--trajectory",
        type=output_file,
        metavar="FILE",
        help="write what odometry found, as TUM lines (default NAME.kiss-icp.tum in this folder)",
    )
    group.add_argument(
        "--origin",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="where the sensor is in the frame of the points, m, for files in a vehicle's frame (default 0 0 0)",
    )
    group.add_argument(
        "--layout",
        choices=("auto", *LAYOUTS),
        default="auto",
        help="what a point of .bin files is (default: look at the numbers)",
    )


def _trajectory_of(arguments: argparse.Namespace) -> Path | None:
    if arguments.odometry is None:
        if arguments.trajectory is not None:
            raise UsageError("--trajectory is for --odometry")
        return None
    default = f"{Path(arguments.dataset).resolve().name}.{arguments.odometry}.tum"
    return arguments.trajectory or output_file(default)


def open_recording(arguments: argparse.Namespace) -> Recording:
    """The scans that the recording's flags choose.

    Raises:
        UsageError: the flags leave none, or are no numbers of scans.
        DatasetError: the dataset cannot be read.
    """
    if arguments.skip < 0 or arguments.every < 1 or (arguments.limit is not None and arguments.limit < 1):
        raise UsageError("--skip must be 0 or more, --every and --limit 1 or more")
    recording = _open(arguments)
    chosen = recording[arguments.skip :: arguments.every][: arguments.limit]
    if len(chosen) == 0:
        raise UsageError(
            f"{arguments.dataset}: --skip {arguments.skip} leaves none of {len(recording)} scans"
        )
    return chosen


def _open(arguments: argparse.Namespace) -> Recording:
    if arguments.topic is None and arguments.tf is None:
        return open_dataset(
            arguments.dataset,
            arguments.format,
            poses=arguments.poses,
            frame=arguments.frame,
            origin=arguments.origin,
            layout=arguments.layout,
            odometry=arguments.odometry,
            trajectory=_trajectory_of(arguments),
            no_return_m=arguments.no_return,
            min_range_m=arguments.min_range,
            max_range_m=arguments.max_range,
        )
    path = Path(arguments.dataset)
    if not is_bag(path):
        raise UsageError(
            f"{path}: --topic and --tf are for bags: a .mcap, .db3 or .bag file, or a rosbag2 folder"
        )
    for flag, other in (("--poses", arguments.poses), ("--odometry", arguments.odometry)):
        if arguments.tf is not None and other is not None:
            raise UsageError(f"--tf and {flag}: poses come from one of the two")
    how = Reading(
        poses=arguments.poses,
        odometry=arguments.odometry,
        trajectory=_trajectory_of(arguments),
        min_range_m=arguments.min_range,
        max_range_m=arguments.max_range,
    )
    return recording_of_bag(path, how, topic=arguments.topic, frame=arguments.tf or None)


@contextlib.contextmanager
def client_of(arguments: argparse.Namespace, feed: FeedOptions | None = None) -> Iterator[MapClient]:
    """The client that a command's flags describe; with `--wait`, once a server is ready."""
    with MapClient(
        map=arguments.map,
        root=arguments.root,
        timeout_s=arguments.timeout,
        feed=feed,
        options=options_from_arguments(arguments),
    ) as client:
        if arguments.wait > 0:
            client.wait_ready(arguments.wait)
        yield client


def positive(text: str) -> float:
    """A flag's value that must be a positive number."""
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def read_table(path: Path, columns: tuple[int, ...], what: str) -> Float64:
    """Rows of numbers, from an .npy or from text."""
    try:
        table = np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path, ndmin=2)
        table = np.asarray(table, np.float64)
    except (ValueError, TypeError, EOFError) as error:
        raise UsageError(f"{path}: not an array of {what} ({error})") from error
    if table.ndim != 2 or table.shape[1] not in columns or not len(table):
        need = " or ".join(f"(N, {n})" for n in reversed(columns))
        raise UsageError(f"{path}: shape {table.shape}, need {need}")
    return table


def write_json(target: str | None, tree: Any) -> None:
    """Write what `--json` asked for: to a file, to stdout (`-`), or not at all (None)."""
    if target is None:
        return
    text = json.dumps(_finite(tree), indent=1)
    if target == "-":
        say(text)
    else:
        Path(target).write_text(text + "\n")


def _finite(tree: Any) -> Any:
    """The tree with NaN and infinity as null: JSON has neither."""
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite(value) for value in tree]
    if isinstance(tree, float) and not math.isfinite(tree):
        return None
    return tree


def plain(message: msgspec.Struct) -> dict[str, Any]:
    """The message as plain types, for JSON."""
    return dict(msgspec.to_builtins(message))


def table(heads: list[str], rows: list[list[str]], *, rule: bool = True) -> str:
    """Columns as wide as their widest cell; numbers to the right."""
    lines = [heads, *rows] if rule else rows
    widths = [max((len(line[i]) for line in lines), default=0) for i in range(len(heads))]
    right = [bool(rows) and all(_is_number(row[i]) for row in rows) for i in range(len(heads))]

    def line(cells: list[str]) -> str:
        padded = (c.rjust(w) if r else c.ljust(w) for c, w, r in zip(cells, widths, right, strict=True))
        return "  ".join(padded).rstrip()

    return "\n".join(line(cells) for cells in lines)


def say_rows(heads: list[str], rows: list[list[str]], n: int, where: str) -> None:
    """Print the first rows of n, and where the others are."""
    say(table(heads, rows))
    if n > len(rows):
        say(f"... and {n - len(rows)} more ({where} has all)")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def say(text: str) -> None:
    """A line on stdout: what was asked for."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def note(text: str) -> None:
    """A line on stderr: what happens meanwhile."""
    sys.stderr.write(text + "\n")


def complain(text: str, status: int) -> int:
    """A line on stderr that says what went wrong; the exit status to end with."""
    sys.stderr.write(f"potclient: {text}\n")
    return status


def progress_bar(total: int, what: str = "scans") -> tuple[Any, Any] | None:
    """A progress bar on stderr and its task; None without the package rich."""
    try:
        from rich.console import Console
        from rich.progress import Progress
    except ImportError:
        return None
    bar = Progress(console=Console(stderr=True), transient=True)
    return bar, bar.add_task(what, total=total)


@contextlib.contextmanager
def part_bar(*, quiet: bool = False) -> Iterator[Callable[[int, int], None] | None]:
    """A progress bar of parts when stderr is a terminal."""
    progress = None if quiet or not sys.stderr.isatty() else progress_bar(0, "parts")
    if progress is None:
        yield None
        return
    bar, task = progress
    with bar:
        yield lambda done, total: bar.update(task, completed=done, total=total)
