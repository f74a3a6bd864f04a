"""`potclient watch`: what happens to the map."""

from __future__ import annotations

import argparse
import json
import queue
import time
from typing import Any

import msgspec

from potclient.commands.shared import EXIT_OK, add_command, client_of, note, plain, positive, say
from potschemas import messages


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "watch",
        run,
        help="follow the map: revisions, receipts, server counters",
        description="Print what happens to the map as it happens, until interrupted or --seconds are over.",
        epilog="""examples:
  potclient watch
  potclient watch --seconds 30 --json        one JSON object a line""",
    )
    parser.add_argument("--seconds", type=positive, metavar="S", help="stop after S seconds (default: never)")
    parser.add_argument("--events", type=int, metavar="N", help="stop after N events")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--no-stats", action="store_true", help="leave out the server's counters")


def run(arguments: argparse.Namespace) -> int:
    events: queue.Queue[tuple[str, msgspec.Struct]] = queue.Queue()
    until = None if arguments.seconds is None else time.monotonic() + arguments.seconds
    n = 0
    with client_of(arguments) as client:
        client.watch_revisions(lambda m: events.put(("revision", m)))
        client.watch_receipts(lambda m: events.put(("receipt", m)))
        if not arguments.no_stats:
            client.watch_stats(lambda m: events.put(("stats", m)))
        servers = client.wait_ready()
        note(f"watching map {arguments.map} of server {servers}")
        while arguments.events is None or n < arguments.events:
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                break
            try:
                kind, message = events.get(timeout=left)
            except queue.Empty:
                break
            n += 1
            if arguments.json:
                say(json.dumps({"event": kind, **plain(message)}))
            else:
                say(f"{time.strftime('%H:%M:%S')}  {_event_line(kind, message)}")
    return EXIT_OK


def _event_line(kind: str, message: Any) -> str:
    if kind == "revision":
        return f"revision {message.map_revision}: {message.n_kernels} kernels, {len(message.changed_tiles)} tiles changed"
    if kind == "receipt":
        why = f" ({message.reason})" if message.reason else ""
        return f"{message.robot} #{message.seq} {message.status.value}{why}, {message.integrate_ms:.0f} ms"
    depths = ", ".join(f"{name} {value}" for name, value in sorted(message.queues.items()))
    scores = message.map_scores or {}
    kernels = ", ".join(
        f"{name} {value} kernels{_running_scores(scores.get(name))}"
        for name, value in sorted(message.map_kernels.items())
    )
    return f"{message.server} {message.state}: {kernels}; {depths}; {message.rss_bytes / 2**20:.0f} MiB"


def _running_scores(scores: messages.MapScores | None) -> str:
    """What the map says of itself, on beams that it never learned; nothing before the first of them."""
    if scores is None or not scores.n_points:
        return ""
    return f" (own NLL {scores.nll:.3f}, ECE {scores.ece:.3f})"
