"""Flags that name what a command writes: checked as they are read, before anything is asked or computed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from potclient.errors import UsageError

PICTURE_ENDINGS = (".png", ".pdf", ".svg", ".jpg")  # of what matplotlib draws


def output_file(text: str) -> Path:
    """A file that can be written; the type of a flag.

    Raises:
        UsageError: its folder is missing or not writable, or it is a folder itself.
    """
    path = Path(text)
    if path.is_dir():
        raise UsageError(f"cannot write {path}: it is a folder")
    if path.exists() and not path.is_file():  # a device or a pipe
        return path
    if not path.absolute().parent.is_dir():
        raise UsageError(f"cannot write {path}: no folder {path.absolute().parent}")
    _check_folder(path, path.absolute().parent)
    return path


def picture_file(text: str) -> Path:
    """A file for a picture; the type of a flag.

    Raises:
        UsageError: as for `output_file`, or its ending is none of `PICTURE_ENDINGS`.
    """
    if Path(text).suffix.lower() not in PICTURE_ENDINGS:
        raise UsageError(f"cannot draw {text}: a picture ends in {', '.join(PICTURE_ENDINGS)}")
    return output_file(text)


def text_file(text: str) -> str:
    """As `output_file`, and `-` is standard output."""
    return text if text == "-" else str(output_file(text))


def output_folder(text: str) -> Path:
    """A folder that is there or can be made; the type of a flag.

    Raises:
        UsageError: it is a file, or the nearest folder above it is not writable.
    """
    return _made(text, Path.is_dir, "it is no folder")


def new_folder(text: str) -> Path:
    """A folder that is empty or can be made; the type of a flag.

    Raises:
        UsageError: it holds something, or the nearest folder above it is not writable.
    """
    return _made(text, _is_empty_folder, "it exists already; name a new folder")


def file_in_new_folder(text: str) -> Path:
    """A file whose folder is made where it is missing; the type of a flag.

    Raises:
        UsageError: it is a folder, or the nearest folder above it is not writable.
    """
    return _made(text, Path.is_file, "it is a folder")


def _made(text: str, may_exist: Callable[[Path], bool], otherwise: str) -> Path:
    path = Path(text)
    if path.exists() and not may_exist(path):
        raise UsageError(f"cannot write {path}: {otherwise}")
    nearest = next(folder for folder in path.absolute().parents if folder.exists())
    if not nearest.is_dir():
        raise UsageError(f"cannot write {path}: {nearest} is no folder")
    _check_folder(path, nearest)
    return path


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _check_folder(path: Path, folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UsageError(f"cannot write {path}: no permission to write in {folder}")
