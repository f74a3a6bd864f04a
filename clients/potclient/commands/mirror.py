"""`potclient mirror`: a copy of the map, kept up to date."""

from __future__ import annotations

import argparse
import dataclasses
import json
import threading
import time
from collections.abc import Iterator
from typing import Any

from potclient.commands.output_files import output_file
from potclient.commands.shared import EXIT_OK, add_box_arguments, add_command, client_of, note, positive, say
from potclient.errors import LostReplyError, NoServerError, QueryTimeoutError, UsageError
from potclient.mirror import MapMirror, MirrorUpdate
from potclient.questions.tiles import MIRROR_STEP

# `mirror` asks so often even if nothing was announced: a server that was restarted announces nothing
_POLL_S = 2.0


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "mirror",
        run,
        help="keep a copy of the map, by what changes",
        description="""Fetch the map's kernels, then only the tiles that change, and print a line an update. Follows the map
until interrupted, or --seconds or --updates are over. When the server was restarted or the map cleared, all comes anew.

Weights are rounded to --step, 1/16 log-odds by default: few bytes then tell what has changed, and probabilities are within .02
of the server's. --exact takes weights as they are, at eight times the bytes.""",
        epilog="""examples:
  potclient mirror                               follow the whole map
  potclient mirror --once -o map.npz             the map as it is now; `potclient.KernelSet.load` reads it
  potclient mirror --lower -10 -10 -1 --upper 10 10 3 --json""",
    )
    add_box_arguments(parser, "corner of the box to follow, m, map frame (default: all of the map)")
    rounding = parser.add_mutually_exclusive_group()
    rounding.add_argument(
        "--step", type=positive, metavar="S", default=MIRROR_STEP, help=f"log-odds (default {MIRROR_STEP})"
    )
    rounding.add_argument("--exact", action="store_true", help="weights as they are")
    parser.add_argument("--once", action="store_true", help="fetch it once and stop")
    parser.add_argument("--seconds", type=positive, metavar="S", help="stop after S seconds (default: never)")
    parser.add_argument("--updates", type=int, metavar="N", help="stop after N updates")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument(
        "-o", "--out", type=output_file, metavar="FILE", help="at the end, save the kernels as an .npz"
    )


def run(arguments: argparse.Namespace) -> int:
    if arguments.updates is not None and arguments.updates < 1:
        raise UsageError("--updates must be 1 or more")
    n_updates = 1 if arguments.once else arguments.updates
    until = None if arguments.seconds is None else time.monotonic() + arguments.seconds
    changed = threading.Event()
    with client_of(arguments) as client:
        step = None if arguments.exact else arguments.step
        mirror = client.mirror(arguments.lower, arguments.upper, step=step)
        client.watch_revisions(lambda _: changed.set())
        try:
            for n, (update, took_s) in enumerate(_updates(mirror, changed, until), 1):
                _say_update(mirror, update, took_s, as_json=arguments.json)
                if n == n_updates:
                    break
        finally:  # when interrupted too
            if arguments.out is not None and mirror.revision is not None:
                mirror.kernels.save(arguments.out)
                note(f"wrote {arguments.out}: {len(mirror.kernels)} kernels, revision {mirror.revision}")
    return EXIT_OK


def _updates(
    mirror: MapMirror, changed: threading.Event, until: float | None
) -> Iterator[tuple[MirrorUpdate, float]]:
    """The first update, then each that brings something, and the seconds it took; until the monotonic clock says `until`."""
    is_first = True
    while True:
        changed.clear()  # before the question: what changes after it is seen in the next
        started = time.monotonic()
        try:
            update = mirror.update()
        except (NoServerError, LostReplyError, QueryTimeoutError) as error:
            if is_first:
                raise
            note(f"{error}; trying again")
        else:
            if is_first or not update.is_empty:
                yield update, time.monotonic() - started
            is_first = False
        left = _POLL_S if until is None else min(_POLL_S, until - time.monotonic())
        if left <= 0:
            return
        changed.wait(left)


def _say_update(mirror: MapMirror, update: MirrorUpdate, took_s: float, *, as_json: bool) -> None:
    held_tiles, held_kernels = mirror.n_tiles, len(mirror.kernels)
    if as_json:
        took = {"held_tiles": held_tiles, "held_kernels": held_kernels, "ms": round(took_s * 1e3, 1)}
        say(json.dumps(dataclasses.asdict(update) | took))
        return
    anew = ", all anew" if update.is_whole else ""
    say(
        f"{time.strftime('%H:%M:%S')}  revision {update.revision}{anew}: {update.n_tiles} tiles and {update.n_kernels} kernels"
        f" came in {update.n_bytes} bytes, {update.n_removed} tiles gone, {took_s * 1e3:.0f} ms; {held_kernels} kernels in"
        f" {held_tiles} tiles"
    )
