"""Feather files (Arrow tables), by pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from potclient.datasets.files.beams import Beams, beams_of_columns
from potclient.datasets.files.parsing import parsing


def read_feather(path: Path) -> Beams:
    """The points of a feather file: columns x y z, and `is_return` where there is one.

    Raises:
        DatasetError: as `read_table`, or a column is missing.
    """
    table = read_table(path)
    return beams_of_columns(path, table, tuple(table))


def read_table(path: Path) -> dict[str, Any]:
    """The columns of a feather file, each as an array.

    Raises:
        DatasetError: not such a file, or pyarrow is missing.
    """
    with parsing(path, "feather file"):
        from pyarrow import feather

        table = feather.read_table(path)
        return {name: table[name].to_numpy() for name in table.column_names}
