"""`potclient publish | query | grid | watch | load | info | atoms | control`."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from potclient.client import MapClient
from potclient.datasets import FORMATS, FRAMES, Recording, open_dataset
from potclient.errors import DatasetError, MapServerError, PotclientError, UsageError
from potclient.holdout import HoldOut
from potclient.session import DEFAULT_ENDPOINT, add_zenoh_arguments, options_from_arguments
from potschemas import __version__
from potschemas.keys import DEFAULT_ROOT

if TYPE_CHECKING:
    from potclient.loadtest import LoadReport
    from potclient.metrics import Metrics
    from potclient.play import PlayReport, ScanOutcome

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_INTERRUPTED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the result is the exit status: 0 done, 1 failed, 2 wrong usage, 130 interrupted."""
    arguments = build_parser().parse_args(argv)
    command: Callable[[argparse.Namespace], int] = arguments.command
    try:
        return command(arguments)
    except (UsageError, DatasetError) as error:
        return _complain(str(error), EXIT_USAGE)
    except MapServerError as error:
        return _complain(f"the server refused ({error.code}): {error}", EXIT_FAILED)
    except PotclientError as error:
        return _complain(str(error), EXIT_FAILED)
    except BrokenPipeError:  # `potclient ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILED
    except OSError as error:
        return _complain(f"{error.filename or 'file'}: {error.strerror or error}", EXIT_FAILED)
    except KeyboardInterrupt:
        return _complain("interrupted", EXIT_INTERRUPTED)


def build_parser() -> argparse.ArgumentParser:
    """All commands and their flags."""
    parser = argparse.ArgumentParser(
        prog="potclient",
        description="Feed a potserver map and ask it: occupancy with uncertainty, anywhere, over Zenoh.",
        epilog=f"""examples:
  potclient info                                  what the server at {DEFAULT_ENDPOINT} is and holds
  potclient publish generated                     play a made-up scene into the map
  potclient query 1 2 0.5                         how likely is this point occupied, and how sure is the map
  potclient grid --resolution 0.2 -o map.npz      the whole map as a grid
  potclient load --robots 8 --planners 4          how much the server takes

`potclient COMMAND --help` explains each command.""",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"potclient {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_publish(commands)
    _add_query(commands)
    _add_grid(commands)
    _add_watch(commands)
    _add_load(commands)
    _add_info(commands)
    _add_atoms(commands)
    _add_control(commands)
    return parser


# --- publish -------------------------------------------------------------------------------------------------------


def _add_publish(commands: Any) -> None:
    parser = _command(
        commands,
        "publish",
        _publish,
        help="play a recording into the map, one receipt a scan",
        description="""Play a recording into the map. Every scan is sent and its receipt shown; the exit status is 1 if any
scan has no receipt or was not accepted.

DATASET is found out by looking at it:
  a folder with velodyne/*.bin      KITTI odometry, with poses.txt and calib.txt
  a folder of .pcd or .ply files    with poses.txt (3x4 a line), or a VIEWPOINT in each header
  a .log or .clf file (.bz2, .gz)   a CARMEN log of a planar laser
  generated[:2d][:SEED]             a made-up scene""",
        epilog="""examples:
  potclient publish generated --limit 20
  potclient publish kitti/00 --poses poses_velo_icp.txt --max-range 25
  potclient publish sim_structured --max-range 8 --hold-out 0.2
  potclient publish aces.clf.bz2 --poses aces_poses_optimised.txt --every 10 --rate 20
  potclient publish scans/ --robot r2 --rate 10 --drop     like a live robot: newest cloud wins""",
    )
    _add_recording_arguments(parser, "DATASET")
    parser.add_argument("--robot", default="r1", help="id of the robot that sends (default r1)")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--rate", type=_positive, metavar="HZ", help="scans a second, at most")
    pace.add_argument("--as-fast", action="store_true", help="as fast as receipts come back (default)")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--drop",
        action="store_true",
        help="do not wait for receipts: a newer cloud replaces one that still waits",
    )
    how.add_argument(
        "--acknowledged",
        action="store_true",
        help="send each scan as a query and wait until it is in the map",
    )
    parser.add_argument(
        "--keep-stamps", action="store_true", help="send the recorded stamps instead of the current time"
    )
    parser.add_argument(
        "--hold-out",
        type=float,
        metavar="FRACTION",
        help="keep this share of each scan's beams back and score the map on them at the end: ACC AUC NLL Brier ECE",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the held-out beams (default 0)")
    parser.add_argument(
        "--max-test",
        type=int,
        default=200_000,
        metavar="N",
        help="score at most N held-out points (default 200000)",
    )
    parser.add_argument("--clear", action="store_true", help="clear the map first")
    parser.add_argument(
        "--receipt-timeout", type=_positive, default=30.0, metavar="SECONDS", help="default 30"
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="only the summary")
    _add_json_argument(parser)


def _publish(arguments: argparse.Namespace) -> int:
    from potclient.play import play

    recording = _open_recording(arguments)
    hold_out = None if arguments.hold_out is None else HoldOut(arguments.hold_out, arguments.seed)
    with _client(arguments, receipt_timeout_s=arguments.receipt_timeout) as client:
        client.wait_ready()
        _note(f"{recording.path}: {len(recording)} scans ({recording.format}); {'; '.join(recording.notes)}")
        if arguments.clear:
            _note(client.control("clear").message)
        with _scan_progress(len(recording), quiet=arguments.quiet) as on_outcome:
            report = play(
                client,
                recording,
                robot=arguments.robot,
                rate_hz=arguments.rate,
                lossless=not arguments.drop,
                acknowledged=arguments.acknowledged,
                keep_stamps=arguments.keep_stamps,
                hold_out=hold_out,
                max_test_points=arguments.max_test,
                on_outcome=on_outcome,
            )
    _write_json(arguments.json, report.to_json())
    if arguments.json != "-":
        _say_play(report)
    if report.failure is not None:
        raise report.failure
    return EXIT_OK if report.all_accepted else EXIT_FAILED


def _say_play(report: PlayReport) -> None:
    parts = [f"{report.count('accepted')} of {len(report.scans)} scans accepted"]
    parts += [
        f"{report.count(status)} {status.replace('_', ' ')}"
        for status in ("dropped", "rejected", "unknown", "dropped_by_client")
        if report.count(status)
    ]
    accepted = [scan for scan in report.scans if scan.status == "accepted"]
    if accepted:
        median = float(np.median([scan.integrate_ms for scan in accepted]))
        parts.append(f"{median:.0f} ms a scan (median)")
        parts.append(f"{accepted[-1].map_kernels} kernels in the map, revision {accepted[-1].map_revision}")
    _say(", ".join(parts) + f", {report.elapsed_s:.1f} s")
    if report.held_out is not None:
        _say(f"held-out beams: {_metrics_line(report.held_out)} ({report.n_held_out} points held out)")


def _metrics_line(m: Metrics) -> str:
    return (
        f"ACC {m.accuracy:.4f}  AUC {m.auc:.4f}  NLL {m.nll:.4f}  Brier {m.brier:.4f}  ECE {m.ece:.4f}"
        f"  unknown {m.share_unknown:.2%}  n {m.n}"
    )


@contextlib.contextmanager
def _scan_progress(total: int, *, quiet: bool) -> Iterator[Callable[[ScanOutcome], None]]:
    """A line a scan on stdout; a progress bar under it when stderr is a terminal."""

    def line(outcome: ScanOutcome) -> str:
        why = f" ({outcome.reason}: {outcome.message})" if outcome.reason else ""
        took = f"  {outcome.integrate_ms:6.0f} ms" if outcome.status == "accepted" else ""
        kernels = (
            f"  kernels {outcome.n_kernels} (+{outcome.n_kernels_added})  rev {outcome.map_revision}"
            if outcome.status == "accepted"
            else ""
        )
        return f"{outcome.index:6d}  {outcome.name}  {outcome.n_points} points  {outcome.status}{why}{took}{kernels}"

    progress = _rich_progress(total) if sys.stderr.isatty() and not quiet else None
    if progress is None:
        yield (lambda outcome: None) if quiet else (lambda outcome: _say(line(outcome)))
        return
    bar, task = progress
    with bar:

        def show(outcome: ScanOutcome) -> None:
            if sys.stdout.isatty():
                bar.console.print(line(outcome), highlight=False, markup=False, soft_wrap=True)
            else:
                _say(line(outcome))
            bar.advance(task)

        yield show


def _rich_progress(total: int) -> tuple[Any, Any] | None:
    try:
        from rich.console import Console
        from rich.progress import Progress
    except ImportError:
        return None
    bar = Progress(console=Console(stderr=True), transient=True)
    return bar, bar.add_task("scans", total=total)


# --- query and grid ------------------------------------------------------------------------------------------------


def _add_query(commands: Any) -> None:
    parser = _command(
        commands,
        "query",
        _query,
        help="occupancy and its uncertainty at points",
        description="""Ask how likely points are occupied. Each answer has the probability, its standard deviation, the latent
log-odds with theirs, and whether the map has seen anything near: unknown is 0.5 and not the same as free.""",
        epilog="""examples:
  potclient query 1 2 0.5
  potclient query 1 2 0.5 -3 0 1           two points
  potclient query --file points.npy -o answers.npz
  potclient query 1 2 0.5 --json -""",
    )
    parser.add_argument("coordinates", type=float, nargs="*", metavar="X Y Z", help="metres, map frame")
    parser.add_argument(
        "--file", type=Path, metavar="FILE", help=".npy of shape (N, 3) or (N, 2), or text rows of x y z"
    )
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="write all answers to an .npz")
    _add_json_argument(parser)


def _query(arguments: argparse.Namespace) -> int:
    points = _query_points(arguments)
    with _client(arguments) as client:
        answer = client.occupancy(points)
    if arguments.out is not None:
        with arguments.out.open("wb") as file:
            np.savez_compressed(
                file,
                allow_pickle=False,
                points=points,
                mean=answer.mean,
                var=answer.var,
                latent_mean=answer.latent_mean,
                latent_var=answer.latent_var,
                observed=answer.observed,
                revision=np.int64(answer.revision),
            )
    _write_json(
        arguments.json,
        {
            "revision": answer.revision,
            "points": points.tolist(),
            **{
                n: getattr(answer, n).tolist()
                for n in ("mean", "var", "latent_mean", "latent_var", "observed")
            },
        },
    )
    if arguments.json == "-":
        return EXIT_OK
    shown = 20
    rows = [
        [
            *[f"{c:.3f}" for c in points[i]],
            f"{answer.mean[i]:.4f}",
            f"{math.sqrt(answer.var[i]):.4f}",
            f"{answer.latent_mean[i]:+.3f}",
            f"{math.sqrt(answer.latent_var[i]):.3f}",
            "yes" if answer.observed[i] else "no",
        ]
        for i in range(min(len(points), shown))
    ]
    heads = ["x", "y", "z"][: points.shape[1]]
    _say(_table([*heads, "P(occupied)", "std", "log-odds", "std", "observed"], rows))
    if len(points) > shown:
        _say(f"... and {len(points) - shown} more (-o FILE or --json FILE has all)")
    _say(
        f"map revision {answer.revision}, {float(answer.observed.mean()):.1%} of {len(points)} points observed"
    )
    return EXIT_OK


def _query_points(arguments: argparse.Namespace) -> np.ndarray[Any, np.dtype[np.float64]]:
    if (arguments.file is None) == (not arguments.coordinates):
        raise UsageError("query: give coordinates X Y Z ..., or --file, and not both")
    if arguments.file is None:
        if len(arguments.coordinates) % 3:
            raise UsageError(f"query: {len(arguments.coordinates)} coordinates are not whole points of X Y Z")
        return np.asarray(arguments.coordinates, np.float64).reshape(-1, 3)
    try:
        if arguments.file.suffix == ".npy":
            points = np.load(arguments.file, allow_pickle=False)
        else:
            points = np.loadtxt(arguments.file, ndmin=2)
        points = np.asarray(points, np.float64)
    except (ValueError, TypeError, EOFError) as error:
        raise UsageError(f"{arguments.file}: not an array of points ({error})") from error
    if points.ndim != 2 or points.shape[1] not in (2, 3) or not len(points):
        raise UsageError(f"{arguments.file}: shape {points.shape}, need (N, 3) or (N, 2)")
    return points


def _add_grid(commands: Any) -> None:
    parser = _command(
        commands,
        "grid",
        _grid,
        help="occupancy on a grid, streamed in parts",
        description="""Sample a box of the map on a grid of any resolution, all cells from one revision of the map. Without
--lower and --upper the box spans all kernels of the map.""",
        epilog="""examples:
  potclient grid --resolution 0.5 -o map.npz
  potclient grid --lower -10 -10 -1 --upper 10 10 3 --resolution 0.2 -o map.npz --png map.png
  potclient grid --lower -10 -10 0.9 --upper 10 10 1.1 --resolution 0.2 --png slice.png""",
    )
    parser.add_argument(
        "--lower", type=float, nargs=3, metavar=("X", "Y", "Z"), help="corner of the box, m, map frame"
    )
    parser.add_argument("--upper", type=float, nargs=3, metavar=("X", "Y", "Z"))
    parser.add_argument("--resolution", type=_positive, required=True, metavar="METRES", help="cell edge")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="write an .npz: mean, var, ..., lower, resolution"
    )
    parser.add_argument("--png", type=Path, metavar="FILE", help="draw mean and uncertainty of one layer")
    parser.add_argument(
        "--level", type=float, metavar="Z", help="layer for --png, m (default: the middle one)"
    )
    parser.set_defaults(timeout=60.0)


def _grid(arguments: argparse.Namespace) -> int:
    if arguments.out is None and arguments.png is None:
        raise UsageError("grid: nothing to do with the answer; give -o FILE or --png FILE")
    with _client(arguments) as client:
        lower, upper = arguments.lower, arguments.upper
        if lower is None or upper is None:
            info = client.info()
            if info.lower is None or info.upper is None:
                raise UsageError(
                    "grid: the map is empty; publish something first, or give --lower and --upper"
                )
            lower = info.lower if lower is None else lower
            upper = (
                [max(b, a + arguments.resolution) for a, b in zip(lower, info.upper, strict=True)]
                if upper is None
                else upper
            )
        grid = client.grid(lower, upper, arguments.resolution, progress=_part_progress())
    _say(
        f"{' x '.join(str(n) for n in grid.shape)} cells of {grid.resolution:g} m, revision {grid.revision}: "
        f"{float(grid.observed.mean()):.1%} observed, {int(((grid.mean > 0.5) & grid.observed).sum())} occupied"
    )
    if arguments.out is not None:
        grid.save(arguments.out)
        _say(f"wrote {arguments.out}")
    if arguments.png is not None:
        from potclient.pictures import draw_layer

        draw_layer(grid, arguments.png, level_m=arguments.level)
        _say(f"wrote {arguments.png}")
    return EXIT_OK


def _part_progress() -> Callable[[int, int], None] | None:
    if not sys.stderr.isatty():
        return None

    def show(received: int, total: int) -> None:
        sys.stderr.write(f"\rpart {received} of {total}" + ("\n" if received == total else ""))
        sys.stderr.flush()

    return show


# --- watch ---------------------------------------------------------------------------------------------------------


def _add_watch(commands: Any) -> None:
    parser = _command(
        commands,
        "watch",
        _watch,
        help="follow the map: revisions, receipts, server counters",
        description="Print what happens to the map as it happens, until interrupted or --seconds are over.",
        epilog="""examples:
  potclient watch
  potclient watch --seconds 30 --json        one JSON object a line""",
    )
    parser.add_argument(
        "--seconds", type=_positive, metavar="S", help="stop after S seconds (default: never)"
    )
    parser.add_argument("--events", type=int, metavar="N", help="stop after N events")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--no-stats", action="store_true", help="leave out the server's counters")


def _watch(arguments: argparse.Namespace) -> int:
    import queue

    events: queue.Queue[tuple[str, msgspec.Struct]] = queue.Queue()
    until = None if arguments.seconds is None else time.monotonic() + arguments.seconds
    n = 0
    with _client(arguments) as client:
        client.watch_revisions(lambda m: events.put(("revision", m)))
        client.watch_receipts(lambda m: events.put(("receipt", m)))
        if not arguments.no_stats:
            client.watch_stats(lambda m: events.put(("stats", m)))
        servers = client.wait_ready()
        _note(f"watching map {arguments.map} of server {servers}")
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
                _say(json.dumps({"event": kind, **_plain(message)}))
            else:
                _say(f"{time.strftime('%H:%M:%S')}  {_event_line(kind, message)}")
    return EXIT_OK


def _event_line(kind: str, message: Any) -> str:
    if kind == "revision":
        return f"revision {message.map_revision}: {message.n_kernels} kernels, {len(message.changed_tiles)} tiles changed"
    if kind == "receipt":
        why = f" ({message.reason})" if message.reason else ""
        return f"{message.robot} #{message.seq} {message.status.value}{why}, {message.integrate_ms:.0f} ms"
    depths = ", ".join(f"{name} {value}" for name, value in sorted(message.queues.items()))
    kernels = ", ".join(f"{name} {value} kernels" for name, value in sorted(message.map_kernels.items()))
    return f"{message.server} {message.state}: {kernels}; {depths}; {message.rss_bytes / 2**20:.0f} MiB"


# --- load ----------------------------------------------------------------------------------------------------------


def _add_load(commands: Any) -> None:
    parser = _command(
        commands,
        "load",
        _load,
        help="load test: robots that publish, planners that ask",
        description="""Put load on a server and account for every cloud: offered = dropped by the client + accepted + dropped
and rejected by the server with a reason + unknown. Robots drop what the server cannot take in time, as in the field. The
exit status is 1 if a cloud has no known fate, or a question failed for another reason than overload.""",
        epilog="""examples:
  potclient load --robots 4 --hz 5 --planners 2 --seconds 10
  potclient load --robots 32 --hz 10 --points 20000 --dataset kitti/00 --json load.json""",
    )
    parser.add_argument("--robots", type=int, default=4, help="default 4")
    parser.add_argument("--hz", type=_positive, default=5.0, help="clouds a second a robot (default 5)")
    parser.add_argument("--planners", type=int, default=2, help="default 2")
    parser.add_argument(
        "--planner-hz", type=_positive, default=10.0, help="questions a second a planner (default 10)"
    )
    parser.add_argument("--seconds", type=_positive, default=10.0, help="default 10")
    parser.add_argument("--points", type=int, default=5000, help="points a cloud (default 5000)")
    parser.add_argument("--query-points", type=int, default=1000, help="points a question (default 1000)")
    parser.add_argument("--dataset", default="generated", help="recording to send (default: generated)")
    parser.add_argument(
        "--receipt-timeout", type=_positive, default=30.0, metavar="SECONDS", help="default 30"
    )
    parser.add_argument(
        "--robot-prefix", default="load", help="robots are PREFIX-0, PREFIX-1, ... (default load)"
    )
    parser.add_argument("--seed", type=int, default=0)
    _add_json_argument(parser)


def _load(arguments: argparse.Namespace) -> int:
    from potclient.loadtest import LoadSettings, run_load

    settings = LoadSettings(
        robots=arguments.robots,
        rate_hz=arguments.hz,
        planners=arguments.planners,
        planner_hz=arguments.planner_hz,
        duration_s=arguments.seconds,
        n_points=arguments.points,
        query_points=arguments.query_points,
        receipt_timeout_s=arguments.receipt_timeout,
        query_timeout_s=arguments.timeout,
        robot_prefix=arguments.robot_prefix,
        seed=arguments.seed,
    )
    recording = open_dataset(arguments.dataset)
    options = options_from_arguments(arguments)
    report = run_load(settings, recording, options=options, map_id=arguments.map, root=arguments.root)
    _write_json(arguments.json, report.to_json())
    if arguments.json != "-":
        _say_load(report)
    if report.interrupted:
        return _complain("interrupted", EXIT_INTERRUPTED)
    return EXIT_OK if report.nothing_lost else EXIT_FAILED


def _say_load(report: LoadReport) -> None:
    c = report.clouds
    rows = [
        ["offered", str(c.offered)],
        ["dropped by client", str(c.dropped_by_client)],
        ["accepted", str(c.accepted)],
        ["dropped by server", str(c.dropped)],
        ["rejected by server", str(c.rejected)],
        ["unknown", str(c.unknown)],
    ]
    rows += [[f"  {reason}", str(n)] for reason, n in report.reasons.items()]
    _say(_table(["clouds", "count"], rows))
    rows = [
        ["questions asked", str(report.asked)],
        ["answered", str(report.answered)],
        ["overloaded", str(report.overloaded)],
        *[[f"failed: {name}", str(n)] for name, n in report.failed.items()],
    ]
    _say("\n" + _table(["planners", "count"], rows))
    rows = [
        [name, str(p.n), *(f"{v:.1f}" for v in p[1:])]
        for name, p in (
            ("receipt", report.receipts),
            ("integrate", report.integrate),
            ("question", report.queries),
        )
    ]
    _say("\n" + _table(["latency, ms", "n", "p50", "p95", "p99", "max"], rows))
    for kind, text in report.examples.items():
        _say(f"{kind}: {text}")
    rate, answers = c.accepted / report.elapsed_s, report.answered / report.elapsed_s
    verdict = "every cloud is accounted for" if report.nothing_lost else "SOMETHING WAS LOST"
    _say(f"\n{report.elapsed_s:.1f} s, {rate:.1f} clouds/s integrated, {answers:.1f} answers/s: {verdict}")


# --- info, atoms, control ------------------------------------------------------------------------------------------


def _add_info(commands: Any) -> None:
    parser = _command(
        commands,
        "info",
        _info,
        help="what the server is, holds and accepts",
        description="What the server is, what its map holds, what it accepts, and its counters with --stats.",
    )
    parser.add_argument("--stats", action="store_true", help="the server's counters too")
    _add_json_argument(parser)


def _info(arguments: argparse.Namespace) -> int:
    with _client(arguments) as client:
        tree = _plain(client.info())
        if arguments.stats:
            tree["stats"] = _plain(client.stats(tree["server"]))
    _write_json(arguments.json, tree)
    if arguments.json != "-":
        _say(_table(["", ""], [[key, _cell(value)] for key, value in _flatten(tree)], rule=False))
    return EXIT_OK


def _add_atoms(commands: Any) -> None:
    parser = _command(
        commands,
        "atoms",
        _atoms,
        help="the dictionary of atoms, or one of them",
        description="List the dictionary's atoms with how often each has served, or fetch one whole.",
        epilog="""examples:
  potclient atoms
  potclient atoms wall.1 -o wall.npz""",
    )
    parser.add_argument("atom_id", nargs="?", metavar="ID")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="save the atom's kernels (KernelSet.load reads them)"
    )
    _add_json_argument(parser)


def _atoms(arguments: argparse.Namespace) -> int:
    if arguments.out is not None and arguments.atom_id is None:
        raise UsageError("atoms: -o saves one atom; name its ID")
    with _client(arguments) as client:
        if arguments.atom_id is None:
            atoms = client.atoms()
        else:
            atom = client.atom(arguments.atom_id)
            atoms = [atom.info]
            if arguments.out is not None:
                atom.kernels.save(arguments.out)
    _write_json(arguments.json, [_plain(atom) for atom in atoms])
    if arguments.json == "-":
        return EXIT_OK
    heads = ["atom", "dims", "hits", "free", "kernels", "radius m", "width deg", "used", "source"]
    rows = [
        [
            a.atom_id,
            str(a.dims),
            str(a.n_hits),
            str(a.n_free),
            str(a.n_kernels),
            f"{a.radius_m:.1f}",
            f"{math.degrees(a.azimuth_width_rad):.0f}",
            str(a.times_used),
            a.provenance.get("source", ""),
        ]
        for a in atoms
    ]
    _say(_table(heads, rows))
    if arguments.atom_id is not None:
        _say("\n".join(f"{key}: {value}" for key, value in sorted(atoms[0].provenance.items())))
    return EXIT_OK


def _add_control(commands: Any) -> None:
    parser = _command(
        commands,
        "control",
        _control,
        help="carry out a control verb: clear, drain",
        description="Carry out a control verb on the map; the server says which it has.",
        epilog="examples:\n  potclient control clear",
    )
    parser.add_argument("verb", help="e.g. clear")


def _control(arguments: argparse.Namespace) -> int:
    with _client(arguments) as client:
        reply = client.control(arguments.verb)
    _say(f"{reply.verb}: {reply.message} (revision {reply.map_revision})")
    return EXIT_OK


# --- shared --------------------------------------------------------------------------------------------------------


def _command(commands: Any, name: str, run: Callable[[argparse.Namespace], int], **texts: str) -> Any:
    parser = commands.add_parser(name, formatter_class=argparse.RawDescriptionHelpFormatter, **texts)
    parser.set_defaults(command=run)
    group = parser.add_argument_group("server")
    group.add_argument("--map", default="default", metavar="ID", help="id of the map (default: default)")
    group.add_argument("--root", default=DEFAULT_ROOT, help=f"root of all keys (default {DEFAULT_ROOT})")
    group.add_argument(
        "--timeout", type=_positive, default=10.0, metavar="SECONDS", help="of one answer (default 10)"
    )
    add_zenoh_arguments(parser)
    return parser


def _add_json_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--json", metavar="FILE", help="write everything as JSON; - is stdout, instead of text"
    )


def _add_recording_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    parser.add_argument("dataset", metavar=name)
    group = parser.add_argument_group("recording")
    group.add_argument("--format", choices=FORMATS, default="auto", help="default: look at it")
    group.add_argument("--poses", metavar="FILE", help="pose file to use instead of the usual one")
    group.add_argument(
        "--frame", choices=FRAMES, default="auto", help="PCD files without poses.txt: where their points are"
    )
    group.add_argument(
        "--world-frame", action="store_const", const="world", dest="frame", help="the same as --frame world"
    )
    group.add_argument(
        "--no-return",
        type=_positive,
        metavar="METRES",
        help="CARMEN: readings from here on are no echoes (default 50)",
    )
    group.add_argument(
        "--max-range",
        type=_positive,
        metavar="METRES",
        help="beams beyond are free up to here and have no echo",
    )
    group.add_argument(
        "--min-range", type=float, default=0.0, metavar="METRES", help="drop points nearer than this"
    )
    group.add_argument("--skip", type=int, default=0, metavar="N", help="leave out the first N scans")
    group.add_argument("--every", type=int, default=1, metavar="N", help="take every N-th scan")
    group.add_argument("--limit", type=int, metavar="N", help="take at most N scans")


def _open_recording(arguments: argparse.Namespace) -> Recording:
    if arguments.skip < 0 or arguments.every < 1 or (arguments.limit is not None and arguments.limit < 1):
        raise UsageError("--skip must be 0 or more, --every and --limit 1 or more")
    recording = open_dataset(
        arguments.dataset,
        arguments.format,
        poses=arguments.poses,
        frame=arguments.frame,
        no_return_m=arguments.no_return,
        min_range_m=arguments.min_range,
        max_range_m=arguments.max_range,
    )
    chosen = recording[arguments.skip :: arguments.every][: arguments.limit]
    if len(chosen) == 0:
        raise UsageError(
            f"{arguments.dataset}: --skip {arguments.skip} leaves none of {len(recording)} scans"
        )
    return chosen


@contextlib.contextmanager
def _client(arguments: argparse.Namespace, **settings: Any) -> Iterator[MapClient]:
    with MapClient(
        map=arguments.map,
        root=arguments.root,
        timeout_s=arguments.timeout,
        options=options_from_arguments(arguments),
        **settings,
    ) as client:
        if arguments.wait > 0:
            client.wait_ready(arguments.wait)
        yield client


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _write_json(target: str | None, tree: Any) -> None:
    if target is None:
        return
    text = json.dumps(_finite(tree), indent=1)
    if target == "-":
        _say(text)
    else:
        Path(target).write_text(text + "\n")


def _finite(tree: Any) -> Any:
    """The tree with NaN and infinity as null: JSON has neither."""
    if isinstance(tree, dict):
        return {key: _finite(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return [_finite(value) for value in tree]
    if isinstance(tree, float) and not math.isfinite(tree):
        return None
    return tree


def _plain(message: msgspec.Struct) -> dict[str, Any]:
    return dict(msgspec.to_builtins(message))


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


def _table(heads: list[str], rows: list[list[str]], *, rule: bool = True) -> str:
    """Columns as wide as their widest cell; numbers to the right."""
    lines = [heads, *rows] if rule else rows
    widths = [max((len(line[i]) for line in lines), default=0) for i in range(len(heads))]
    right = [bool(rows) and all(_is_number(row[i]) for row in rows) for i in range(len(heads))]

    def line(cells: list[str]) -> str:
        padded = (c.rjust(w) if r else c.ljust(w) for c, w, r in zip(cells, widths, right, strict=True))
        return "  ".join(padded).rstrip()

    return "\n".join(line(cells) for cells in lines)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def _note(text: str) -> None:
    sys.stderr.write(text + "\n")


def _complain(text: str, status: int) -> int:
    sys.stderr.write(f"potclient: {text}\n")
    return status


if __name__ == "__main__":
    sys.exit(main())
