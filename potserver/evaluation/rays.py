"""What maps of kernels say about where held-out beams end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potclient.arrays import Float64
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Unknown
from potserver.evaluation.beams import Beams

_RAYS, _RAYS_AT_A_TIME = 4_000, 500  # of each kind, drawn from the held-out beams


class RayScores(NamedTuple):
    """What a map says about where held-out beams end. NaN where there is no beam of the kind."""

    false_return: float  # mean predicted probability that a beam without an echo returns within its length
    range_error_m: float  # median |expected - measured range| of beams with an echo
    n_free: int
    n_returns: int


def score_rays(kernel_map: KernelMap, beams: Beams) -> RayScores:
    """Ask a map where held-out beams first return."""
    rng = np.random.default_rng(0)
    returned = beams.drawn(beams.is_return, _RAYS, rng)
    free = beams.drawn(~beams.is_return, _RAYS, rng)
    reach_m = float(beams.lengths.max())
    return RayScores(
        false_return=_mean(_first_returns(kernel_map, free, reach_m)[0]),
        range_error_m=_median(np.abs(_first_returns(kernel_map, returned, reach_m)[1] - returned.lengths)),
        n_free=len(free.ends),
        n_returns=len(returned.ends),
    )


def _first_returns(kernel_map: KernelMap, beams: Beams, reach_m: float) -> tuple[Float64, Float64]:
    """(N,) probability of a return within a beam's length (with an echo: within `reach_m`), and (N,) m, the expected range."""
    length = beams.lengths
    probability, mean_m = np.zeros(len(length)), np.zeros(len(length))
    for start in range(0, len(length), _RAYS_AT_A_TIME):
        part = slice(start, start + _RAYS_AT_A_TIME)
        ends = kernel_map.first_returns(
            np.ascontiguousarray(beams.origins[part]),
            (beams.ends[part] - beams.origins[part]) / length[part, None],
            np.where(beams.is_return[part], reach_m, length[part]),
            step_m=kernel_map.fine_step_m,
            quantiles=np.zeros(0),
            unknown=Unknown.PRIOR,
            width_m=None,
        )
        probability[part], mean_m[part] = ends.hit_probability, ends.mean_m
    return probability, mean_m


def _mean(values: Float64) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _median(values: Float64) -> float:
    return float(np.median(values)) if len(values) else float("nan")
