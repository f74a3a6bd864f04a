"""`q/risk`: how likely a robot on a path touches something."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from potclient.arguments import numbers, positive_or_none, unknown_kind
from potclient.arrays import Float32, arrays_of
from potclient.errors import UsageError
from potclient.link import Link
from potschemas import messages
from potschemas.wire import encode_array


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Risk:
    """How likely a robot on P poses touches something, by the cells of a lattice that it covers."""

    max_probability: Float32  # (P,) of the likeliest cell: all cells are one trial
    union_probability: Float32  # (P,) that any cell is occupied: cells further apart are independent
    unknown_share: Float32  # (P,) of its cells, unobserved
    borrowed_share: Float32  # (P,) of what its cells are taken for: what is expected there, and not evidence
    path_max_probability: float
    path_union_probability: float  # every cell of the swept volume counted once
    path_unknown_share: float
    path_borrowed_share: float
    n_cells: int  # of the swept volume
    resolution_m: float  # edge of a cell
    revision: int

    @classmethod
    def from_message(cls, message: messages.Risk, n: int) -> Risk:
        """The answer in a message.

        Raises:
            BadReplyError: it does not hold n answers of the promised dtypes.
        """
        names = ("max_probability", "union_probability", "unknown_share")
        borrowed, of_path = np.zeros(n, np.float32), message.path_borrowed_share
        if message.borrowed_share is not messages.ABSENT:
            borrowed = arrays_of(message, "risk", {"borrowed_share": (n,)})["borrowed_share"]
        return cls(
            **arrays_of(message, "risk", dict.fromkeys(names, (n,))),
            borrowed_share=borrowed,
            path_max_probability=message.path_max_probability,
            path_union_probability=message.path_union_probability,
            path_unknown_share=message.path_unknown_share,
            path_borrowed_share=0.0 if of_path is messages.ABSENT else of_path,
            n_cells=message.n_cells,
            resolution_m=message.resolution_m,
            revision=message.map_revision,
        )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RiskOptions:
    """How a risk is answered, see `MapClient.risk`."""

    unknown: messages.Unknown | str
    resolution_m: float | None
    correlation_m: float | None
    dims: int
    evidence_only: bool


def risk(
    link: Link, path: ArrayLike, spheres: ArrayLike, options: RiskOptions, timeout_s: float | None
) -> Risk:
    """See `MapClient.risk`."""
    poses, balls = numbers(path, "path"), numbers(spheres, "spheres")
    poses = poses[None] if poses.ndim == 2 else poses
    balls = balls[None] if balls.ndim == 1 else balls
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise UsageError(f"risk: path has shape {poses.shape}, need (P, 4, 4)")
    if balls.ndim != 2 or balls.shape[1] != 4:
        raise UsageError(f"risk: spheres have shape {balls.shape}, need (S, 4): x y z radius")
    if options.dims not in (2, 3):
        raise UsageError(f"risk: dims is {options.dims}, need 2 or 3")
    request = messages.RiskQuery(
        path=encode_array(np.ascontiguousarray(poses)),
        spheres=encode_array(np.ascontiguousarray(balls)),
        unknown=unknown_kind(options.unknown),
        resolution_m=positive_or_none(options.resolution_m, "resolution_m"),
        correlation_m=positive_or_none(options.correlation_m, "correlation_m"),
        dims=options.dims,
        deadline_ms=link.deadline_ms(timeout_s),
        evidence_only=True if options.evidence_only else messages.ABSENT,
    )
    return Risk.from_message(link.ask(link.keys.query("risk"), request, messages.Risk, timeout_s), len(poses))
