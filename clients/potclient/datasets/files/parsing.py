"""What may go wrong with a file, said in one way whichever library reads it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from potclient.errors import DatasetError
from potclient.extras import how_to_install


@contextlib.contextmanager
def parsing(path: Path, kind: str) -> Iterator[None]:
    """Turns what a parser raises into a DatasetError with the file's name, on one line.

    Args:
        path: The file.
        kind: What it should be, for people, e.g. "PCD file".
    Raises:
        DatasetError: the library is not installed, the file cannot be read, or it is no such file.
    """
    try:
        yield
    except DatasetError:
        raise
    except ImportError as error:
        package = error.name or str(error)
        raise DatasetError(
            f"{path}: reading a {kind} needs the package {package}: {how_to_install('files')}"
        ) from error
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or _short(error)})") from error
    except (
        Exception
    ) as error:  # libraries raise whatever their parsers raise: struct.error, KeyError, their own
        raise DatasetError(f"{path}: not a readable {kind} ({_short(error)})") from error


def _short(error: Exception) -> str:
    """The first line of what a parser complained of."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
