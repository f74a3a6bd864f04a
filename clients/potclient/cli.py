"""`potclient publish | query | grid | rays | risk | export | mirror | watch | view | load | info | atoms | map | town`."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence

from potclient.commands import (
    atoms,
    export,
    grid,
    info,
    load,
    map,  # noqa: A004 - the verb
    mirror,
    publish,
    query,
    rays,
    risk,
    town,
    view,
    watch,
)
from potclient.commands.completion import add_completion_flag
from potclient.commands.parsers import CommandParser
from potclient.commands.shared import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, complain
from potclient.errors import DatasetError, MapServerError, PotclientError, UsageError
from potclient.zenoh_config import DEFAULT_ENDPOINT
from potschemas import __version__

_VERBS = (publish, query, grid, rays, risk, export, mirror, watch, view, load, info, atoms, map, town)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the result is the exit status: 0 done, 1 failed, 2 wrong usage, 130 interrupted."""
    try:
        arguments = build_parser().parse_args(argv)
        command: Callable[[argparse.Namespace], int] = arguments.command
        return command(arguments)
    except (UsageError, DatasetError) as error:
        return complain(str(error), EXIT_USAGE)
    except MapServerError as error:
        return complain(f"the server refused ({error.code}): {error}", EXIT_FAILED)
    except PotclientError as error:
        return complain(str(error), EXIT_FAILED)
    except BrokenPipeError:  # `potclient ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except OSError as error:
        named = error.filename is not None  # numpy names the file in the text alone
        return complain(f"{error.filename}: {error.strerror}" if named else str(error), EXIT_FAILED)
    except KeyboardInterrupt:
        return complain("interrupted", EXIT_INTERRUPTED)


def build_parser() -> argparse.ArgumentParser:
    """All commands and their flags."""
    parser = CommandParser(
        prog="potclient",
        description="Feed a potserver map and ask it: occupancy with uncertainty, anywhere, over Zenoh.",
        epilog=f"""examples:
  potclient info                                  what the server at {DEFAULT_ENDPOINT} is and holds
  potclient publish generated                     play a made-up scene into the map
  potclient query 1 2 0.5                         how likely is this point occupied, and how sure is the map
  potclient grid --resolution 0.2 -o map.npz      the whole map as a grid
  potclient rays 0 0 1 --max-range 20             how far one can see from there, all around
  potclient export bt -o map.bt --resolution 0.2  the map for programs that read OctoMap files
  potclient mirror                                follow the map by what changes
  potclient map save before-the-rain              a copy of the map, to go back to
  potclient load --robots 8 --planners 4          how much the server takes

`potclient COMMAND --help` explains each command.""",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"potclient {__version__}")
    add_completion_flag(parser)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for verb in _VERBS:
        verb.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
