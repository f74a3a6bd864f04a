"""`potclient query`: occupancy at points."""

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
    client_of,
    read_table,
    say,
    say_rows,
    write_json,
)
from potclient.errors import UsageError
from potclient.files import save_npz

_SHOWN = 20  # answers in the table


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "query",
        run,
        help="occupancy and its uncertainty at points",
        description="""Ask how likely points are occupied. Each answer has the probability, its standard deviation, the latent
log-odds with theirs, whether the map has seen anything near, and which share of it is borrowed: expected, not seen.""",
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
    add_evidence_only_argument(parser)
    parser.add_argument("-o", "--out", type=output_file, metavar="FILE", help="write all answers to an .npz")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    points = _query_points(arguments)
    with client_of(arguments) as client:
        answer = client.occupancy(
            points, with_gradient=arguments.gradient, evidence_only=arguments.evidence_only
        )
    names = ["mean", "var", "latent_mean", "latent_var", "observed", "borrowed"]
    names += ["gradient", "latent_gradient"] if arguments.gradient else []
    if arguments.out is not None:
        save_npz(
            arguments.out,
            points=points,
            revision=np.int64(answer.revision),
            **{name: getattr(answer, name) for name in names},
        )
    write_json(
        arguments.json,
        {
            "revision": answer.revision,
            "points": points.tolist(),
            **{name: getattr(answer, name).tolist() for name in names},
        },
    )
    if arguments.json == "-":
        return EXIT_OK
    rows = [
        [
            *[f"{c:.3f}" for c in points[i]],
            f"{answer.mean[i]:.4f}",
            f"{math.sqrt(answer.var[i]):.4f}",
            f"{answer.latent_mean[i]:+.3f}",
            f"{math.sqrt(answer.latent_var[i]):.3f}",
            "yes" if answer.observed[i] else "no",
            f"{answer.borrowed[i]:.2f}",
            *([] if answer.gradient is None else [f"{g:+.4f}" for g in answer.gradient[i]]),
        ]
        for i in range(min(len(points), _SHOWN))
    ]
    heads = [
        *["x", "y", "z"][: points.shape[1]],
        "P(occupied)",
        "std",
        "log-odds",
        "std",
        "observed",
        "borrowed",
    ]
    heads += ["dP/dx 1/m", "dP/dy", "dP/dz"] if arguments.gradient else []
    say_rows(heads, rows, len(points), "-o FILE or --json FILE")
    say(
        f"map revision {answer.revision}, {float(answer.observed.mean()):.1%} of {len(points)} points observed"
    )
    return EXIT_OK


def _query_points(arguments: argparse.Namespace) -> Float64:
    if (arguments.file is None) == (not arguments.coordinates):
        raise UsageError("query: give coordinates X Y Z ..., or --file, and not both")
    if arguments.file is None:
        if len(arguments.coordinates) % 3:
            raise UsageError(f"query: {len(arguments.coordinates)} coordinates are not whole points of X Y Z")
        return np.asarray(arguments.coordinates, np.float64).reshape(-1, 3)
    return read_table(arguments.file, (2, 3), "points")
