"""`potserver eval paper`: the paper's tables, each by name, into a folder; a run that was stopped goes on where it was."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potserver.commands.shared import EXIT_OK, file_errors, results_console, table
from potserver.errors import SettingsError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from potserver.evaluation.paper.table import Found, Shown, Table

WORD = "paper"  # in the place of a recording
_FLAGS = ("tables", "all_tables", "only", "out", "size", "data")
_COLUMNS = 170


def add_flags(flags: Any) -> None:
    """The flags of `potserver eval paper`."""
    flags.add_argument(
        "--table",
        action="append",
        dest="tables",
        metavar="NAME",
        help="one of the tables; repeatable; none lists them",
    )
    flags.add_argument("--all", action="store_const", const=True, dest="all_tables", help="all tables")
    flags.add_argument(
        "--only",
        metavar="TEXT",
        help="of the tables, the cells whose names hold this, e.g. 2D; the others stay as they are",
    )
    flags.add_argument(
        "--out", type=Path, metavar="DIR", help="for JSON, Markdown, plots and learned atoms [out/paper]"
    )
    size = flags.add_mutually_exclusive_group()
    size.add_argument("--size", metavar="NAME", help="quick (seconds, to try it), small or full [full]")
    size.add_argument("--quick", action="store_const", const="quick", dest="size", help="--size quick")
    flags.add_argument(
        "--data", type=Path, metavar="DIR", help="folder of the recordings; without it towns alone are run"
    )


def refuse_flags(options: argparse.Namespace) -> None:
    """Raise if a flag of the paper's tables stands without the word."""
    given = [name for name in _FLAGS if getattr(options, name) is not None]
    if given:
        raise SettingsError(
            "--table, --all, --only, --out, --size, --quick and --data belong to `potserver eval paper`"
        )


def run(options: argparse.Namespace) -> int:
    """Run tables; each is written as soon as it is known.

    Raises:
        SettingsError: no such table or size, or results in the folder are of another run.
    """
    from potserver.evaluation.paper.tables import TABLES
    from potserver.log import configure_logging

    if options.datasets != [WORD]:
        raise SettingsError(f"`{WORD}` stands alone, without recordings; --data names their folder")
    configure_logging("error", "console")
    console = results_console(_COLUMNS)
    if not options.tables and not options.all_tables:
        lines = [[name, made.title, f"{made.minutes} min"] for name, made in TABLES.items()]
        console.print(table(["table", "what it shows", "at full size, by estimate"], lines, left=(0, 1)))
        return EXIT_OK
    for name in TABLES if options.all_tables else options.tables:
        if name not in TABLES:
            raise SettingsError(f"no table {name!r}; there are {', '.join(TABLES)}")
        for shown in _one(TABLES[name], options):
            console.print(f"\n[bold]{name}: {shown.name}[/bold]")
            console.print(table(shown.heads, shown.lines, left=(0, 1)))
    return EXIT_OK


def _one(made: Table, options: argparse.Namespace) -> list[Shown]:
    from potserver.evaluation.paper.sizes import SIZES
    from potserver.evaluation.paper.sources import Sources
    from potserver.evaluation.paper.table import Lab, Results
    from potserver.numerics.threads import default_threads

    size = SIZES.get(options.size or "full")
    if size is None:
        raise SettingsError(f"no size {options.size!r}; there are {', '.join(SIZES)}")
    out, threads = options.out or Path("out/paper"), options.threads or default_threads()
    with file_errors(f"write into {out}"):
        out.mkdir(parents=True, exist_ok=True)
        results = Results(out / f"{made.name}.json", made, size)
        sources = Sources(out / f"atoms-{size.name}", options.data, size, threads)
        with _progress(made) as (on_cells, on_cell, on_step):
            cells = made.cells(Lab(size, options.data, threads, sources, on_step))
            cells = [cell for cell in cells if (options.only or "") in cell.key]
            on_cells(len(cells))
            results.run(cells, on_cell)
        shown = made.show(results.cells)
        command = f"potserver eval paper --table {made.name} --size {size.name}"
        (out / f"{made.name}.md").write_text(_markdown(made, shown, results.missing, command))
        if results.cells:
            _draw(made, results.cells).savefig(out / f"{made.name}.png", dpi=110)
    return shown


@contextmanager
def _progress(
    made: Table,
) -> Iterator[tuple[Callable[[int], None], Callable[[str], None], Callable[[], None]]]:
    """A bar on stderr: a step a cell; the scans of a cell are counted beside it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(made.name, total=None)
        cells, scans, current = -1, 0, ""

        def on_cell(key: str) -> None:
            nonlocal cells, scans, current
            cells, scans, current = cells + 1, 0, key
            bar.update(task, completed=cells, description=f"{made.name}: {key}")

        def on_step() -> None:
            nonlocal scans
            scans += 1
            bar.update(task, description=f"{made.name}: {current}, scan {scans}")

        yield lambda n: bar.update(task, total=n), on_cell, on_step


def _markdown(made: Table, shown: list[Shown], missing: dict[str, str], command: str) -> str:
    parts = [f"# {made.title}\n", f"{made.compares}\n", f"```console\n$ {command}\n```\n"]
    for one in shown:
        rows = [one.heads, ["---"] * len(one.heads), *one.lines]
        parts.append(f"{one.name}\n\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n")
    if missing:
        parts.append("Not run:\n\n" + "\n".join(f"- {key}: {why}" for key, why in missing.items()) + "\n")
    return "\n".join(parts)


def _draw(made: Table, found: Found) -> Figure:
    """AUC and NLL of every row: dots by map, or lines along the table's own number."""
    from matplotlib.figure import Figure

    rows = [(key, row) for key, made_rows in found.items() for row in made_rows]
    figure = Figure(
        figsize=(11.0, max(3.0, 0.22 * len(rows))) if made.x is None else (9.0, 3.6), layout="constrained"
    )
    axes = figure.subplots(1, 2, sharey=made.x is None)
    for axis, name in zip(axes, ("auc", "nll"), strict=True):
        if made.x is None:
            labels = [f"{key}: {row['map']}" for key, row in rows]
            axis.plot([row[name] for _, row in rows], range(len(rows)), "o", ms=4)
            axis.set_yticks(range(len(rows)), labels, fontsize=6)
        else:
            for line in dict.fromkeys(
                (key.split(",")[0] + key.split(",")[1], row["map"]) for key, row in rows
            ):
                mine = [
                    row for key, row in rows if (key.split(",")[0] + key.split(",")[1], row["map"]) == line
                ]
                axis.plot(
                    [row[made.x] for row in mine], [row[name] for row in mine], "o-", label=" ".join(line)
                )
            axis.set(xlabel=made.x, xscale="log")
            axis.legend(frameon=False, fontsize=6)
        axis.set_title(f"held-out {name.upper()}", fontsize=9)
        axis.grid(alpha=0.3)
    if made.x is None:
        axes[0].invert_yaxis()
    return figure
