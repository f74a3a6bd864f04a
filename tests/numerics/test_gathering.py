"""The search for kernels that reach a box, against a look at every kernel."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.gathering import kernels_around, kernels_that_reach
from potserver.numerics.kernel_index import KernelIndex, build_index


def _index(widths: tuple[float, float], n: int = 600) -> KernelIndex:
    rng = np.random.default_rng(0)
    gamma = np.exp(rng.uniform(*np.log(widths), n))
    weight, variance = rng.normal(0.0, 3.0, n), rng.uniform(0.01, 10.0, n)
    return build_index(rng.uniform(-20, 20, (n, 3)), gamma, weight, variance, activation_cut=0.01, tau=1e-4)


def _reaching(index: KernelIndex, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    away = np.maximum(np.maximum(lower - index.hinge, index.hinge - upper), 0.0)
    return np.flatnonzero(np.square(away).sum(axis=1) <= np.square(index.columns[3].astype(float)))


@pytest.mark.parametrize("widths", [(1.0, 1.001), (0.01, 50.0), (1e4, 1e6)], ids=["alike", "mixed", "tiny"])
@pytest.mark.parametrize("edge_m", [0.0, 1.0, 15.0, 100.0])
def test_all_kernels_that_reach_a_box_are_found_and_no_others(
    widths: tuple[float, float], edge_m: float
) -> None:
    index, rng = _index(widths), np.random.default_rng(1)
    found = np.empty(2, np.int64)  # too small: it grows
    for lower in rng.uniform(-25, 25, (20, 3)):
        n, found = kernels_that_reach(index, lower, lower + edge_m, found)
        np.testing.assert_array_equal(np.sort(found[:n]), _reaching(index, lower, lower + edge_m))


def test_kernels_around_points_are_relative_to_their_middle() -> None:
    index = _index((0.01, 50.0))
    points = np.random.default_rng(1).uniform(2.0, 5.0, (9, 3))
    n, found, local, *middle = kernels_around(
        index, points, np.empty(2, np.int64), np.empty((7, 2), np.float32)
    )
    lower, upper = points.min(axis=0), points.max(axis=0)
    np.testing.assert_array_equal(np.sort(found[:n]), _reaching(index, lower, upper))
    np.testing.assert_allclose(middle, (lower + upper) / 2)
    np.testing.assert_allclose(local[:3, :n].T, index.hinge[found[:n]] - middle, atol=1e-5)
    np.testing.assert_array_equal(local[3:, :n], index.columns[[0, 1, 2, 4]][:, found[:n]])
