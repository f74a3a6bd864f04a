"""Where rays through a kernel map end: occupancy as a hazard rate along each ray.

    hazard(r) = -ln(1 - p(r)) / width(r)      P(nothing met before r) = exp(-integral of the hazard from 0 to r)

p(r) is the predictive mean of the occupancy at range r. The width, in metres, is the length over which p counts as one trial: a
stretch of that length with constant p stops the ray with probability p. The answer therefore has a limit as the step goes to
zero; one independent trial a step would stop every ray at once.

Unless a width is given, a point takes the width of the kernels there: the mean over the kernels, weighted by their activation,
of sqrt(pi / (2 gamma)), the integral of a squared kernel along a line through its hinge. Points that share a kernel then count
as one trial together. Among multiples of 1 / sqrt(gamma) this one gave the least biased median ranges in made-up towns.

With p = sigmoid(z), -ln(1 - p) is softplus(z), which is exact near 0 and 1 too.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from potschemas.answers import (
    FREE_FROM,
    FREE_GAIN,
    OCCUPIED_FROM,
    OCCUPIED_GAIN,
    ROOM,
    ROOM_IN_SOLID,
    SURE,
    AnswerRule,
)
from potserver.numerics.arrays import Float64, Int64
from potserver.numerics.brick_map import BrickMap, BrickTable
from potserver.numerics.brick_sums import room_for_a_thread, sums_at
from potserver.numerics.fastexp import exp32, inner_loop
from potserver.numerics.gathering import kernels_that_reach
from potserver.numerics.kernel_index import KernelIndex
from potserver.numerics.lean import Lean, LeanTable, lean_of
from potserver.numerics.threads import parallel_map, spans

_END_OF_RAY = 1e-7  # survival below which a ray ends: the share by which a moment or a probability may be off
# Length of the stretch of a ray that shares a list of kernels, in reaches of a kernel; measured.
_BLOCK_REACHES = 3.0
_BLOCK_STEPS = (4, 128)  # the least and the most steps of such a stretch
_SMALL = 0.02  # below, series of the fifth degree are good to ten digits
_WIDTH_OF_NOTHING_M = 1.0  # width in a map without kernels


class Rays(NamedTuple):
    """N rays in the frame of the hinges."""

    origins: Float64  # (N, 3) m
    directions: Float64  # (N, 3) of unit length
    max_range_m: Float64  # (N,) m, > 0


class RayOptions(NamedTuple):
    """How rays are marched, and what they say."""

    step_m: float  # longest step
    quantiles: Float64  # (Q,) ascending, in (0, 1), of the range
    unknown_rate: float  # hazard of unobserved space, 1/m; infinite: it stops a ray at once
    # m, over which what is expected of unobserved space counts as one trial, where anything is; None: it does not count
    unknown_width_m: float | None
    width_m: float | None  # what counts as one trial, m; None: the kernels' own
    evidence_only: bool = False  # what is observed counts in full, whatever is expected there


class FirstReturns(NamedTuple):
    """The distribution of min(first return, maximum range) of N rays."""

    hit_probability: Float64  # (N,) of a return before the maximum range
    mean_m: Float64  # (N,)
    std_m: Float64  # (N,)
    quantile_m: Float64  # (N, Q)
    unknown_range_m: Float64  # (N,) where the ray first enters unobserved space; NaN: nowhere before it ends
    unknown_share: Float64  # (N,) of the ray's expected length, in unobserved space
    borrowed_share: Float64  # (N,) of it: the share of the answers there that is expected, and not evidence


class Widths(NamedTuple):
    """How wide kernels are: sqrt(pi / (2 gamma)), the integral of a squared kernel along a line through its hinge."""

    width_m: Float64  # (W,)
    n_kernels: Int64  # (W,) > 0, of each width

    def quantile(self, share: float) -> float:
        """Of all kernels; between two of them, in proportion."""
        order = np.argsort(self.width_m)
        ends = np.cumsum(self.n_kernels[order])
        place = share * (ends[-1] - 1)
        low, high = self.width_m[order][
            np.searchsorted(ends, [math.floor(place), math.ceil(place)], side="right")
        ]
        return float(low + (place - math.floor(place)) * (high - low))


def kernel_widths(index: KernelIndex) -> Float64:
    """(K,) m, in the index's order: see `Widths`."""
    return np.sqrt(0.5 * math.pi / -index.columns[0].astype(np.float64))


def widths_of(index: KernelIndex, bricks: BrickMap) -> Widths:
    """The widths of all kernels."""
    own, (shared, count) = kernel_widths(index), bricks.widths
    return Widths(np.concatenate([own, shared]), np.concatenate([np.ones(len(own), np.int64), count]))


def typical_width(widths: Widths) -> float:
    """The median width of the kernels, m: what counts as one trial where there are none."""
    return widths.quantile(0.5) if len(widths.n_kernels) else _WIDTH_OF_NOTHING_M


def fine_step(widths: Widths) -> float:
    """A step, m, that resolves nearly all kernels: a third of the width that one kernel in ten falls below.

    Few kernels of half that width, about hits of much detail, still get a step or two each.
    """
    return (1.0 / 3.0) * widths.quantile(0.1) if len(widths.n_kernels) else 1.0


def count_steps(max_range_m: Float64, step_m: float) -> Int64:
    """(N,) equal steps of at most `step_m` in which each ray is summed."""
    return np.maximum(np.ceil(max_range_m / step_m - 1e-9), 1.0).astype(np.int64)


def first_returns(
    index: KernelIndex,
    bricks: BrickMap,
    rays: Rays,
    options: RayOptions,
    rule: AnswerRule,
    *,
    lean: Lean | None = None,
    threads: int = 1,
) -> FirstReturns:
    """March rays by the midpoint rule, whose error falls with the square of the step.

    Of the index, only the kernels that reach a stretch of a ray (see `kernel_index.reach`) are summed there.

    Args:
        index: The kernels that stand on no lattice.
        bricks: All others.
        rays: Where to look.
        options: How.
        rule: How sums over kernels become an occupancy.
        lean: What the sums are added to.
        threads: Threads to spread the rays over.
    """
    # copies: the march is compiled for writable arrays, and arrays that were received are read-only
    rays = Rays(*(np.array(a, np.float64, order="C") for a in rays))
    n = len(rays.origins)
    out = np.zeros((6, n))
    quantile_m = np.zeros((n, len(options.quantiles)))
    n_steps = count_steps(rays.max_range_m, options.step_m)
    widths = kernel_widths(index).astype(np.float32)
    block = int(np.clip(_BLOCK_REACHES * index.median_reach_m / options.step_m, *_BLOCK_STEPS))
    march = _March(
        bricks=bricks.table,
        thresholds=-np.log1p(-np.asarray(options.quantiles, np.float64)),
        unknown_rate=float(options.unknown_rate),
        unknown_width_m=-1.0 if options.unknown_width_m is None else float(options.unknown_width_m),
        fixed_width_m=-1.0 if options.width_m is None else float(options.width_m),
        observed_activation=float(rule.observed_activation),
        residual_var=float(rule.residual_var),
        mean_moderation=float(rule.mean_moderation),
        full_activation=float(rule.full_activation),
        evidence_only=options.evidence_only,
        lean=(lean or Lean(1.0, {})).table,
    )

    def run(span: tuple[int, int]) -> None:
        _march(*span, rays, n_steps, block, march, index, widths, room_for_a_thread(), out, quantile_m)

    parallel_map(run, spans(n, 8 * threads if threads > 1 else 1), threads, "query")
    return FirstReturns(out[0], out[1], out[2], quantile_m, *out[3:])


class _March(NamedTuple):
    """What the compiled march needs to sum, and to turn sums into ranges."""

    bricks: BrickTable
    thresholds: Float64  # (Q,) hazard integrals at which the quantiles lie
    unknown_rate: float  # 1/m
    unknown_width_m: float  # negative: what is expected of unobserved space does not count
    fixed_width_m: float  # negative: the kernels' own
    observed_activation: float
    residual_var: float  # log-odds^2
    mean_moderation: float
    full_activation: float
    evidence_only: bool
    lean: LeanTable


@nb.njit(error_model="numpy", cache=True)
def moderated(
    mean: float, var: float, activation: float, residual_var: float, mean_moderation: float
) -> float:
    """z of the occupancy sigmoid(z) of sums at an observed point, without a lean: `potschemas.answers`, for one point."""
    s2 = var + residual_var * max(1.0 - activation, 0.0)
    return mean / math.sqrt(1.0 + mean_moderation * math.pi / 8.0 * s2)


@nb.njit(error_model="numpy", cache=True)
def ended(z: float, activation: float, full_activation: float, lean: float) -> float:
    """z of an observed point where log-odds end, if they do: `potschemas.answers`, for one point; `lean` may be NaN."""
    if full_activation == 0.0:
        return z
    density = activation / full_activation
    if not math.isnan(lean):
        z = max(z, min(lean, -(SURE + FREE_GAIN * max(density - FREE_FROM, 0.0))))
    return min(z, SURE + OCCUPIED_GAIN * max(density - OCCUPIED_FROM, 0.0))


@nb.njit(error_model="numpy", cache=True)
def _softplus(z: float) -> float:
    e = math.exp(-abs(z))
    # the series where it is as good: most of a ray is free, and the logarithm would take as long as a lattice
    small = e * (1 - e * (1 / 2 - e * (1 / 3 - e * (1 / 4 - e * (1 / 5 - e / 6)))))
    return max(z, 0.0) + (small if e < _SMALL else math.log1p(e))


@nb.njit(error_model="numpy", cache=True)
def _step(rate: float, h: float) -> tuple[float, float, float]:
    """With q = rate h: 1 - exp(-q), and the integrals of exp(-rate t) and of t exp(-rate t) over t from 0 to h."""
    q = rate * h
    if q < _SMALL:  # the series, where the formulas would lose their digits
        piece = h * (1 - q * (1 / 2 - q * (1 / 6 - q * (1 / 24 - q / 120))))
        return rate * piece, piece, h * h * (1 / 2 - q * (1 / 3 - q * (1 / 8 - q * (1 / 30 - q / 144))))
    stopped = -math.expm1(-q)
    return stopped, stopped / rate, (stopped - q * (1.0 - stopped)) / (rate * rate)


@inner_loop
def _sum_at(t, along, across2, minus_gamma, w, v, width, known, n):
    mean = np.float32(0)
    var = np.float32(0)
    activation = np.float32(0)
    weighted = np.float32(0)
    for m in range(n):
        d = t - along[m]
        phi = exp32(minus_gamma[m] * (across2[m] + d * d))
        mean += w[m] * phi
        var += v[m] * phi * phi
        activation += known[m] * phi
        weighted += width[m] * known[m] * phi
    return mean, var, activation, weighted


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _march(first, last, rays, n_steps, block, march, index, widths, room, out, quantile_m):
    origins, directions, max_range_m = rays
    hinge, columns, thresholds = index.hinge, index.columns, march.thresholds
    found = np.empty(4096, np.int64)
    local = np.empty((7, 4096), np.float32)
    lower, upper, middle = np.empty(3), np.empty(3), np.empty(3)
    for i in range(first, last):
        h = max_range_m[i] / n_steps[i]
        hazard = 0.0  # its integral so far
        survival = 1.0
        length = 0.0  # integral of the survival: the mean
        moment = 0.0  # integral of range times survival: half the second moment
        unknown_length, borrowed_length = 0.0, 0.0
        unknown_range = np.nan
        k = 0  # the next quantile
        step = 0
        n = 0
        centre = 0.0
        while step < n_steps[i] and survival >= _END_OF_RAY:
            if step % block == 0 and len(hinge):
                stop = min(step + block, n_steps[i])
                half = 0.5 * (stop - step) * h
                centre = step * h + half
                for c in range(3):
                    middle[c] = origins[i, c] + centre * directions[i, c]
                    lower[c] = middle[c] - half * abs(directions[i, c])
                    upper[c] = middle[c] + half * abs(directions[i, c])
                n_found, found = kernels_that_reach(index, lower, upper, found)
                if n_found > local.shape[1]:
                    local = np.empty((7, 2 * n_found), np.float32)
                n = 0
                for j in range(n_found):
                    m = found[j]
                    d2 = 0.0
                    along = 0.0
                    for c in range(3):
                        d = hinge[m, c] - middle[c]
                        d2 += d * d
                        along += d * directions[i, c]
                    across2 = max(d2 - along * along, 0.0)
                    beyond = max(abs(along) - half, 0.0)
                    if across2 + beyond * beyond <= columns[3, m] * columns[3, m]:
                        local[0, n] = along
                        local[1, n] = across2
                        local[2, n] = columns[0, m]
                        local[3, n] = columns[1, m]
                        local[4, n] = columns[2, m]
                        local[5, n] = widths[m]
                        local[6, n] = columns[4, m]
                        n += 1
            r = step * h
            step += 1
            mean, var, activation, weighted = sums_at(
                march.bricks,
                origins[i, 0] + (r + 0.5 * h) * directions[i, 0],
                origins[i, 1] + (r + 0.5 * h) * directions[i, 1],
                origins[i, 2] + (r + 0.5 * h) * directions[i, 2],
                room.ctypes.data,
            )
            if n > 0:
                more = _sum_at(
                    np.float32(r + 0.5 * h - centre), local[0], local[1], local[2], local[3], local[4], local[5], local[6],
                    n,
                )  # fmt: skip
                mean, var, activation, weighted = (
                    mean + more[0],
                    var + more[1],
                    activation + more[2],
                    weighted + more[3],
                )
            lean = lean_of(
                march.lean,
                origins[i, 0] + (r + 0.5 * h) * directions[i, 0],
                origins[i, 1] + (r + 0.5 * h) * directions[i, 1],
                origins[i, 2] + (r + 0.5 * h) * directions[i, 2],
            )
            borrowed = 0.0
            if activation > 0.0 and activation >= march.observed_activation:
                is_known = True
                width = march.fixed_width_m if march.fixed_width_m > 0 else weighted / activation
                z = moderated(mean, var, activation, march.residual_var, march.mean_moderation)
                if not math.isnan(lean):
                    if not march.evidence_only:
                        solid = min(max(lean, 0.0), 1.0) if mean < 0.0 else 0.0
                        full = ROOM + (ROOM_IN_SOLID - ROOM) * solid
                        borrowed = 1.0 - min((activation - march.observed_activation) / full, 1.0)
                    z = lean + (1.0 - borrowed) * z
                z = ended(z, activation, march.full_activation, lean)
                rate = _softplus(z) / width
            else:
                is_known = False
                rate = march.unknown_rate
                if march.unknown_width_m > 0 and not math.isnan(lean):
                    rate = _softplus(lean) / march.unknown_width_m
                    borrowed = 1.0
                if math.isnan(unknown_range):
                    unknown_range = r
            if rate == np.inf:
                hazard = np.inf
                survival = 0.0
                while k < len(thresholds):
                    quantile_m[i, k] = r
                    k += 1
                break
            passed = rate * h
            while k < len(thresholds) and hazard + passed >= thresholds[k]:
                quantile_m[i, k] = r + (thresholds[k] - hazard) / rate
                k += 1
            stopped, piece, inner = _step(rate, h)
            length += survival * piece
            moment += survival * (r * piece + inner)
            borrowed_length += borrowed * survival * piece
            if not is_known:
                unknown_length += survival * piece
            hazard += passed
            survival *= 1.0 - stopped
        while k < len(thresholds):
            quantile_m[i, k] = max_range_m[i]
            k += 1
        out[0, i] = -math.expm1(-hazard)
        out[1, i] = length
        out[2, i] = math.sqrt(max(2.0 * moment - length * length, 0.0))
        out[3, i] = unknown_range
        if length > 0.0:
            out[4, i] = unknown_length / length
            out[5, i] = borrowed_length / length
        else:  # it begins in unobserved space that stops it
            out[4, i] = 1.0
