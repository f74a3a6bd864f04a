"""How fine a map may be where a beam ends: as fine as the beams around it lie close.

Beams are counted as directions, in bins of several sizes. A beam's spacing is the least size at which the bins around its own
have beams too. So rings that lie apart make a spacing of that between rings, however closely beams follow each other in one.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float64, UInt8

_FINEST_RAD = 2.0 * np.pi / 2048  # bins, less than the beams of any scan lie apart on average
_SIZES = 5  # of bins, each twice as large; beams that lie farther apart than the largest show no detail
_ENOUGH, _ENOUGH_IN_PLANE = 6, 2  # of the nine (three) bins at and around a beam's: a border has no more


def angles_between(ends: Float64, *, planar: bool) -> Float64:
    """(B,) rad between each beam and those around it; infinite where it has none.

    Args:
        ends: (B, 3) m, relative to the beams' start.
        planar: All beams lie in one plane.
    """
    return np.asarray(_angles(ends, planar), np.float64)


def scales_of(least_m: Float64, resolution_m: float, n_scales: int) -> UInt8:
    """(N,) how often the resolution may be halved to stay at such lengths, m, or above, up to `n_scales` - 1."""
    finest_m = resolution_m / 2 ** (n_scales - 1)
    return np.floor(np.log2(resolution_m / np.clip(least_m, finest_m, resolution_m))).astype(np.uint8)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _angles(ends, planar):
    across = np.int64(round(2.0 * np.pi / _FINEST_RAD))
    up = np.int64(1) if planar else across // 2
    n = len(ends)
    row, column = np.empty(n, np.int64), np.zeros(n, np.int64)
    full = np.zeros((_SIZES, across, up), np.bool_)
    for b in range(n):
        x, y, z = ends[b]
        length = np.sqrt(x * x + y * y + z * z)
        row[b] = min(np.int64((np.arctan2(y, x) + np.pi) / _FINEST_RAD), across - 1)
        if not planar:
            column[b] = min(
                np.int64((np.arcsin(max(min(z / length, 1.0), -1.0)) + 0.5 * np.pi) / _FINEST_RAD), up - 1
            )
        for size in range(_SIZES):
            full[size, row[b] >> size, column[b] >> size] = True
    out = np.full(n, np.inf)
    enough = _ENOUGH_IN_PLANE if planar else _ENOUGH
    for b in range(n):
        for size in range(_SIZES):
            n_full = _n_full(full[size], row[b] >> size, column[b] >> size, across >> size, planar)
            if n_full >= enough:
                out[b] = _FINEST_RAD * (1 << size) * (1 if n_full > enough else 2)
                break
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _n_full(flags, row, column, across, planar):
    n = 0
    for dr in range(-1, 2):
        r = (row + dr) % across
        for dc in range(1 if planar else 3):
            c = column + (0 if planar else dc - 1)
            if 0 <= c < flags.shape[1] and flags[r, c]:
                n += 1
    return n
