"""`potclient publish | query | grid | rays | risk | export | mirror | watch | load | info | atoms | map | town`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from potclient.atoms import Atom
from potclient.client import CONTROL_TIMEOUT_S, MapClient
from potclient.datasets import FORMATS, FRAMES, Recording, open_dataset
from potclient.errors import (
    DatasetError,
    LostReplyError,
    MapServerError,
    NoServerError,
    PotclientError,
    QueryTimeoutError,
    UsageError,
)
from potclient.files import save_npz
from potclient.holdout import HoldOut
from potclient.session import DEFAULT_ENDPOINT, add_zenoh_arguments, options_from_arguments
from potschemas import __version__, messages
from potschemas.keys import CONTROL_VERBS, DEFAULT_ROOT

if TYPE_CHECKING:
    from potclient.export import MapSource
    from potclient.loadtest import LoadReport
    from potclient.metrics import Metrics
    from potclient.mirror import MapMirror, MirrorUpdate
    from potclient.play import PlayReport, ScanOutcome

_POLL_S = (
    2.0  # `mirror` asks so often even if nothing was announced: a server that was restarted announces nothing
)
EXPORT_KINDS = ("ply", "npz", "pgm", "bt")
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
        named = error.filename is not None  # numpy names the file in the text alone
        return _complain(f"{error.filename}: {error.strerror}" if named else str(error), EXIT_FAILED)
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
  potclient rays 0 0 1 --max-range 20             how far one can see from there, all around
  potclient export bt -o map.bt --resolution 0.2  the map for programs that read OctoMap files
  potclient mirror                                follow the map by what changes
  potclient map save before-the-rain              a copy of the map, to go back to
  potclient load --robots 8 --planners 4          how much the server takes

`potclient COMMAND --help` explains each command.""",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"potclient {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_publish(commands)
    _add_query(commands)
    _add_grid(commands)
    _add_rays(commands)
    _add_risk(commands)
    _add_export(commands)
    _add_mirror(commands)
    _add_watch(commands)
    _add_load(commands)
    _add_info(commands)
    _add_atoms(commands)
    _add_map(commands)
    _add_town(commands)
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
  generated[:2d][:SEED]             a made-up yard
  town:STYLE[:2d][:dynamic][:SEED]  a drive through a made-up town, see `potclient town --help`""",
        epilog="""examples:
  potclient publish generated --limit 20
  potclient publish town:terraces:300m --every 5 --max-range 25 --hold-out 0.2
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


def _rich_progress(total: int, what: str = "scans") -> tuple[Any, Any] | None:
    try:
        from rich.console import Console
        from rich.progress import Progress
    except ImportError:
        return None
    bar = Progress(console=Console(stderr=True), transient=True)
    return bar, bar.add_task(what, total=total)


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
  potclient query 1 2 0.5 --gradient       which way it gets more likely occupied
  potclient query 1 2 0.5 --json -""",
    )
    parser.add_argument("coordinates", type=float, nargs="*", metavar="X Y Z", help="metres, map frame")
    parser.add_argument(
        "--file", type=Path, metavar="FILE", help=".npy of shape (N, 3) or (N, 2), or text rows of x y z"
    )
    parser.add_argument("--gradient", action="store_true", help="gradients of probability and log-odds too")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="write all answers to an .npz")
    _add_json_argument(parser)


def _query(arguments: argparse.Namespace) -> int:
    points = _query_points(arguments)
    with _client(arguments) as client:
        answer = client.occupancy(points, with_gradient=arguments.gradient)
    names = ["mean", "var", "latent_mean", "latent_var", "observed"]
    names += ["gradient", "latent_gradient"] if arguments.gradient else []
    if arguments.out is not None:
        save_npz(
            arguments.out,
            points=points,
            revision=np.int64(answer.revision),
            **{name: getattr(answer, name) for name in names},
        )
    _write_json(
        arguments.json,
        {
            "revision": answer.revision,
            "points": points.tolist(),
            **{name: getattr(answer, name).tolist() for name in names},
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
            *([] if answer.gradient is None else [f"{g:+.4f}" for g in answer.gradient[i]]),
        ]
        for i in range(min(len(points), shown))
    ]
    heads = [*["x", "y", "z"][: points.shape[1]], "P(occupied)", "std", "log-odds", "std", "observed"]
    heads += ["dP/dx 1/m", "dP/dy", "dP/dz"] if arguments.gradient else []
    _say(_table(heads, rows))
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
    return _read_table(arguments.file, (2, 3), "points")


def _read_table(path: Path, columns: tuple[int, ...], what: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Rows of numbers, from an .npy or from text."""
    try:
        table = np.load(path, allow_pickle=False) if path.suffix == ".npy" else np.loadtxt(path, ndmin=2)
        table = np.asarray(table, np.float64)
    except (ValueError, TypeError, EOFError) as error:
        raise UsageError(f"{path}: not an array of {what} ({error})") from error
    if table.ndim != 2 or table.shape[1] not in columns or not len(table):
        need = " or ".join(f"(N, {n})" for n in reversed(columns))
        raise UsageError(f"{path}: shape {table.shape}, need {need}")
    return table


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
    _add_box_arguments(parser, "corner of the box, m, map frame")
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


# --- rays and risk -------------------------------------------------------------------------------------------------


def _add_rays(commands: Any) -> None:
    parser = _command(
        commands,
        "rays",
        _rays,
        help="how far rays get: expected range, quantiles, where the map does not know",
        description="""Ask where rays from a point first return. Without --toward or --file, rays go all around in the plane.

The hazard of a return along a ray is -ln(1 - P) / width, with P the probability of occupancy: a stretch of one width with
constant P stops the ray with probability P. Ranges are of the first return, or the maximum range where none is before.""",
        epilog="""examples:
  potclient rays 0 0 1 --max-range 20
  potclient rays 0 0 1 --toward 1 0 0 --quantiles 0.05 0.5 0.95
  potclient rays --file rays.npy --max-range 30 --unknown free -o answers.npz""",
    )
    parser.add_argument("origin", type=float, nargs="*", metavar="X Y Z", help="metres, map frame")
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--toward", type=float, nargs=3, metavar=("DX", "DY", "DZ"), help="one ray, along this direction"
    )
    which.add_argument("--fan", type=int, default=16, metavar="N", help="rays all around (default 16)")
    which.add_argument(
        "--file", type=Path, metavar="FILE", help=".npy of shape (N, 6): origins and directions; or text rows"
    )
    parser.add_argument(
        "--max-range", type=_positive, default=25.0, metavar="METRES", help="of the rays (default 25)"
    )
    parser.add_argument(
        "--quantiles", type=float, nargs="+", default=[0.05, 0.5, 0.95], metavar="Q", help="ascending"
    )
    _add_unknown_argument(parser, "prior")
    parser.add_argument(
        "--width", type=_positive, metavar="METRES", help="over which P is one trial (default: the kernels')"
    )
    parser.add_argument("--step", type=_positive, metavar="METRES", help="of the summation (default: fine)")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="write all answers to an .npz")
    _add_json_argument(parser)


def _rays(arguments: argparse.Namespace) -> int:
    origins, directions = _ray_arguments(arguments)
    with _client(arguments) as client:
        answer = client.rays(
            origins,
            directions,
            arguments.max_range,
            quantiles=arguments.quantiles,
            unknown=arguments.unknown,
            width_m=arguments.width,
            step_m=arguments.step,
        )
    arrays = {
        name: getattr(answer, name)
        for name in (
            "hit_probability",
            "mean_m",
            "std_m",
            "quantile_m",
            "unknown_range_m",
            "unknown_share",
        )
    }
    if arguments.out is not None:
        save_npz(
            arguments.out,
            origins=origins,
            directions=directions,
            quantiles=np.asarray(answer.quantiles),
            revision=np.int64(answer.revision),
            **arrays,
        )
    _write_json(
        arguments.json,
        {
            "revision": answer.revision,
            "step_m": answer.step_m,
            "quantiles": answer.quantiles,
            "directions": directions.tolist(),
            **{name: array.tolist() for name, array in arrays.items()},
        },
    )
    if arguments.json == "-":
        return EXIT_OK
    shown = 40
    rows = [
        [
            *[f"{c:+.3f}" for c in directions[i]],
            f"{answer.hit_probability[i]:.4f}",
            f"{answer.mean_m[i]:.3f}",
            f"{answer.std_m[i]:.3f}",
            *[f"{q:.3f}" for q in answer.quantile_m[i]],
            "-" if math.isnan(answer.unknown_range_m[i]) else f"{answer.unknown_range_m[i]:.3f}",
            f"{answer.unknown_share[i]:.1%}",
        ]
        for i in range(min(len(answer), shown))
    ]
    heads = ["dx", "dy", "dz", "P(return)", "mean m", "std m", *[f"q{q:g} m" for q in answer.quantiles]]
    _say(_table([*heads, "unknown from m", "unknown"], rows))
    if len(answer) > shown:
        _say(f"... and {len(answer) - shown} more (-o FILE or --json FILE has all)")
    _say(f"map revision {answer.revision}, steps of {answer.step_m:.3g} m")
    return EXIT_OK


def _ray_arguments(
    arguments: argparse.Namespace,
) -> tuple[np.ndarray[Any, np.dtype[np.float64]], np.ndarray[Any, np.dtype[np.float64]]]:
    """Origins and directions, (N, 3) each."""
    if (arguments.file is None) == (not arguments.origin):
        raise UsageError("rays: give the origin X Y Z, or --file, and not both")
    if arguments.file is not None:
        table = _read_table(arguments.file, (6,), "rays, as rows of origin and direction")
        return table[:, :3], table[:, 3:]
    if len(arguments.origin) != 3:
        raise UsageError(f"rays: the origin has {len(arguments.origin)} coordinates, need X Y Z")
    if arguments.toward is not None:
        directions = np.asarray([arguments.toward], np.float64)
    elif arguments.fan < 1:
        raise UsageError(f"rays: --fan {arguments.fan}, need at least 1")
    else:
        azimuth = np.arange(arguments.fan) * (2.0 * math.pi / arguments.fan)
        directions = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(arguments.fan)], axis=1)
    return np.tile(np.asarray(arguments.origin, np.float64), (len(directions), 1)), directions


def _add_risk(commands: Any) -> None:
    parser = _command(
        commands,
        "risk",
        _risk,
        help="how likely a robot on a path touches something",
        description="""Ask how likely a robot made of spheres touches an occupied point, pose by pose and for the whole path.

The robot covers cells of a lattice: all whose centres lie in a sphere, and those of the spheres' own centres. "max" is the
likeliest of them, as if all were one trial; "union" takes cells further apart than the correlation length as independent. The
truth lies between "max" and the sum over all cells. Poses count as they are: nothing is covered between them.

The path is a text file with, in each row, x y z, or x y z yaw (radians), or the 12 numbers of a 3x4 matrix, row by row.""",
        epilog="""examples:
  potclient risk --path path.txt --sphere 0 0 0.3 0.35
  potclient risk --path poses.txt --sphere 0.3 0 0.4 0.4 --sphere -0.3 0 0.4 0.4 --unknown prior
  potclient risk --path path.txt --sphere 0 0 0 0.3 --2d --json risk.json""",
    )
    parser.add_argument("--path", type=Path, required=True, metavar="FILE", help="poses; .npy, or text rows")
    parser.add_argument(
        "--sphere",
        type=float,
        nargs=4,
        action="append",
        required=True,
        metavar=("X", "Y", "Z", "R"),
        help="centre in the body frame and radius, m; may be repeated",
    )
    _add_unknown_argument(parser, "occupied")
    parser.add_argument(
        "--resolution", type=_positive, metavar="METRES", help="cell edge (default: half the smallest radius)"
    )
    parser.add_argument(
        "--correlation", type=_positive, metavar="METRES", help="edge of a cube that is one trial"
    )
    parser.add_argument("--2d", action="store_true", dest="planar", help="discs in the plane z = 0")
    _add_json_argument(parser)


def _risk(arguments: argparse.Namespace) -> int:
    path = _path_poses(arguments.path)
    with _client(arguments) as client:
        answer = client.risk(
            path,
            arguments.sphere,
            unknown=arguments.unknown,
            resolution_m=arguments.resolution,
            correlation_m=arguments.correlation,
            dims=2 if arguments.planar else 3,
        )
    arrays = {
        name: getattr(answer, name) for name in ("max_probability", "union_probability", "unknown_share")
    }
    totals = {
        name: getattr(answer, name)
        for name in (
            "path_max_probability",
            "path_union_probability",
            "path_unknown_share",
            "n_cells",
            "resolution_m",
            "revision",
        )
    }
    _write_json(arguments.json, totals | {name: array.tolist() for name, array in arrays.items()})
    if arguments.json == "-":
        return EXIT_OK
    shown = 40
    rows = [
        [
            str(i),
            *[f"{c:.2f}" for c in path[i, :3, 3]],
            f"{answer.max_probability[i]:.4f}",
            f"{answer.union_probability[i]:.4f}",
            f"{answer.unknown_share[i]:.1%}",
        ]
        for i in range(min(len(path), shown))
    ]
    _say(_table(["pose", "x", "y", "z", "max", "union", "unknown"], rows))
    if len(path) > shown:
        _say(f"... and {len(path) - shown} more (--json FILE has all)")
    _say(
        f"path: max {answer.path_max_probability:.4f}, union {answer.path_union_probability:.4f}, "
        f"{answer.path_unknown_share:.1%} unknown of {answer.n_cells} cells of {answer.resolution_m:g} m, "
        f"revision {answer.revision}"
    )
    return EXIT_OK


def _path_poses(path: Path) -> np.ndarray[Any, np.dtype[np.float64]]:
    """(P, 4, 4) from rows of x y z, x y z yaw, or 3x4 matrices."""
    rows = _read_table(path, (3, 4, 12), "poses: x y z, x y z yaw, or 12 numbers of a 3x4 matrix")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows.shape[1] == 12:
        poses[:, :3] = rows.reshape(-1, 3, 4)
        return poses
    poses[:, :3, 3] = rows[:, :3]
    if rows.shape[1] == 4:
        cos, sin = np.cos(rows[:, 3]), np.sin(rows[:, 3])
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cos, -sin, sin, cos
    return poses


def _add_unknown_argument(parser: Any, default: str) -> None:
    parser.add_argument(
        "--unknown",
        choices=[kind.value for kind in messages.Unknown],
        default=default,
        help=f"what unobserved space is taken for (default {default}; prior = 0.5)",
    )


# --- export --------------------------------------------------------------------------------------------------------


def _add_export(commands: Any) -> None:
    parser = _command(
        commands,
        "export",
        _export,
        help="the map as a file of another program: ply, npz, pgm, bt",
        description="""Write the map as a file that other programs read. Maps larger than one answer are fetched part by part.

  ply   kernels, all ten numbers of each, coloured by what they say
  npz   kernels, as `potclient.KernelSet.load` reads them
  pgm   occupancy in the plane and its YAML, for Nav2's map_server: 0 occupied, 254 free, 205 unknown
  bt    occupancy as a binary OctoMap: observed cells only

For pgm, --band says which heights matter to the robot; a map without height needs none.""",
        epilog="""examples:
  potclient export ply -o kernels.ply
  potclient export pgm --resolution 0.05 --band 0.1 1.5 -o map.pgm
  potclient export bt --resolution 0.2 --lower -20 -20 -1 --upper 20 20 4 -o map.bt""",
    )
    parser.add_argument("kind", choices=EXPORT_KINDS)
    add_export_flags(parser)
    parser.set_defaults(timeout=60.0)


def add_export_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that say what of a map goes into a file, and how; `export_map` reads them."""
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="file to write")
    _add_box_arguments(parser, "corner of the box (default: the map's)")
    parser.add_argument("--resolution", type=_positive, metavar="METRES", help="pgm, bt: cell edge")
    parser.add_argument(
        "--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help="pgm: heights that count, m"
    )
    parser.add_argument(
        "--occupied", type=float, metavar="P", help="occupied from here on (default: pgm 0.65, bt 0.5)"
    )
    parser.add_argument("--free", type=float, metavar="P", help="free below (default: pgm 0.25, bt 0.5)")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def _export(arguments: argparse.Namespace) -> int:
    check_export_flags(arguments)
    with _client(arguments) as client:
        return export_map(client, arguments)


def check_export_flags(arguments: argparse.Namespace) -> None:
    """Refuse flags that mean nothing for the kind of file, before anything is opened.

    Raises:
        UsageError: a flag is missing, or one too many.
    """
    is_grid = arguments.kind in ("pgm", "bt")
    if is_grid and arguments.resolution is None:
        raise UsageError(f"export {arguments.kind}: give --resolution METRES")
    grid_flags = (arguments.resolution, arguments.band, arguments.occupied, arguments.free)
    if not is_grid and any(flag is not None for flag in grid_flags):
        raise UsageError(f"export {arguments.kind}: kernels have no cells; only --lower and --upper apply")
    if arguments.kind == "bt" and arguments.band is not None:
        raise UsageError("export bt: --band is for pgm; give the heights with --lower and --upper")


def export_map(source: MapSource, arguments: argparse.Namespace) -> int:
    """Write a map as the flags want it, and say what was written."""
    from potclient import export

    with _part_bar(arguments.quiet) as progress:
        if arguments.kind in ("pgm", "bt"):
            box = _export_box(arguments, source)
            run = export.export_pgm if arguments.kind == "pgm" else export.export_bt
            thresholds = {"occupied_above": arguments.occupied, "free_below": arguments.free}
            given = {name: value for name, value in thresholds.items() if value is not None}
            done = run(source, arguments.out, box, progress=progress, **given)
        else:
            write = export.export_ply if arguments.kind == "ply" else export.export_npz
            done = write(
                source, arguments.out, lower=arguments.lower, upper=arguments.upper, progress=progress
            )
    what = {"ply": "kernels", "npz": "kernels", "pgm": "pixels", "bt": "voxels"}[arguments.kind]
    _say(f"wrote {arguments.out}: {done.n} {what}, revision {done.revisions[0] if done.revisions else 0}")
    if arguments.kind == "pgm":
        _say(f"wrote {arguments.out.with_suffix('.yaml')}")
    if len(done.revisions) > 1:
        _note(f"the map changed meanwhile: revisions {done.revisions[0]} to {done.revisions[-1]}")
    return EXIT_OK


def _export_box(arguments: argparse.Namespace, source: MapSource) -> Any:
    from potclient.export import CellBox, bounds_of

    lower, upper = arguments.lower, arguments.upper
    if lower is None or upper is None:
        low, high = bounds_of(source)
        lower = low.tolist() if lower is None else lower
        upper = high.tolist() if upper is None else upper
    if arguments.kind == "pgm":
        if arguments.band is None and lower[2] != upper[2]:
            raise UsageError(
                f"export pgm: the map spans {lower[2]:g} to {upper[2]:g} m in height; say with --band LOW HIGH which matter"
            )
        if arguments.band is not None:
            lower, upper = [*lower[:2], arguments.band[0]], [*upper[:2], arguments.band[1]]
    return CellBox.around(lower, upper, arguments.resolution)


@contextlib.contextmanager
def _part_bar(quiet: bool) -> Iterator[Callable[[int, int], None] | None]:
    """A progress bar of parts when stderr is a terminal."""
    progress = None if quiet or not sys.stderr.isatty() else _rich_progress(0, "parts")
    if progress is None:
        yield None
        return
    bar, task = progress
    with bar:
        yield lambda done, total: bar.update(task, completed=done, total=total)


# --- mirror --------------------------------------------------------------------------------------------------------


def _add_mirror(commands: Any) -> None:
    parser = _command(
        commands,
        "mirror",
        _mirror,
        help="keep a copy of the map, by what changes",
        description="""Fetch the map's kernels, then only the tiles that change, and print a line an update. Follows the map
until interrupted, or --seconds or --updates are over. When the server was restarted or the map cleared, all comes anew.

--mantissa-bits rounds the weights, which are most of the bytes: with 7 bits an update takes half of them and probabilities
move by up to a hundredth, with 10 bits two thirds and a thousandth.""",
        epilog="""examples:
  potclient mirror                               follow the whole map
  potclient mirror --once -o map.npz             the map as it is now; `potclient.KernelSet.load` reads it
  potclient mirror --lower -10 -10 -1 --upper 10 10 3 --json""",
    )
    _add_box_arguments(parser, "corner of the box to follow, m, map frame (default: all of the map)")
    parser.add_argument(
        "--mantissa-bits", type=int, metavar="N", help="of the weights, 2 to 23 (default: all)"
    )
    parser.add_argument("--once", action="store_true", help="fetch it once and stop")
    parser.add_argument(
        "--seconds", type=_positive, metavar="S", help="stop after S seconds (default: never)"
    )
    parser.add_argument("--updates", type=int, metavar="N", help="stop after N updates")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="at the end, save the kernels as an .npz"
    )


def _mirror(arguments: argparse.Namespace) -> int:
    if arguments.updates is not None and arguments.updates < 1:
        raise UsageError("--updates must be 1 or more")
    n_updates = 1 if arguments.once else arguments.updates
    until = None if arguments.seconds is None else time.monotonic() + arguments.seconds
    changed = threading.Event()
    with _client(arguments) as client:
        mirror = client.mirror(arguments.lower, arguments.upper, mantissa_bits=arguments.mantissa_bits)
        client.watch_revisions(lambda _: changed.set())
        try:
            for n, (update, took_s) in enumerate(_updates(mirror, changed, until), 1):
                _say_update(mirror, update, took_s, as_json=arguments.json)
                if n == n_updates:
                    break
        finally:  # when interrupted too
            if arguments.out is not None and mirror.revision is not None:
                mirror.kernels.save(arguments.out)
                _note(f"wrote {arguments.out}: {len(mirror.kernels)} kernels, revision {mirror.revision}")
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
            _note(f"{error}; trying again")
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
        _say(json.dumps(dataclasses.asdict(update) | took))
        return
    anew = ", all anew" if update.is_whole else ""
    _say(
        f"{time.strftime('%H:%M:%S')}  revision {update.revision}{anew}: {update.n_tiles} tiles and {update.n_kernels} kernels"
        f" came in {update.n_bytes} bytes, {update.n_removed} tiles gone, {took_s * 1e3:.0f} ms; {held_kernels} kernels in"
        f" {held_tiles} tiles"
    )


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
  potclient load --robots 8 --dataset town:downtown:dynamic
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
    parser.add_argument(
        "--dataset", default="generated", help="recording to send, e.g. town:suburb (default: generated)"
    )
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


# --- info, atoms, map ----------------------------------------------------------------------------------------------


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
        help="the dictionary of atoms: list, get, add, remove",
        description="""List the dictionary's atoms with how often each has served, fetch one whole, or change the dictionary.

A change counts for all maps of the server, from their next scan on. The server refuses atoms that are unsound or that it has
already, and says why. A file holds one atom; `potserver atoms export` takes them out of a dictionary.""",
        epilog="""examples:
  potclient atoms
  potclient atoms get terraces-180-s4 -o terraces-180-s4.atom
  potclient atoms add terraces-180-s4.atom corner.atom
  potclient atoms remove terraces-180-s4""",
    )
    parser.add_argument(
        "verb", nargs="?", choices=("list", "get", "add", "remove"), default="list", help="default: list"
    )
    parser.add_argument(
        "names", nargs="*", metavar="ID|FILE", help="an ID to get; FILEs to add; IDs to remove"
    )
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="get: save the atom (`potclient.Atom.load` reads it)"
    )
    _add_json_argument(parser)


def _atoms(arguments: argparse.Namespace) -> int:
    verb, names = arguments.verb, arguments.names
    if verb == "list" and names:
        raise UsageError(f"atoms: list takes no names; `potclient atoms get {names[0]}` shows one")
    if verb == "get" and len(names) != 1:
        raise UsageError("atoms: get needs one ID")
    if verb in ("add", "remove") and not names:
        raise UsageError(f"atoms: {verb} what? name {'FILEs' if verb == 'add' else 'IDs'}")
    if arguments.out is not None and verb != "get":
        raise UsageError("atoms: -o saves the atom that `get ID` fetches")
    if verb in ("add", "remove"):
        return _change_atoms(arguments)
    with _client(arguments) as client:
        if verb == "list":
            atoms = client.atoms()
        else:
            atom = client.atom(names[0])
            atoms = [atom.info]
            if arguments.out is not None:
                atom.save(arguments.out)
    _write_json(arguments.json, [_plain(atom) for atom in atoms])
    if arguments.json != "-":
        _say_atoms(atoms)
        if verb == "get":
            _say("\n".join(f"{key}: {value}" for key, value in sorted(atoms[0].provenance.items())))
    return EXIT_OK


def _change_atoms(arguments: argparse.Namespace) -> int:
    """Every file is read before the first atom is sent; the first refusal ends the command."""
    adds = arguments.verb == "add"
    done = "added" if adds else "removed"
    atoms = [Atom.load(name) for name in arguments.names] if adds else []
    changes = []
    with _client(arguments) as client:
        try:
            for change in map(client.add_atom, atoms) if adds else map(client.remove_atom, arguments.names):
                changes.append(change)
                kept = "saved" if change.persisted else "until the server restarts"
                if arguments.json != "-":
                    _say(f"{change.atom_id} {done}, {change.n_atoms} atoms, {kept}")
        finally:
            _write_json(arguments.json, [_plain(change) for change in changes])
    return EXIT_OK


def _say_atoms(atoms: list[messages.AtomInfo]) -> None:
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


def _add_map(commands: Any) -> None:
    parser = _command(
        commands,
        "map",
        _map,
        timeout_s=CONTROL_TIMEOUT_S,
        help=f"the map as a whole: {', '.join(CONTROL_VERBS)}",
        description="""Have the server save its map, load or merge a saved one, forget a robot or everything, or finish its
queue and take no more clouds. Each comes after all clouds that the server has taken before it.

What a server keeps survives its restarts by itself. `save NAME` makes a copy beside that, in the folder `saved` of the
server's store: `load NAME` puts it in the place of the present map, `merge NAME` adds what it knows.""",
        epilog="""examples:
  potclient map save                    write everything to the disk now
  potclient map save before-the-rain    and a copy with a name
  potclient map load before-the-rain    go back to it: what came since is gone
  potclient map merge north-wing --pose 12.5 -3.0 0 90
                                        take in what another server saved; its origin in our map: x y z m, yaw degrees
  potclient map forget rover-1          take out what one robot has seen
  potclient map clear                   forget everything
  potclient map drain                   before the server is replaced""",
    )
    parser.add_argument("verb", choices=CONTROL_VERBS, help="what to do")
    parser.add_argument(
        "name",
        nargs="?",
        metavar="NAME",
        help="of a saved map, for save, load and merge; of a robot, for forget",
    )
    add_pose_flag(parser)


def add_pose_flag(parser: argparse.ArgumentParser) -> None:
    """`--pose`, for maps that are merged."""
    parser.add_argument(
        "--pose",
        type=float,
        nargs=4,
        metavar=("X", "Y", "Z", "YAW"),
        help="merge: where the origin of the map that is taken in lies in the other, m, and by how many degrees it is turned",
    )


def _map(arguments: argparse.Namespace) -> int:
    verb, name = arguments.verb, arguments.name
    if verb in ("load", "merge") and name is None:
        raise UsageError(f"map: {verb} which? name a saved map")
    if verb == "forget" and name is None:
        raise UsageError("map: forget whom? name a robot; `map clear` forgets everything")
    if name is not None and verb in ("clear", "drain"):
        raise UsageError(f"map: {verb} takes no name")
    if arguments.pose is not None and verb != "merge":
        raise UsageError(f"map: {verb} takes no pose")
    with _client(arguments) as client:
        if verb == "forget":
            reply = client.forget(name, timeout_s=arguments.timeout)
        elif verb == "merge":
            pose = None if arguments.pose is None else pose_of(*arguments.pose)
            reply = client.merge(name, pose, timeout_s=arguments.timeout)
        else:
            reply = client.control(verb, name=name, timeout_s=arguments.timeout)
    _say(f"{reply.verb}: {reply.message} (revision {reply.map_revision})")
    return EXIT_OK


def pose_of(x_m: float, y_m: float, z_m: float, yaw_deg: float) -> NDArray[np.float64]:
    """(4, 4) transform of what `--pose` says."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, z_m], [0, 0, 0, 1]], np.float64)


# --- town ----------------------------------------------------------------------------------------------------------


def _add_town(commands: Any) -> None:
    parser = commands.add_parser(
        "town",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        help="write a drive through a made-up town",
        description="""Drive through a made-up town with a LiDAR model and write the scans, their poses and times, all settings
(recording.json) and a picture of the town (plan.png) into a new folder. No server is needed. Same options, same files.

STYLE:
  terraces   narrow streets of row houses close to the kerb, garden walls, cars parked on both sides
  suburb     detached houses set back behind lawns, hedges and trees, few cars
  downtown   large blocks of tall buildings on wide streets, arcades, open squares, rows of trees and poles
  offices    indoors: corridors, rooms with doors, desks, chairs and cupboards

Other commands take towns as they are, as the dataset town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED].""",
        epilog="""examples:
  potclient town terraces -o drive
  potclient town suburb --dynamic --length 300 --every 2 --max-range 25 -o drive
  potclient town offices --2d --seed 7 --length 100 --every 0.5 --sensor planar180 -o drive
  potclient publish drive                   play it into a map
  potclient publish town:terraces:300m      the same without files""",
    )
    parser.set_defaults(command=_town)
    parser.add_argument("style", metavar="STYLE")
    parser.add_argument("--2d", action="store_true", dest="planar", help="a planar scanner; z = 0")
    parser.add_argument(
        "--dynamic", action="store_true", help="cars (in offices: people) move, parked ones leave"
    )
    parser.add_argument("--seed", type=int, default=0, help="another town (default 0)")
    parser.add_argument(
        "--length", type=_positive, default=1000.0, metavar="METRES", help="of the drive (default 1000)"
    )
    parser.add_argument(
        "--every", type=_positive, metavar="METRES", help="distance of scans (default: all, ten a second)"
    )
    parser.add_argument(
        "--sensor",
        help="hdl64, vlp16, os64, planar360 or planar180 (default: hdl64; indoors os64; in 2D planar360)",
    )
    parser.add_argument(
        "--max-range",
        type=_positive,
        metavar="METRES",
        help="beams beyond are free up to here and have no echo",
    )
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FOLDER", help="new folder to write")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def _town(arguments: argparse.Namespace) -> int:
    from potclient.towns import PERIOD_S, TownName, open_town
    from potclient.towns.export import write_drive

    if arguments.seed < 0:
        raise UsageError(f"--seed {arguments.seed}: need 0 or more")
    words = ["town", arguments.style, *["2d"] * arguments.planar, *["dynamic"] * arguments.dynamic]
    words += [] if arguments.sensor is None else [arguments.sensor]
    name = TownName.parse(":".join([*words, f"{arguments.length:.6f}m", str(arguments.seed)]))
    recording = open_town(str(name), max_range_m=arguments.max_range)
    if arguments.every is not None:
        spacing = recording.town.style.speed_m_s * PERIOD_S
        recording = recording[:: max(1, round(arguments.every / spacing))]
    progress = None if arguments.quiet or not sys.stderr.isatty() else _rich_progress(len(recording))
    if progress is None:
        write_drive(recording, arguments.out)
    else:
        bar, task = progress
        with bar:
            write_drive(recording, arguments.out, on_scan=lambda: bar.advance(task))
    _say(
        f"{arguments.out}: {len(recording)} scans over {recording.town.drive.length_m:g} m; {'; '.join(recording.notes)}"
    )
    return EXIT_OK


# --- shared --------------------------------------------------------------------------------------------------------


def _command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    *,
    timeout_s: float = 10.0,
    **texts: str,
) -> Any:
    parser = commands.add_parser(name, formatter_class=argparse.RawDescriptionHelpFormatter, **texts)
    parser.set_defaults(command=run)
    group = parser.add_argument_group("server")
    group.add_argument("--map", default="default", metavar="ID", help="id of the map (default: default)")
    group.add_argument("--root", default=DEFAULT_ROOT, help=f"root of all keys (default {DEFAULT_ROOT})")
    group.add_argument(
        "--timeout",
        type=_positive,
        default=timeout_s,
        metavar="SECONDS",
        help=f"of one answer (default {timeout_s:g})",
    )
    add_zenoh_arguments(parser)
    return parser


def _add_json_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--json", metavar="FILE", help="write everything as JSON; - is stdout, instead of text"
    )


def _add_box_arguments(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--lower", type=float, nargs=3, metavar=("X", "Y", "Z"), help=text)
    parser.add_argument("--upper", type=float, nargs=3, metavar=("X", "Y", "Z"))


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
