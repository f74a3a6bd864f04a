"""`--print-completion SHELL`: what a shell needs to complete our commands, by shtab."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from typing import Any

from potclient.errors import UsageError
from potclient.extras import how_to_install

SHELLS = ("bash", "zsh", "tcsh")
_FILES = ("FILE", "FILE|DIR", "DATASET")
_FOLDERS = ("DIR", "FOLDER")


class PrintCompletion(argparse.Action):
    """Print the script and end.

    Raises:
        UsageError: shtab is missing.
    """

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        try:
            import shtab
        except ImportError as error:
            raise UsageError(f"completion needs the package shtab: {how_to_install('completion')}") from error
        for action in _actions(parser):
            if action.choices is None and action.metavar in (*_FILES, *_FOLDERS):
                completes: Any = shtab.FILE if action.metavar in _FILES else shtab.DIRECTORY
                action.complete = completes  # type: ignore[attr-defined]
        sys.stdout.write(shtab.complete(parser, values) + "\n")
        parser.exit()


def add_completion_flag(parser: argparse.ArgumentParser) -> None:
    """Add `--print-completion SHELL`."""
    parser.add_argument(
        "--print-completion",
        action=PrintCompletion,
        choices=SHELLS,
        metavar="SHELL",
        help=f"print what makes a shell ({', '.join(SHELLS)}) complete this command, and end",
    )


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """All flags and arguments, those of sub-commands too."""
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for of_command in action.choices.values():
                yield from _actions(of_command)
