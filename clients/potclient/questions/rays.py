"""`q/rays`: where rays first return."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from potclient.arguments import as_points, positive, positive_or_none, unknown_kind
from potclient.arrays import Float32, arrays_of
from potclient.errors import TooLargeError, UsageError
from potclient.link import Link
from potschemas import messages
from potschemas.wire import encode_array

_CHUNK_RAYS = 20_000  # rays a question at most
_FIELDS = ("hit_probability", "mean_m", "std_m", "unknown_range_m", "unknown_share")


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Rays:
    """The distribution of min(first return, maximum range) of N rays, in the order asked; ranges from the origins."""

    hit_probability: Float32  # (N,) of a return before the maximum range
    mean_m: Float32  # (N,) expected range
    std_m: Float32  # (N,) its standard deviation
    quantile_m: Float32  # (N, Q); the maximum range, where a return before it is too unlikely
    unknown_range_m: Float32  # (N,) where the ray first enters unobserved space; NaN: nowhere before it ends
    unknown_share: Float32  # (N,) of the ray's expected length, in unobserved space
    borrowed_share: Float32  # (N,) of it: the share of the answers there that is expected, and not evidence
    quantiles: tuple[float, ...]  # the Q that were asked for
    step_m: float  # the longest step that was taken
    revisions: tuple[int, ...] = (0,)  # as in `Occupancy`

    def __len__(self) -> int:
        return len(self.mean_m)

    @property
    def revision(self) -> int:
        """The oldest map revision that answered a part of the request."""
        return self.revisions[0]

    @classmethod
    def from_message(cls, message: messages.Rays, n: int, quantiles: tuple[float, ...]) -> Rays:
        """The answer in a message.

        Raises:
            BadReplyError: it does not hold n answers of the promised dtypes.
        """
        shapes = dict.fromkeys(_FIELDS, (n,)) | {"quantile_m": (n, len(quantiles))}
        borrowed = np.zeros(n, np.float32)
        if message.borrowed_share is not messages.ABSENT:
            borrowed = arrays_of(message, "rays", {"borrowed_share": (n,)})["borrowed_share"]
        return cls(
            **arrays_of(message, "rays", shapes),
            borrowed_share=borrowed,
            quantiles=quantiles,
            step_m=message.step_m,
            revisions=(message.map_revision,),
        )

    @staticmethod
    def concatenate(parts: list[Rays]) -> Rays:
        """All answers in order, all revisions that gave them, and the longest step."""
        names = (*_FIELDS, "quantile_m", "borrowed_share")
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        return Rays(
            **arrays,
            quantiles=parts[0].quantiles,
            step_m=max(p.step_m for p in parts),
            revisions=tuple(sorted({r for p in parts for r in p.revisions})),
        )


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RayOptions:
    """How rays are answered, see `MapClient.rays`."""

    max_range_m: float
    quantiles: Sequence[float]
    unknown: messages.Unknown | str
    evidence_only: bool
    width_m: float | None = None
    step_m: float | None = None


def rays(
    link: Link, origins: ArrayLike, directions: ArrayLike, options: RayOptions, timeout_s: float | None
) -> Rays:
    """See `MapClient.rays`."""
    ways, starts = as_points(directions), as_points(origins)
    if len(starts) == 1:
        starts = np.broadcast_to(starts, ways.shape)
    if len(starts) != len(ways):
        raise UsageError(f"rays: {len(starts)} origins and {len(ways)} directions")
    levels = tuple(float(q) for q in options.quantiles)
    if not all(a < b for a, b in itertools.pairwise((0.0, *levels, 1.0))):
        raise UsageError(f"quantiles {list(levels)}: need ascending numbers between 0 and 1")
    request = messages.RaysQuery(
        origins=encode_array(np.zeros((0, 3))),
        directions=encode_array(np.zeros((0, 3))),
        max_range_m=positive(options.max_range_m, "max_range_m"),
        quantiles=list(levels),
        unknown=unknown_kind(options.unknown),
        width_m=positive_or_none(options.width_m, "width_m"),
        step_m=positive_or_none(options.step_m, "step_m"),
        deadline_ms=link.deadline_ms(timeout_s),
        evidence_only=True if options.evidence_only else messages.ABSENT,
    )
    parts: list[Rays] = []
    first, step = 0, min(max(len(ways), 1), _CHUNK_RAYS)
    while first < len(ways) or not parts:
        run = slice(first, first + step)
        n = len(ways[run])
        request = msgspec.structs.replace(
            request,
            origins=encode_array(np.ascontiguousarray(starts[run])),
            directions=encode_array(ways[run].astype(np.float32)),
        )
        try:
            reply = link.ask(link.keys.query("rays"), request, messages.Rays, timeout_s)
        except TooLargeError:
            if n <= 1:
                raise
            step = n // 2
            continue
        parts.append(Rays.from_message(reply, n, levels))
        first += step
    return Rays.concatenate(parts)
