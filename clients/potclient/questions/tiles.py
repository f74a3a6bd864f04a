"""`q/tiles`: a mirror of the map, and how it asks for what changed."""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec
from numpy.typing import ArrayLike

from potclient.arguments import corner
from potclient.errors import UsageError
from potclient.link import Link, decoded
from potclient.mirror import MapMirror
from potschemas.messages import TilesPart, TilesQuery

MIRROR_STEP = 0.0625  # log-odds: a probability is off by .001 on average
MIRROR_MARGIN_M = 4.0  # kernels of the coarsest maps are 1 m apart, and say nothing any more at 2.5 m


def mirror(
    link: Link,
    lower: ArrayLike | None,
    upper: ArrayLike | None,
    *,
    margin_m: float,
    step: float | None,
    timeout_s: float | None,
) -> MapMirror:
    """See `MapClient.mirror`."""
    if (lower is None) != (upper is None):
        raise UsageError("mirror: give both corners, or neither for the whole map")
    if not (math.isfinite(margin_m) and margin_m >= 0):
        raise UsageError(f"margin_m is {margin_m}, need 0 or a positive number of metres")
    if step is not None and not 1e-4 <= step <= 10.0:
        raise UsageError(f"step is {step}, need 0.0001 to 10 log-odds, or None")
    box = {}
    if lower is not None and upper is not None:
        low, high = corner(lower, "lower"), corner(upper, "upper")
        if (high < low).any():
            raise UsageError(f"mirror: lower {low.tolist()} must not be above upper {high.tolist()}")
        box = {"lower": (low - margin_m).tolist(), "upper": (high + margin_m).tolist()}

    def ask(query: TilesQuery) -> Iterator[tuple[TilesPart, int]]:
        query = msgspec.structs.replace(query, deadline_ms=link.deadline_ms(timeout_s))
        for sample in link.samples(link.keys.query("tiles"), query, timeout_s):
            yield decoded(sample.payload, TilesPart), len(sample.payload)

    return MapMirror(ask, **box, step=step)
