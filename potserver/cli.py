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
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, TextIO

import zenoh

from potclient.commands import export_flags, pose_flag
from potclient.datasets import FORMATS, FRAMES
from potschemas import __version__
from potserver import bundled
from potserver.adapters.log import configure_logging, get_logger
from potserver.config import Settings, as_tree, load_settings, to_toml
from potserver.errors import PotserverError, SettingsError

if TYPE_CHECKING:
    from potserver.domain.dictionary import AtomDictionary

log = get_logger("potserver.cli")

EXIT_OK, EXIT_UNCLEAN, EXIT_USAGE, EXIT_FORCED = 0, 1, 2, 130

_ABOUT = "A 3D map server for robots: LiDAR clouds in, occupancy with honest uncertainty out, over Zenoh."

_FIRST_STEPS = """\
first steps: `potserver demo`; then `potserver serve` in one shell and `potclient --help` in another."""

_SERVE = """\
Serve maps to robots and planners over Eclipse Zenoh.

The server listens on tcp/127.0.0.1:7447 only. It needs no router: robots connect to it in client mode.
It is ready when it logs server_started, and when its liveliness token is up.
Its maps survive restarts and crashes: every accepted cloud is on the disk before its receipt. server_started says
where they are kept (--store) and how many clouds each holds; one server a store.
Anyone who reaches the port may write: use Zenoh's access control and TLS.
SIGTERM or Ctrl-C drains it: waiting clouds are mapped, everybody gets an answer, exit code 0. A second one
ends it at once."""

_SERVE_EXAMPLES = """\
examples:
  potserver serve                                        one map, `default`, for this machine only
  potserver serve --listen tcp/0.0.0.0:7447              for the network: who reaches the port may write
  potserver serve --map ground --map first_floor         two maps, each with its own writer
  potserver serve --listen tcp/127.0.0.1:0               any free port; the log says which
  potserver serve --store /var/lib/site/maps             keep the maps there; --in-memory: forget them at the end
  potserver serve --connect tcp/router:7447 --listen tcp/127.0.0.1:7448
                                                         join a Zenoh router (ROS 2 hosts have one on 7447)
  potserver serve --settings site.toml --set limits.max_cloud_points=100000
  POTSERVER_MAPS=ground,roof potserver serve             every setting is also a variable

settings: defaults < --settings FILE < POTSERVER_* < flags. See them all with `potserver config show`."""

_CONFIG_SHOW = """\
Print the effective settings, after file, variables and flags, as a TOML file that --settings takes.

A variable names its key with double underscores: POTSERVER_LIMITS__MAX_CLOUD_BYTES=1000000."""

_ATOMS_INFO = """\
List the atoms of a dictionary: the learned pieces of scans that are carried to each new cloud.

The scores are those of beams that were held out while learning, where the builder noted them. --picture
draws each atom's points, its kernels, and what they predict, with the uncertainty."""

_ATOMS_EXPORT = """\
Take atoms out of a dictionary, one *.atom file each: the form in which `potclient atoms add` sends them to
a server."""

_ATOMS_IMPORT = """\
Put *.atom files into a dictionary file. Each is judged as a server would judge it; if one is refused,
nothing changes."""


_ATOMS_BUILD = """\
Learn a dictionary: atoms of all sectors of the recordings' scans, scored on beams that they never saw; of the good
ones so many are kept that each of the others has a kept atom within the tolerance.

The same recipe gives the same file, however many workers there are, on one machine with the same versions."""

_ATOMS_BUILD_EXAMPLES = """\
examples:
  potserver atoms build /data/kitti/00 --scans 0:1000:10 --licence "CC BY-NC-SA 3.0" -o kitti.atoms
  potserver atoms build town:terraces:1 town:suburb:2 --learner n_sectors=8 -o towns.atoms
  potserver atoms build --recipe site.toml -o site.atoms      a recipe: see docs/dictionary.md
  potserver atoms build --recipe site.toml -o site.atoms --ray auto
                                                              on a Ray cluster, with recordings at the same paths"""

_EVAL = """\
Measure maps on beams that they never saw: a fifth of each scan's beams is kept back, all scans go through the map scan
by scan, and then it is asked about those beams' ends (occupied) and one point before each (free).

Towns are asked about their exact truth too. Times are of maps that take turns, scan by scan, in this process.
--peers needs `pip install 'potserver[peers]'` for OctoMap."""

_EVAL_EXAMPLES = """\
examples:
  potserver eval /data/kitti/00 --scans 20 --max-range 25
  potserver eval /data/kitti/00 --scans 20 --max-range 25 --peers octomap:0.1,octomap:0.2,bgk:0.2,grid
  potserver eval town:terraces:dynamic:7 --scans 25 --max-range 25 --ablations --json out/town.json
  potserver eval town:suburb:7 --profile paper --set mapping.n_sectors=8
  potserver eval bundled:rooms --peers grid"""


_MAP_INFO = """\
What is in a saved map (*.map), in one map's folder, or in a whole store: read, checked and counted."""

_MAP_EXPORT = """\
Write a saved map as a file that other programs read, as `potclient export` does for a served one.

  ply, npz   kernels
  pgm        a picture of the plane and its YAML, for Nav2's map_server
  bt         a binary OctoMap"""

_MAP_EXPORT_EXAMPLES = """\
examples:
  potserver map export site.map -f ply -o kernels.ply
  potserver map export site.map -f pgm --resolution 0.05 --band 0.1 1.5 -o map.pgm"""

_MAP_IMPORT = """\
Make a *.map file. In the folder `saved` of a server's store, `potclient map load NAME` finds it.

  *.bt        a binary OctoMap: its voxels become evidence of a robot named after the file, and kernels are solved
              on it
  *.npz       kernels, as `potclient export npz` writes them. There is no evidence with them, so only servers of profile
              `paper` load them; they answer by their own mapping.mean_moderation and mapping.residual_var
  DIR, *.map  the last snapshot of a map's folder, or a saved map, written anew"""

_MAP_IMPORT_EXAMPLES = """\
examples:
  potserver map import hall.bt -o ~/.local/state/potserver/potserver/saved/hall.map
  potclient map load hall"""

_MAP_MERGE = """Write one map that knows what two saved ones know, as if one server had been fed by both. Scans that both of
them hold would count twice. A running server takes in a saved map with `potclient map merge`.
"""
_MAP_MERGE_EXAMPLES = """examples:
  potserver map merge south.map north.map -o campus.map
  potserver map merge south.map north.map --pose 120 -35 0 40 -o campus.map   north's origin lies there, turned by 40 degrees
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the `potserver` command; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["demo"]:  # it has a parser of its own
        return _demo(arguments[1:])
    parser = _parser()
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
    drawn = _draw_atoms(dictionary, options, title=str(path or "built-in atoms")) if options.picture else ""
    heads = ("atom", "dims", "hits", "free", "kernels", "AUC", "NLL", "ECE", *_TEXTS)
    table = [heads, *(_atom_cells(row) for row in rows)]
    widths = [max(len(line[i]) for line in table) for i in range(len(heads))]
    for line in table:
        numbers = (cell.rjust(w) for cell, w in zip(line[1:-5], widths[1:-5], strict=True))
        texts = (cell.ljust(w) for cell, w in zip(line[-5:], widths[-5:], strict=True))
        _say("  ".join([line[0].ljust(widths[0]), *numbers, *texts]).rstrip())
    _say(f"{len(rows)} atoms, {sum(len(a.kernels) for a in dictionary)} kernels, {path or 'built in'}")
    if drawn:
        _say(drawn)
    return EXIT_OK


_TEXTS = ("source", "scan", "sector", "learner", "licence")


def _atom_cells(row: dict[str, Any]) -> tuple[str, ...]:
    noted: dict[str, str] = row["provenance"]
    counts = [str(row[name]) for name in ("dims", "n_hits", "n_free", "n_kernels")]
    scores = [noted.get(f"held_out_{name}", "-") for name in ("auc", "nll", "ece")]
    texts = [noted.get(name, "-") for name in _TEXTS]
    return (
        row["atom_id"],
        *counts,
        *scores,
        *(text if len(text) <= 24 else f"{text[:23]}…" for text in texts),
    )


def _draw_atoms(dictionary: AtomDictionary, options: argparse.Namespace, *, title: str) -> str:
    """Draw the picture; what to say of it."""
    from potserver.commands.atom_sheet import choose, draw_sheet  # matplotlib takes a second to load

    atoms = choose(dictionary, options.atom, options.limit)
    try:
        draw_sheet(atoms, options.picture, title=f"{title}: {len(atoms)} of {len(dictionary)} atoms")
    except OSError as error:
        raise SettingsError(f"cannot write {options.picture}: {error.strerror or error}") from error
    hint = "" if options.atom or len(atoms) == len(dictionary) else " (--atom ID or --limit N choose others)"
    return f"{len(atoms)} atoms drawn to {options.picture}{hint}"


def _atoms_export(options: argparse.Namespace) -> int:
    from potserver.adapters import codec
    from potserver.domain.dictionary import AtomDictionary
    from potserver.domain.types import AnswerRule

    settings = _settings(options)
    dictionary = AtomDictionary.load(settings.dictionary) if settings.dictionary else AtomDictionary.builtin()
    atoms = [dictionary.get(atom_id) for atom_id in options.atom_id] or list(dictionary)
    m = settings.mapping
    rule = AnswerRule(m.observed_activation, m.prior_var, m.residual_var, m.mean_moderation)
    folder = Path(options.out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for atom in atoms:
            (folder / f"{atom.atom_id}.atom").write_bytes(codec.encode_atom(atom, {}, rule).payload)
    except OSError as error:
        raise SettingsError(f"cannot write to {folder}: {error.strerror or error}") from error
    _say(f"{len(atoms)} atoms written to {folder}")
    return EXIT_OK


def _atoms_import(options: argparse.Namespace) -> int:
    from potserver.adapters import codec
    from potserver.atoms.admission import admit
    from potserver.domain.dictionary import AtomDictionary

    settings = _settings(options)
    out = Path(options.out)
    dictionary = AtomDictionary.load(out) if out.exists() else AtomDictionary()
    for name in options.file:
        try:
            atom = codec.read_atom_file(Path(name).read_bytes())
            admit(atom, dictionary, settings.atoms.admission)
        except OSError as error:
            raise SettingsError(f"cannot read {name}: {error.strerror or error}") from error
        except PotserverError as error:
            raise SettingsError(f"{name}: {error}") from error
        dictionary = dictionary.add(atom)
    dictionary.save(out)
    _say(f"{len(options.file)} atoms added, {len(dictionary)} in {out}")
    return EXIT_OK


def _atoms_build(options: argparse.Namespace) -> int:
    from potserver.commands import atoms_build  # this loads the numerics

    configure_logging("warning", "console")
    try:
        dictionary = atoms_build.run(options)
    except KeyboardInterrupt:
        _say("potserver: interrupted, nothing was written", sys.stderr)
        return EXIT_FORCED
    n_kernels = sum(len(atom.kernels) for atom in dictionary)
    _say(f"{len(dictionary)} atoms, {n_kernels} kernels, written to {options.out}")
    return EXIT_OK


def _map(options: argparse.Namespace) -> int:
    from potserver.commands import maps  # this loads the numerics

    settings = _settings(options) if options.settings_flags else Settings()
    return maps.run(options, settings, _say)


def _eval(options: argparse.Namespace) -> int:
    overrides: dict[str, Any] = {
        key: value
        for key, value in {
            "mapping.profile": options.profile,
            "dictionary": options.dictionary,
            "threads": options.threads,
        }.items()
        if value is not None
    }
    overrides.update(_split(assignment, "=", "--set", "KEY=VALUE") for assignment in options.sets)
    settings = load_settings(file=options.settings, environ=os.environ, overrides=overrides)
    from potserver.commands import eval as evaluation  # this loads the numerics

    configure_logging("warning", "console")
    evaluation.run(options, settings)
    return EXIT_OK


def _demo(arguments: list[str]) -> int:
    try:
        demo = importlib.import_module("potserver.commands.demo")
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


def _parser() -> argparse.ArgumentParser:
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
    info.add_argument("--picture", metavar="PNG", help="draw atoms to this file")
    info.add_argument("--atom", action="append", default=[], metavar="ID", help="draw this one; repeatable")
    info.add_argument(
        "--limit", type=int, default=8, metavar="N", help="draw N at most, spread over the dictionary [8]"
    )
    _add_settings_flags(info)
    info.set_defaults(run=_atoms_info)

    export = atoms_commands.add_parser(
        "export", help="write atoms as single files", description=_ATOMS_EXPORT, formatter_class=_Formatter
    )
    export.add_argument("atom_id", nargs="*", metavar="ID", help="which ones [all]")
    export.add_argument("-o", "--out", required=True, metavar="FOLDER", help="where the *.atom files go")
    _add_settings_flags(export)
    export.set_defaults(run=_atoms_export)

    import_ = atoms_commands.add_parser(
        "import",
        help="put single files into a dictionary",
        description=_ATOMS_IMPORT,
        formatter_class=_Formatter,
    )
    import_.add_argument("file", nargs="+", metavar="FILE", help="*.atom files")
    import_.add_argument(
        "-o", "--out", required=True, metavar="FILE", help="the dictionary; made if there is none"
    )
    _add_settings_flags(import_)
    import_.set_defaults(run=_atoms_import)

    build = atoms_commands.add_parser(
        "build",
        help="learn a dictionary from recordings",
        description=_ATOMS_BUILD,
        epilog=_ATOMS_BUILD_EXAMPLES,
        formatter_class=_Formatter,
    )
    _add_build_flags(build)
    build.set_defaults(run=_atoms_build)

    maps = commands.add_parser("map", help="see, export and import kept maps", formatter_class=_Formatter)
    _add_map_commands(maps.add_subparsers(title="commands", metavar="COMMAND", required=True))
    maps.set_defaults(run=_map)

    evaluate = commands.add_parser(
        "eval",
        help="measure maps on held-out beams, beside other kinds of maps",
        description=_EVAL,
        epilog=_EVAL_EXAMPLES,
        formatter_class=_Formatter,
    )
    _add_eval_flags(evaluate)
    evaluate.set_defaults(run=_eval)

    commands.add_parser(
        "demo", help="map recorded scans through a real server, and score the maps", add_help=False
    )
    return parser


def _add_map_commands(commands: Any) -> None:
    info = commands.add_parser(
        "info", help="what saved maps or a store hold", description=_MAP_INFO, formatter_class=_Formatter
    )
    info.add_argument("path", type=Path, metavar="FILE|DIR")
    info.add_argument("--json", action="store_true", help="JSON in place of a table")
    info.set_defaults(map_command="info", settings_flags=False)

    export = commands.add_parser(
        "export",
        help="a saved map as a file of another program",
        description=_MAP_EXPORT,
        epilog=_MAP_EXPORT_EXAMPLES,
        formatter_class=_Formatter,
    )
    export.add_argument("path", type=Path, metavar="FILE", help="a *.map file, or a map's folder in a store")
    export.add_argument("-f", "--format", dest="kind", choices=export_flags.EXPORT_KINDS, required=True)
    export_flags.add_export_flags(export)
    export.set_defaults(map_command="export", settings_flags=False)

    import_ = commands.add_parser(
        "import",
        help="a saved map of what another program, or an old store, knows",
        description=_MAP_IMPORT,
        epilog=_MAP_IMPORT_EXAMPLES,
        formatter_class=_Formatter,
    )
    import_.add_argument("path", type=Path, metavar="FILE|DIR")
    import_.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FILE", help="the *.map file to write"
    )
    import_.add_argument(
        "--looks",
        type=float,
        default=1.0,
        metavar="X",
        help="bt: how much its voxels count, in what an OctoMap can count at most [1]",
    )
    _add_settings_flags(import_)
    import_.set_defaults(map_command="import", settings_flags=True)

    merge = commands.add_parser(
        "merge",
        help="one saved map of two",
        description=_MAP_MERGE,
        epilog=_MAP_MERGE_EXAMPLES,
        formatter_class=_Formatter,
    )
    merge.add_argument("path", type=Path, metavar="FILE", help="a *.map file, or a map's folder in a store")
    merge.add_argument("other", type=Path, metavar="OTHER", help="the one that is taken in")
    merge.add_argument(
        "-o", "--out", type=Path, required=True, metavar="FILE", help="the *.map file to write"
    )
    pose_flag.add_pose_flag(merge)
    _add_settings_flags(merge)
    merge.set_defaults(map_command="merge", settings_flags=True)


def _add_build_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("datasets", nargs="*", metavar="DATASET", help="recordings to learn from")
    parser.add_argument("-o", "--out", required=True, metavar="FILE", help="dictionary file to write")
    parser.add_argument("--recipe", metavar="FILE", help="TOML file that says what to learn from, and how")
    parser.add_argument(
        "--builtin", action="store_true", help="the recipe of the dictionary that the package ships"
    )
    parser.add_argument("--strict", action="store_true", help="end at the first scan that fails")
    running = parser.add_argument_group("where it runs")
    running.add_argument(
        "--watch",
        action="store_true",
        help="in this process, with each sector's held-out scores as it learns",
    )
    running.add_argument("--workers", type=int, metavar="N", help="scans learned at once [all processors]")
    running.add_argument(
        "--ray", metavar="ADDRESS", help="on a Ray cluster; `local` starts one here (needs potserver[ray])"
    )
    without = parser.add_argument_group("without a recipe")
    without.add_argument(
        "--scans", metavar="N", help="the first N of each recording, or START:STOP:STEP [all]"
    )
    without.add_argument(
        "--tolerance", type=float, metavar="M", help="of the cover, m [0.15 of the atoms' radius]"
    )
    without.add_argument(
        "--max-atoms", type=int, metavar="N", help="kept in each number of dimensions [no limit]"
    )
    without.add_argument(
        "--licence", metavar="TEXT", help="of the recordings, kept with the atoms [not stated]"
    )
    without.add_argument(
        "--learner",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting of the learner; repeatable",
    )


def _add_eval_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "datasets",
        nargs="+",
        metavar="DATASET",
        help=f"recordings, as `potclient publish` takes them, or bundled:NAME ({', '.join(bundled.NAMES)})",
    )
    what = parser.add_argument_group("maps")
    what.add_argument("--profile", metavar="NAME", help="mapping profile [default]")
    what.add_argument(
        "--ablations", action="store_true", help="rows for POT and RePOT with its priors as well"
    )
    what.add_argument(
        "--peers",
        type=lambda text: [name for name in text.split(",") if name],
        default=[],
        metavar="LIST",
        help="other maps: octomap:METRES, bgk:METRES, bgk-gap:METRES, grid; with commas",
    )
    what.add_argument("--settings", metavar="FILE", help="TOML settings file (also POTSERVER_SETTINGS)")
    what.add_argument("--dictionary", metavar="FILE", help="atom dictionary [the built-in atoms]")
    what.add_argument(
        "--threads", type=int, metavar="N", help="threads that integrate one scan [all processors]"
    )
    what.add_argument(
        "--set",
        action="append",
        dest="sets",
        default=[],
        metavar="KEY=VALUE",
        help="any setting, by its dotted name",
    )
    beams = parser.add_argument_group("beams")
    beams.add_argument("--hold-out", type=float, default=0.2, metavar="SHARE", help="of the beams [0.2]")
    beams.add_argument("--scans", metavar="N", help="the first N of each recording, or START:STOP:STEP [all]")
    beams.add_argument(
        "--thin", type=_positive_int, default=1, metavar="N", help="every Nth beam of a scan [1]"
    )
    beams.add_argument(
        "--min-range", type=float, default=0.0, metavar="M", help="nearer beams are dropped [0]"
    )
    beams.add_argument(
        "--max-range", type=float, metavar="M", help="longer beams are free up to here, without an echo"
    )
    beams.add_argument(
        "--no-return", type=float, metavar="M", help="of CARMEN logs: readings from here on are no echoes"
    )
    beams.add_argument("--format", choices=FORMATS, default="auto", help="of the recordings [auto]")
    beams.add_argument(
        "--frame", choices=FRAMES, default="auto", help="of PCD files: where their points are [auto]"
    )
    out = parser.add_argument_group("results")
    out.add_argument("--json", metavar="FILE", help="all numbers, with the machine and the options")
    out.add_argument("--markdown", metavar="FILE", help="the tables, for a document")


def _positive_int(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}: need at least 1")
    return value


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
    store = server.add_mutually_exclusive_group()
    store.add_argument(
        "--store",
        metavar="DIR",
        help="where the maps survive restarts [$XDG_STATE_HOME/potserver/SERVER_ID, else under ~/.local/state]",
    )
    store.add_argument("--in-memory", action="store_true", help="forget the maps at the end")
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
            "store.directory": "" if options.in_memory else options.store,
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
    store = settings.store
    if store.directory is None:  # nobody said anything: a server of its own keeps its maps
        store = dataclasses.replace(store, directory=str(_state_folder() / settings.server_id))
    return dataclasses.replace(
        settings, store=store, zenoh=dataclasses.replace(settings.zenoh, cfg={**settings.zenoh.cfg, **cfg})
    )


def _state_folder() -> Path:
    """Where programs of this user keep their state, by the XDG base directory rules: a relative path does not count."""
    named = Path(os.environ.get("XDG_STATE_HOME", ""))
    return (named if named.is_absolute() else Path.home() / ".local" / "state") / "potserver"


def _split(assignment: str, separator: str, flag: str, form: str) -> tuple[str, str]:
    key, found, value = assignment.partition(separator)
    if not found or not key:
        raise SettingsError(f"{flag} {assignment!r}: need {form}")
    return key, value


def _say(text: str, stream: TextIO | None = None) -> None:
    (stream or sys.stdout).write(f"{text}\n")


if __name__ == "__main__":
    sys.exit(main())
