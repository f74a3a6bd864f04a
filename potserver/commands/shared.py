"""What the verbs share: exit codes, parsers, settings flags, output and tables.

The modules of the verbs import the numerics inside the functions that run: the help of every verb is printed without them.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from potschemas.redaction import holds_secret, is_secret
from potserver.errors import SettingsError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from potserver.config import Settings
    from potserver.domain.dictionary import AtomDictionary

EXIT_OK, EXIT_UNCLEAN, EXIT_USAGE, EXIT_FORCED = 0, 1, 2, 130

_SETTING_OF_FLAG = {
    "maps": "maps",
    "server_id": "server_id",
    "root": "root",
    "profile": "mapping.profile",
    "dictionary": "dictionary",
    "store": "store.directory",
    "web": "web.listen",
    "read_only": "store.read_only",
    "threads": "threads",
    "drain_timeout": "drain_timeout_s",
    "log_level": "log.level",
    "log_format": "log.format",
    "mode": "zenoh.mode",
    "connect": "zenoh.connect",
    "listen": "zenoh.listen",
    "config": "zenoh.config",
    "shared_memory": "zenoh.shared_memory",
    "ros": "ros.clouds",
}


# --- parsers ------------------------------------------------------------------------------------------------


class Formatter(argparse.RawDescriptionHelpFormatter):
    """Help as it is written, 110 columns wide."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=110)


def add_verb(
    commands: Any, name: str, run: Callable[[argparse.Namespace], int], **texts: str
) -> argparse.ArgumentParser:
    """Add the parser of one verb.

    Args:
        commands: What `add_subparsers` returned.
        name: Of the verb.
        run: Takes the parsed flags, returns the exit code.
        texts: `help`, `description` and `epilog`.
    """
    parser: argparse.ArgumentParser = commands.add_parser(name, formatter_class=Formatter, **texts)
    parser.set_defaults(run=run)
    return parser


def add_group(commands: Any, name: str, what: str) -> Any:
    """Add a verb that has verbs of its own, with a line of help; returns where they are added."""
    parser = commands.add_parser(name, help=what, formatter_class=Formatter)
    return parser.add_subparsers(title="commands", metavar="COMMAND", required=True)


def positive_int(text: str) -> int:
    """The type of flags that count."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}: need at least 1")
    return value


# --- settings -----------------------------------------------------------------------------------------------


def add_mapping_flags(flags: Any) -> None:
    """The settings flags of verbs that make maps in this process; `settings_of` reads them."""
    flags.add_argument("--settings", metavar="FILE", help="TOML settings file (also POTSERVER_SETTINGS)")
    flags.add_argument(
        "--profile", metavar="NAME", help="mapping profile: default, or paper (the authors' choices)"
    )
    flags.add_argument("--dictionary", metavar="FILE", help="atom dictionary [the built-in atoms]")
    flags.add_argument(
        "--threads", type=int, metavar="N", help="threads that integrate one scan [all processors]"
    )
    flags.add_argument(
        "--set", action="append", dest="sets", default=[], metavar="KEY=VALUE", help="any setting, by its dotted name"
    )  # fmt: skip


def add_settings_flags(parser: argparse.ArgumentParser) -> None:
    """All settings flags; `settings_of` reads them."""
    server = parser.add_argument_group("server")
    server.add_argument(
        "--map", action="append", dest="maps", metavar="ID", help="a map to serve; repeatable [default]"
    )
    add_mapping_flags(server)
    server.add_argument("--server-id", metavar="ID", help="our name in stats and liveliness keys [potserver]")
    server.add_argument("--root", metavar="KEY", help="first chunks of all keys [pot/v1]")
    store = server.add_mutually_exclusive_group()
    store.add_argument(
        "--store",
        metavar="DIR",
        help="where the maps survive restarts [$XDG_STATE_HOME/potserver/SERVER_ID, else under ~/.local/state]",
    )
    store.add_argument(
        "--in-memory", action="store_const", dest="store", const="", help="forget the maps at the end"
    )
    server.add_argument(
        "--web",
        metavar="HOST:PORT",
        help="serve a page with the map there, /live, /ready and /metrics (Prometheus)",
    )
    server.add_argument(
        "--read-only", action="store_const", const=True,
        help="answer from the kept maps and write nothing: no clouds, no changes; for disks that cannot be written",
    )  # fmt: skip
    server.add_argument(
        "--drain-timeout", type=float, metavar="S", help="seconds for waiting clouds at SIGTERM [10]"
    )
    server.add_argument("--log-level", choices=("debug", "info", "warning", "error"), help="[info]")
    server.add_argument(
        "--log-format", choices=("auto", "json", "console"), help="auto: console on a terminal [auto]"
    )
    _add_zenoh_flags(parser)


def _add_zenoh_flags(parser: argparse.ArgumentParser) -> None:
    zenoh = parser.add_argument_group(
        "zenoh", "Zenoh's usual flags; they win over --cfg, which wins over --config."
    )
    zenoh.add_argument("-m", "--mode", choices=("peer", "client", "router"), help="[peer]")
    zenoh.add_argument(
        "-e", "--connect", action="append", metavar="ENDPOINT", help="join a router or peer; repeatable"
    )
    zenoh.add_argument(
        "-l", "--listen", action="append", metavar="ENDPOINT", help="repeatable; port 0: any [tcp/127.0.0.1:7447]"
    )  # fmt: skip
    zenoh.add_argument("-c", "--config", metavar="FILE", help="Zenoh configuration file (also ZENOH_CONFIG)")
    zenoh.add_argument(
        "--cfg", action="append", default=[], metavar="KEY:VALUE", help="one Zenoh key, as JSON5"
    )
    zenoh.add_argument(
        "--shm", action=argparse.BooleanOptionalAction, dest="shared_memory",
        help="clouds through shared memory: 4 to 8 times as fast, but every session leaves 18 MB [off]",
    )  # fmt: skip


def settings_of(options: argparse.Namespace) -> Settings:
    """The settings: defaults, the file, the variables, and the flags that the verb has.

    Raises:
        SettingsError: an unknown key, or an illegal value.
    """
    from potserver.config import load_settings

    flags = vars(options)
    _refuse_secrets(flags)
    overrides: dict[str, Any] = {
        key: flags[flag] for flag, key in _SETTING_OF_FLAG.items() if flags.get(flag) is not None
    }
    overrides.update(_split(assignment, "=", "--set", "KEY=VALUE") for assignment in options.sets)
    settings = load_settings(file=options.settings, environ=os.environ, overrides=overrides)
    cfg = dict(_split(assignment, ":", "--cfg", "KEY:VALUE") for assignment in flags.get("cfg", ()))
    store = settings.store
    if store.directory is None:  # nobody said anything: a server of its own keeps its maps
        store = dataclasses.replace(store, directory=str(_state_folder() / settings.server_id))
    return dataclasses.replace(
        settings, store=store, zenoh=dataclasses.replace(settings.zenoh, cfg={**settings.zenoh.cfg, **cfg})
    )


def _refuse_secrets(flags: Mapping[str, Any]) -> None:
    """Keep secrets out of the command line, which every user of the machine can read."""
    for flag in ("cfg", "sets", "connect", "listen"):
        for text in flags.get(flag) or ():
            key, _, value = text.partition("=" if flag == "sets" else ":")
            if holds_secret(text) or (value and is_secret(key)):
                raise SettingsError(
                    f"--{'set' if flag == 'sets' else flag} {key}: a secret in the command line can be read by every user of"
                    " this machine. Write it into a Zenoh configuration file that only you may read (chmod 600) and name that"
                    " with --config, or set the variable POTSERVER_ZENOH__CFG"
                )


def dictionary_of(path: str | Path | None) -> AtomDictionary:
    """The dictionary in a file, or the built-in atoms.

    Raises:
        DictionaryError: the file is missing or damaged.
    """
    from potserver.domain.dictionary import AtomDictionary

    return AtomDictionary.load(path) if path else AtomDictionary.builtin()


def _state_folder() -> Path:
    """Where programs of this user keep their state, by the XDG base directory rules: a relative path does not count."""
    named = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (named if named.is_absolute() else Path.home() / ".local" / "state") / "potserver"


def _split(assignment: str, separator: str, flag: str, form: str) -> tuple[str, str]:
    key, found, value = assignment.partition(separator)
    if not found or not key:
        raise SettingsError(f"{flag} {assignment!r}: need {form}")
    return key, value


# --- files and output ---------------------------------------------------------------------------------------


@contextlib.contextmanager
def file_errors(doing: str) -> Iterator[None]:
    """An OSError inside the block becomes a SettingsError: "cannot <doing>: <why>"."""
    try:
        yield
    except OSError as error:
        raise SettingsError(f"cannot {doing}: {error.strerror or error}") from error


def say(text: str, stream: TextIO | None = None) -> None:
    """Print a line; by default on standard output."""
    (stream or sys.stdout).write(f"{text}\n")


def results_console(width: int = 120) -> Console:
    """Where results are printed: as wide as the terminal, or `width` columns in a pipe."""
    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else width)


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], *, left: Collection[int] = (0,)) -> Table:
    """A table in the form that all results have.

    Args:
        heads: Of the columns.
        rows: Cells, as many as heads.
        left: Columns of text; the others hold numbers and stand at the right.
    """
    from rich.markup import escape
    from rich.table import Table

    made = Table(box=None, header_style="dim", pad_edge=False)
    for column, head in enumerate(heads):
        made.add_column(
            escape(head), justify="left" if column in left else "right", no_wrap=column == 0 and 0 in left
        )
    for row in rows:
        made.add_row(*map(escape, row))
    return made
