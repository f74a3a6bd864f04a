"""Files that get their names only when they are complete."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import ArrayLike


@contextlib.contextmanager
def whole(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """A file to write; after an error there is none, and what was there before stays."""
    target = Path(path)
    partial = target.with_name(target.name + ".partial")
    try:
        with partial.open("wb") as file:
            yield file
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


def save_npz(path: str | os.PathLike[str], **arrays: ArrayLike) -> None:
    """Write an .npz (no pickle), whole or not at all; the name is taken as given."""
    with whole(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
