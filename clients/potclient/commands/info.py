"""`potclient info`: what the server is and holds."""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Iterator
from typing import Any

from potclient.commands.shared import (
    EXIT_OK,
    add_command,
    add_json_argument,
    client_of,
    plain,
    say,
    table,
    write_json,
)


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "info",
        run,
        help="what the server is, holds and accepts",
        description="What the server is, what its map holds, what it accepts, and its counters with --stats.",
    )
    parser.add_argument("--stats", action="store_true", help="the server's counters too")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    with client_of(arguments) as client:
        tree = plain(client.info())
        if arguments.stats:
            tree["stats"] = plain(client.stats(tree["server"]))
    write_json(arguments.json, tree)
    if arguments.json != "-":
        say(table(["", ""], [[key, _cell(key, value)] for key, value in _flatten(tree)], rule=False))
    return EXIT_OK


def _flatten(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _cell(key: str, value: Any) -> str:
    """The value in units for people, which the end of its key tells."""
    if isinstance(value, list):
        return " ".join(_cell(key, v) for v in value)
    if key.endswith("_ns") and isinstance(value, int):
        return datetime.datetime.fromtimestamp(value // 10**9, datetime.timezone.utc).strftime(
            "%Y-%m-%dT%H:%M:%SZ"
        )
    if key.endswith("bytes") and isinstance(value, int):
        return _size(value)
    if key.endswith("uptime_s"):
        return _duration(value)
    return f"{value:.6g}" if isinstance(value, float) else "-" if value is None else str(value)


def _size(n_bytes: int) -> str:
    for unit, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if n_bytes >= size:
            return f"{n_bytes / size:.1f} {unit}"
    return f"{n_bytes} B"


def _duration(seconds: float) -> str:
    days, rest = divmod(int(seconds), 86_400)
    clock = f"{rest // 3600:02d}:{rest // 60 % 60:02d}:{rest % 60:02d}"
    return f"{days} d {clock}" if days else clock
