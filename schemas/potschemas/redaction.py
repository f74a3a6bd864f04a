"""Secrets in configurations: which keys hold them, and texts without them. For server and client; no part of the wire."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

HIDDEN = "***"
_NAMES = r"(?:\w*passw(?:or)?d|\w*secret|\w*access_token|\w*private_key_(?:pem|base64))"
_KEY = re.compile(rf"(?:^|[/.]){_NAMES}$", re.IGNORECASE)
# a name, then `:` or `=`, then its value, quoted or up to the next separator: JSON5, TOML, an endpoint's options
_ASSIGNED = re.compile(
    rf"""(\b{_NAMES}["']?\s*[:=]\s*)("(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'|[^\s"',;#&}}\]]+)""", re.IGNORECASE
)


def is_secret(key: str) -> bool:
    """Whether the value of a key is a secret; only what stands after its last `/` or `.` counts."""
    return _KEY.search(key) is not None


def holds_secret(text: str) -> bool:
    """Whether a text, e.g. JSON5 or an endpoint, gives a value to such a key."""
    return _ASSIGNED.search(text) is not None


def redacted(value: Any, key: str = "") -> Any:
    """The same tree of mappings, lists and plain values, with `***` in the place of secrets.

    Args:
        value: The tree; it is not changed.
        key: Under which it stands.
    """
    if isinstance(value, Mapping):
        return {name: redacted(item, str(name)) for name, item in value.items()}
    if value is None or value == "":
        return value
    if is_secret(key):
        return HIDDEN
    if isinstance(value, str):
        return _ASSIGNED.sub(rf"\g<1>{HIDDEN}", value)
    if isinstance(value, list | tuple):
        return [redacted(item, key) for item in value]
    return value
