"""exp32 against numpy in float64."""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.fastexp import exp32


@nb.njit
def _over(values):
    out = np.empty_like(values)
    for i in range(len(values)):
        out[i] = exp32(values[i])
    return out


def test_relative_error_is_that_of_float32() -> None:
    x = np.linspace(-86.9, 87.9, 2_000_003, dtype=np.float32)
    truth = np.exp(x.astype(np.float64))
    assert np.abs(_over(x) / truth - 1.0).max() < 3e-7


def test_one_at_zero_and_both_zeros_alike() -> None:
    np.testing.assert_array_equal(_over(np.array([0.0, -0.0], np.float32)), 1.0)


def test_far_below_is_exactly_zero_and_far_above_is_finite() -> None:
    low = _over(np.array([-87.0, -87.1, -1e4, -3e38, -np.inf], np.float32))
    np.testing.assert_array_equal(low, 0.0)
    high = _over(np.array([88.0, 100.0, 3e38], np.float32))
    np.testing.assert_allclose(high, np.exp(88.0), rtol=1e-6)


def test_never_falls_where_the_argument_rises() -> None:
    values = _over(np.linspace(-87.5, -80.0, 100_001, dtype=np.float32))
    assert (np.diff(values) >= -3e-7 * values[1:]).all()
