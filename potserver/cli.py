"""The `potserver` command: flags to settings, signals to a flag, errors to one line."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import json
import os
import select
import signal
import sys
from collections.abc import Iterator, Sequence
from types import FrameType
from typing import Any, TextIO

import zenoh

from potschemas import __version__
from potserver.adapters.log import configure_logging, get_logger
from potserver.config import Settings, as_tree, load_settings, to_toml
from potserver.errors import PotserverError, SettingsError

log = get_logger("potserver.cli")

EXIT_OK, EXIT_UNCLEAN, EXIT_USAGE, EXIT_FORCED = 0, 1, 2, 130

_ABOUT = "A 3D map server for robots: LiDAR clouds in, occupancy with honest uncertainty out, over Zenoh."

_FIRST_STEPS = """\
first steps: `potserver demo`; then `potserver serve` in one shell and `potclient --help` in another."""

_SERVE = """\
Serve maps to robots and planners over Eclipse Zenoh.

The server listens on tcp/127.0.0.1:7447 only. It needs no router: robots connect to it in client mode.
It is ready when it logs server_started, and when its liveliness token is up.
Anyone who reaches the port may write: use Zenoh's access control and TLS.
SIGTERM or Ctrl-C drains it: waiting clouds are mapped, everybody gets an answer, exit code 0. A second one
ends it at once."""

_SERVE_EXAMPLES = """\
examples:
  potserver serve                                        one map, `default`, for this machine only
  potserver serve --listen tcp/0.0.0.0:7447              for the network: who reaches the port may write
  potserver serve --map ground --map first_floor         two maps, each with its own writer
  potserver serve --listen tcp/127.0.0.1:0               any free port; the log says which
  potserver serve --connect tcp/router:7447 --listen tcp/127.0.0.1:7448
                                                         join a Zenoh router (ROS 2 hosts have one on 7447)
  potserver serve --settings site.toml --set limits.max_cloud_points=100000
  POTSERVER_MAPS=ground,roof potserver serve             every setting is also a variable

settings: defaults < --settings FILE < POTSERVER_* < flags. See them all with `potserver config show`."""

_CONFIG_SHOW = """\
Print the effective settings, after file, variables and flags, as a TOML file that --settings takes.

A variable names its key with double underscores: POTSERVER_LIMITS__MAX_CLOUD_BYTES=1000000."""

_ATOMS_INFO = """\
List the atoms of a dictionary: the learned pieces of scans that are carried to each new cloud."""


_ATOMS_BUILD = """\
Learn atoms from recordings, keep those that differ most, score them on beams they never saw, and write a dictionary."""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the `potserver` command; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["demo"]:  # it has a parser of its own
        return _demo(arguments[1:])
    parser = _parser(building=arguments[:2] == ["atoms", "build"])
    options = parser.parse_args(arguments)
    if not hasattr(options, "run"):
        parser.print_help()
        return EXIT_USAGE
    try:
        return int(options.run(options))
    except PotserverError as error:
        _say(f"potserver: {error}", sys.stderr)
        return EXIT_USAGE
    except BrokenPipeError:  # `potserver config show | head`
        sys.stderr.close()
        return EXIT_OK


# --- commands -----------------------------------------------------------------------------------------------


def _serve(options: argparse.Namespace) -> int:
    settings = _settings(options)
    configure_logging(settings.log.level, settings.log.format)
    zenoh.try_init_log_from_env()  # RUST_LOG
    from potserver.server import MapServer  # after the flags are known to be good: this loads the numerics

    with _StopSignals.installed() as stop:
        server = MapServer(settings)
        try:
            server.start()
            stop.wait()
            log.info("stop_requested", signal=stop.name)
        finally:
            clean = server.stop()
    if clean:
        return EXIT_OK
    # a thread or Zenoh itself did not end in time; leaving the ordinary way might wait for it for ever
    sys.stderr.flush()
    os._exit(EXIT_UNCLEAN)


def _config_show(options: argparse.Namespace) -> int:
    settings = _settings(options)
    _say(json.dumps(as_tree(settings), indent=2) if options.json else to_toml(settings).rstrip())
    return EXIT_OK


def _atoms_info(options: argparse.Namespace) -> int:
    from potserver.domain.dictionary import AtomDictionary

    path = options.file or _settings(options).dictionary
    dictionary = AtomDictionary.builtin() if path is None else AtomDictionary.load(path)
    rows = [
        {
            "atom_id": atom.atom_id,
            "dims": atom.dims,
            "n_hits": len(atom.hit_points),
            "n_free": len(atom.free_points),
            "n_kernels": len(atom.kernels),
            "radius_m": atom.radius_m,
            "azimuth_width_rad": atom.azimuth_width_rad,
            "provenance": dict(atom.provenance),
        }
        for atom in dictionary
    ]
    if options.json:
        _say(json.dumps(rows, indent=2))
        return EXIT_OK
    columns = ("atom_id", "dims", "n_hits", "n_free", "n_kernels", "radius_m")
    table = [columns, *(tuple(_cell(row[column]) for column in columns) for row in rows)]
    widths = [max(len(line[i]) for line in table) for i in range(len(columns))]
    for line in table:
        cells = [
            line[0].ljust(widths[0]),
            *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True)),
        ]
        _say("  ".join(cells))
    _say(f"{len(rows)} atoms, {sum(len(a.kernels) for a in dictionary)} kernels, {path or 'built in'}")
    return EXIT_OK


def _atoms_build(options: argparse.Namespace) -> int:
    from potserver import atom_builder

    configure_logging("info", "auto")
    dictionary = atom_builder.run(options)
    n_kernels = sum(len(atom.kernels) for atom in dictionary)
    _say(f"{len(dictionary)} atoms, {n_kernels} kernels, written to {options.out}")
    return EXIT_OK


def _demo(arguments: list[str]) -> int:
    try:
        demo = importlib.import_module("potserver.demo")
    except ImportError as error:
        _say(f"potserver: the demo is not installed: {error}", sys.stderr)
        return EXIT_USAGE
    try:
        return int(demo.main(arguments) or EXIT_OK)
    except PotserverError as error:
        _say(f"potserver: {error}", sys.stderr)
        return EXIT_USAGE


# --- signals ------------------------------------------------------------------------------------------------


class _StopSignals:
    """SIGTERM and SIGINT: the first sets a flag, the second ends the process where it stands."""

    def __init__(self) -> None:
        self.name: str | None = None
        # a pipe and not an Event: a handler may interrupt the very thread that holds the Event's lock
        self._read_end, self._write_end = os.pipe()

    @classmethod
    @contextlib.contextmanager
    def installed(cls) -> Iterator[_StopSignals]:
        """Handle the signals inside the block."""
        stop = cls()
        before = {number: signal.signal(number, stop._note) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield stop
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            os.close(stop._read_end)
            os.close(stop._write_end)

    def wait(self) -> None:
        """Return once a signal has come."""
        while self.name is None:
            select.select([self._read_end], [], [])

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.name is not None:
            os.write(2, b"potserver: second signal, leaving at once\n")
            os._exit(EXIT_FORCED)
        self.name = signal.Signals(number).name
        os.write(self._write_end, b".")


# --- flags --------------------------------------------------------------------------------------------------


class _Formatter(argparse.RawDescriptionHelpFormatter):
    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=34, width=110)


def _parser(*, building: bool) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="potserver",
        description=_ABOUT,
        epilog=_FIRST_STEPS,
        formatter_class=_Formatter,
    )
    parser.add_argument("--version", action="version", version=f"potserver {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")

    serve = commands.add_parser(
        "serve",
        help="serve maps until a signal comes",
        description=_SERVE,
        epilog=_SERVE_EXAMPLES,
        formatter_class=_Formatter,
    )
    _add_settings_flags(serve)
    serve.set_defaults(run=_serve)

    config = commands.add_parser("config", help="see the settings", formatter_class=_Formatter)
    config_commands = config.add_subparsers(title="commands", metavar="COMMAND", required=True)
    show = config_commands.add_parser(
        "show", help="print the effective settings", description=_CONFIG_SHOW, formatter_class=_Formatter
    )
    _add_settings_flags(show)
    show.add_argument("--json", action="store_true", help="JSON in place of TOML")
    show.set_defaults(run=_config_show)

    atoms = commands.add_parser("atoms", help="see the atom dictionary", formatter_class=_Formatter)
    atoms_commands = atoms.add_subparsers(title="commands", metavar="COMMAND", required=True)
    info = atoms_commands.add_parser(
        "info", help="list the atoms", description=_ATOMS_INFO, formatter_class=_Formatter
    )
    info.add_argument("file", nargs="?", help="a dictionary file; default: the one that the settings name")
    info.add_argument("--json", action="store_true", help="everything, with provenance")
    _add_settings_flags(info)
    info.set_defaults(run=_atoms_info)

    build = atoms_commands.add_parser(
        "build",
        help="learn a dictionary from recordings",
        description=_ATOMS_BUILD,
        formatter_class=_Formatter,
    )
    if building:  # its flags come with the learner, which no other command needs
        from potserver import atom_builder

        atom_builder.add_arguments(build)
    build.set_defaults(run=_atoms_build)

    commands.add_parser(
        "demo", help="map recorded scans through a real server, and score the maps", add_help=False
    )
    return parser


def _add_settings_flags(parser: argparse.ArgumentParser) -> None:
    server = parser.add_argument_group("server")
    server.add_argument("--settings", metavar="FILE", help="TOML settings file (also POTSERVER_SETTINGS)")
    server.add_argument(
        "--map", action="append", dest="maps", metavar="ID", help="a map to serve; repeatable [default]"
    )
    server.add_argument("--server-id", metavar="ID", help="our name in stats and liveliness keys [potserver]")
    server.add_argument("--root", metavar="KEY", help="first chunks of all keys [pot/v1]")
    server.add_argument(
        "--profile", metavar="NAME", help="mapping profile: default, or paper (the authors' choices)"
    )
    server.add_argument("--dictionary", metavar="FILE", help="atom dictionary [the built-in atoms]")
    server.add_argument(
        "--threads", type=int, metavar="N", help="threads that integrate one scan [all processors]"
    )
    server.add_argument(
        "--drain-timeout", type=float, metavar="S", help="seconds for waiting clouds at SIGTERM [10]"
    )
    server.add_argument("--log-level", choices=("debug", "info", "warning", "error"), help="[info]")
    server.add_argument(
        "--log-format", choices=("auto", "json", "console"), help="auto: console on a terminal [auto]"
    )
    server.add_argument(
        "--set",
        action="append",
        dest="sets",
        default=[],
        metavar="KEY=VALUE",
        help="any setting, by its dotted name",
    )
    zenoh = parser.add_argument_group(
        "zenoh", "Zenoh's usual flags; they win over --cfg, which wins over --config."
    )
    zenoh.add_argument("-m", "--mode", choices=("peer", "client", "router"), help="[peer]")
    zenoh.add_argument(
        "-e", "--connect", action="append", metavar="ENDPOINT", help="join a router or peer; repeatable"
    )
    zenoh.add_argument(
        "-l",
        "--listen",
        action="append",
        metavar="ENDPOINT",
        help="repeatable; port 0: any [tcp/127.0.0.1:7447]",
    )
    zenoh.add_argument("-c", "--config", metavar="FILE", help="Zenoh configuration file (also ZENOH_CONFIG)")
    zenoh.add_argument(
        "--cfg", action="append", default=[], metavar="KEY:VALUE", help="one Zenoh key, as JSON5"
    )
    zenoh.add_argument(
        "--no-shm", action="store_true", help="no shared memory, e.g. in containers with a small /dev/shm"
    )


def _settings(options: argparse.Namespace) -> Settings:
    overrides: dict[str, Any] = {
        key: value
        for key, value in {
            "maps": options.maps,
            "server_id": options.server_id,
            "root": options.root,
            "mapping.profile": options.profile,
            "dictionary": options.dictionary,
            "threads": options.threads,
            "drain_timeout_s": options.drain_timeout,
            "log.level": options.log_level,
            "log.format": options.log_format,
            "zenoh.mode": options.mode,
            "zenoh.connect": options.connect,
            "zenoh.listen": options.listen,
            "zenoh.config": options.config,
        }.items()
        if value is not None
    }
    if options.no_shm:
        overrides["zenoh.shared_memory"] = False
    for assignment in options.sets:
        overrides.update([_split(assignment, "=", "--set", "KEY=VALUE")])
    settings = load_settings(file=options.settings, environ=os.environ, overrides=overrides)
    cfg = dict(_split(assignment, ":", "--cfg", "KEY:VALUE") for assignment in options.cfg)
    return dataclasses.replace(
        settings, zenoh=dataclasses.replace(settings.zenoh, cfg={**settings.zenoh.cfg, **cfg})
    )


def _split(assignment: str, separator: str, flag: str, form: str) -> tuple[str, str]:
    key, found, value = assignment.partition(separator)
    if not found or not key:
        raise SettingsError(f"{flag} {assignment!r}: need {form}")
    return key, value


def _say(text: str, stream: TextIO | None = None) -> None:
    (stream or sys.stdout).write(f"{text}\n")


def _cell(value: Any) -> str:
    return f"{value:.1f}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
