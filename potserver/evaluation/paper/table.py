"""A table is a list of cells. A cell is run once, and what it found is written at once: a run that ended is taken up again."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from potclient.files import whole
from potschemas import __version__
from potserver.errors import SettingsError
from potserver.evaluation.paper.scenes import NoDataError
from potserver.evaluation.paper.sizes import Size
from potserver.evaluation.paper.sources import Sources
from potserver.evaluation.paper.trial import Row

_FORMAT = 1


class Lab(NamedTuple):
    """What every cell may use."""

    size: Size
    data: Path | None  # folder of recordings
    threads: int
    sources: Sources
    on_step: Callable[[], None]  # called now and then while a cell runs


class Cell(NamedTuple):
    """One thing to run."""

    key: str
    run: Callable[[], list[Row]]


class Shown(NamedTuple):
    """One table as people read it."""

    name: str
    heads: list[str]
    lines: list[list[str]]


Found = dict[str, list[Row]]  # by the cells' keys


class Table(NamedTuple):
    """One of the paper's tables, or one that its text asks for."""

    name: str  # on the command line
    title: str
    compares: str  # one line: what of it can be compared with the paper
    minutes: str  # how long it takes at full size, two cores
    cells: Callable[[Lab], list[Cell]]
    show: Callable[[Found], list[Shown]]
    x: str | None = None  # a number of each row that the plot has along x


class Results:
    """What has been found of a table: in a file, and safe after every cell.

    Args:
        path: Of the file; if it is there, what it holds is not run again.
        table: Whose.
        size: Of the run.
    Raises:
        SettingsError: the file is of another table, size, version or form, or is damaged.
    """

    def __init__(self, path: Path, table: Table, size: Size) -> None:
        self._path = path
        self._head = {"form": _FORMAT, "table": table.name, "size": size.name, "version": __version__}
        self.cells: Found = {}
        self.missing: dict[str, str] = {}  # cells that could not be run, and why
        if path.exists():
            self._load()

    def _load(self) -> None:
        try:
            kept = json.loads(self._path.read_text())
            head = {name: kept[name] for name in self._head}
            self.cells = dict(kept["cells"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SettingsError(f"{self._path}: not results of a table ({error})") from error
        if head != self._head:
            raise SettingsError(
                f"{self._path} has results of {head}, this run is {self._head}: choose another --out, or remove it"
            )

    def run(self, cells: Sequence[Cell], on_cell: Callable[[str], None] = lambda key: None) -> None:
        """Run the cells that are not known yet."""
        for cell in cells:
            on_cell(cell.key)
            if cell.key in self.cells:
                continue
            try:
                self.cells[cell.key] = cell.run()
            except NoDataError as error:
                self.missing[cell.key] = str(error)
                continue
            self._save()

    def _save(self) -> None:
        kept: dict[str, Any] = {**self._head, "cells": self.cells}
        with whole(self._path) as file:
            file.write(json.dumps(kept, indent=1).encode() + b"\n")


_SCORES = (("ACC", "acc", 3), ("AUC", "auc", 4), ("NLL", "nll", 3), ("ECE", "ece", 3))


def score_cells(row: Row) -> list[str]:
    """ACC, AUC, NLL and ECE, with their standard deviations where there are some."""
    cells = []
    for _, name, digits in _SCORES:
        spread = f" +- {row[f'{name}_sd']:.{min(digits, 3)}f}" if f"{name}_sd" in row else ""
        cells.append(f"{row[name]:.{digits}f}{spread}")
    return cells


def show_rows(found: Found, *extra: tuple[str, str, str]) -> list[Shown]:
    """One line a row: its cell, its map, and the scores.

    Args:
        found: What was found.
        extra: Head, name in the row and format of further columns.
    """
    heads = ["domain", "map", *(head for head, _, _ in _SCORES), "unknown", "kernels", "CPU ms/scan"]
    lines = []
    for key, rows in found.items():
        for row in rows:
            more = [f"{row['unknown']:.1%}", f"{row['kernels']:,.0f}", f"{row['cpu_ms']:.0f}"]
            told = [format(row[name], spec) if name in row else "-" for _, name, spec in extra]
            lines.append([key, row["map"], *score_cells(row), *more, *told])
    return [Shown("held-out beams", [*heads, *(head for head, _, _ in extra)], lines)]
