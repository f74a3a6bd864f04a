"""`potclient info`: what the server is and holds."""

from __future__ import annotations

import argparse
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
        say(table(["", ""], [[key, _cell(value)] for key, value in _flatten(tree)], rule=False))
    return EXIT_OK


def _flatten(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _cell(value: Any) -> str:
    if isinstance(value, list):
        return " ".join(_cell(v) for v in value)
    return f"{value:.6g}" if isinstance(value, float) else "-" if value is None else str(value)
