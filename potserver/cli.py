"""The `potserver` command: finds the verb, runs it, and turns expected errors into one line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from potclient.commands.completion import add_completion_flag
from potclient.commands.parsers import CommandParser
from potclient.errors import PotclientError
from potschemas import __version__
from potschemas.redaction import redacted
from potserver.commands import acl, atoms, config, demo, maps, ros, serve
from potserver.commands import eval as evaluation
from potserver.commands.shared import EXIT_OK, EXIT_USAGE, Formatter, say
from potserver.errors import PotserverError

_ABOUT = "A 3D map server for robots: LiDAR clouds in, occupancy with honest uncertainty out, over Zenoh."
_FIRST_STEPS = (
    "first steps: `potserver demo`; then `potserver serve` in one shell and `potclient --help` in another."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code.

    Args:
        argv: The words after `potserver`; by default those of this process.
    """
    parser = _parser()
    try:
        options = parser.parse_args(argv)
        if "run" not in options:
            parser.print_help()
            return EXIT_USAGE
        return int(options.run(options))
    except (PotserverError, PotclientError) as error:
        say(f"potserver: {redacted(str(error))}", sys.stderr)
        return EXIT_USAGE
    except BrokenPipeError:  # `potserver config show | head`
        sys.stderr.close()
        return EXIT_OK


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        prog="potserver", description=_ABOUT, epilog=_FIRST_STEPS, formatter_class=Formatter
    )
    parser.add_argument("--version", action="version", version=f"potserver {__version__}")
    add_completion_flag(parser)
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    for verb in (serve, ros, config, atoms, maps, acl, evaluation, demo):
        verb.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
