"""`potclient rays`: how far rays get."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np

from potclient.arrays import Float64
from potclient.commands.output_files import output_file
from potclient.commands.shared import (
    EXIT_OK,
    add_command,
    add_evidence_only_argument,
    add_json_argument,
    add_unknown_argument,
    client_of,
    positive,
    read_table,
    say,
    say_rows,
    write_json,
)
from potclient.errors import UsageError
from potclient.files import save_npz
from potclient.questions.rays import Rays

_ARRAYS = (
    "hit_probability",
    "mean_m",
    "std_m",
    "quantile_m",
    "unknown_range_m",
    "unknown_share",
    "borrowed_share",
)
_SHOWN = 40  # answers in the table


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "rays",
        run,
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
        "--max-range", type=positive, default=25.0, metavar="METRES", help="of the rays (default 25)"
    )
    parser.add_argument(
        "--quantiles", type=float, nargs="+", default=[0.05, 0.5, 0.95], metavar="Q", help="ascending"
    )
    add_unknown_argument(parser, "prior")
    add_evidence_only_argument(parser)
    parser.add_argument(
        "--width", type=positive, metavar="METRES", help="over which P is one trial (default: the kernels')"
    )
    parser.add_argument("--step", type=positive, metavar="METRES", help="of the summation (default: fine)")
    parser.add_argument("-o", "--out", type=output_file, metavar="FILE", help="write all answers to an .npz")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    origins, directions = _ray_arguments(arguments)
    with client_of(arguments) as client:
        answer = client.rays(
            origins,
            directions,
            arguments.max_range,
            quantiles=arguments.quantiles,
            unknown=arguments.unknown,
            width_m=arguments.width,
            step_m=arguments.step,
            evidence_only=arguments.evidence_only,
        )
    arrays = {name: getattr(answer, name) for name in _ARRAYS}
    if arguments.out is not None:
        save_npz(
            arguments.out,
            origins=origins,
            directions=directions,
            quantiles=np.asarray(answer.quantiles),
            revision=np.int64(answer.revision),
            **arrays,
        )
    write_json(
        arguments.json,
        {
            "revision": answer.revision,
            "step_m": answer.step_m,
            "quantiles": answer.quantiles,
            "directions": directions.tolist(),
            **{name: array.tolist() for name, array in arrays.items()},
        },
    )
    if arguments.json != "-":
        _say_rays(answer, directions)
    return EXIT_OK


def _say_rays(answer: Rays, directions: Float64) -> None:
    rows = [
        [
            *[f"{c:+.3f}" for c in directions[i]],
            f"{answer.hit_probability[i]:.4f}",
            f"{answer.mean_m[i]:.3f}",
            f"{answer.std_m[i]:.3f}",
            *[f"{q:.3f}" for q in answer.quantile_m[i]],
            "-" if math.isnan(answer.unknown_range_m[i]) else f"{answer.unknown_range_m[i]:.3f}",
            f"{answer.unknown_share[i]:.1%}",
            f"{answer.borrowed_share[i]:.1%}",
        ]
        for i in range(min(len(answer), _SHOWN))
    ]
    heads = ["dx", "dy", "dz", "P(return)", "mean m", "std m", *[f"q{q:g} m" for q in answer.quantiles]]
    say_rows([*heads, "unknown from m", "unknown", "borrowed"], rows, len(answer), "-o FILE or --json FILE")
    say(f"map revision {answer.revision}, steps of {answer.step_m:.3g} m")


def _ray_arguments(arguments: argparse.Namespace) -> tuple[Float64, Float64]:
    """Origins and directions, (N, 3) each."""
    if (arguments.file is None) == (not arguments.origin):
        raise UsageError("rays: give the origin X Y Z, or --file, and not both")
    if arguments.file is not None:
        table = read_table(arguments.file, (6,), "rays, as rows of origin and direction")
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
