"""TOML: files of settings and recipes, and single values from variables and flags."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from potserver.errors import SettingsError

_tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The tree in a file.

    Args:
        path: The file.
        what: What it is, for messages.
    Raises:
        SettingsError: it cannot be read, or is not TOML.
    """
    try:
        tree: dict[str, Any] = _tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"cannot read {what} {path}: {error.strerror}") from error
    except (_tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{what} {path} is not TOML: {error}") from error
    return tree


def toml_value(text: str) -> Any:
    """A single value.

    Raises:
        ValueError: it is none.
    """
    return _tomllib.loads(f"value = {text}")["value"]
