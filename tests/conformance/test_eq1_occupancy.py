"""Equation 1 and the predictive of row A19, against float64 sums over every kernel and against quadrature."""

from __future__ import annotations

import numpy as np
import pytest

from potschemas.answers import OBSERVED_ACTIVATION, PRIOR_VAR, occupancy_mean, occupancy_var
from potserver.domain.kernel_map import KernelMap
from tests.conformance import reference

K = 100_000
N = 100
WITHIN = 1e-4  # of a probability


def _points_and_hinges(dims: int, n_kernels: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    size = np.array([300.0, 300.0] if dims == 2 else [60.0, 60.0, 6.0])
    hinge = rng.uniform(-size, size, (n_kernels, dims))
    near = hinge[rng.integers(0, n_kernels, N // 2)] + rng.normal(size=(N // 2, dims))
    return np.concatenate([near, rng.uniform(-1.1 * size, 1.1 * size, (N - N // 2, dims))]), hinge


def _gammas(seed: int, n: int) -> np.ndarray:
    return np.exp(np.random.default_rng(seed).uniform(np.log(0.01), np.log(8.0), n))


def _padded(points: np.ndarray) -> np.ndarray:
    return np.pad(points, ((0, 0), (0, 3 - points.shape[1])))


def _check(points, hinge, gamma, weight, variance):
    answer = KernelMap.from_arrays(hinge, gamma, weight, variance, threads=2).occupancy(points)
    truth = reference.latent(_padded(points), _padded(hinge), gamma, weight, variance)
    # a point whose activation is on the very edge of "observed" may fall to either side
    clear = np.abs(truth.activation - OBSERVED_ACTIVATION) > 0.1 * OBSERVED_ACTIVATION
    assert clear.mean() > 0.8
    observed = truth.activation >= OBSERVED_ACTIVATION
    np.testing.assert_array_equal(answer.observed[clear], observed[clear])
    mean = np.where(observed, reference.moderated(truth.mean, truth.var), 0.5)
    np.testing.assert_allclose(answer.mean[clear], mean[clear], atol=WITHIN, rtol=0)
    latent_var = np.where(observed, truth.var, PRIOR_VAR)
    np.testing.assert_allclose(answer.latent_var[clear], latent_var[clear], rtol=1e-3, atol=1e-3)
    return answer


@pytest.mark.parametrize("dims", [2, 3])
def test_eq1_with_heavy_tailed_gammas_and_variances(dims: int) -> None:
    points, hinge = _points_and_hinges(dims, K, 1)
    rng = np.random.default_rng(2)
    answer = _check(points, hinge, _gammas(3, K), 5.0 * rng.normal(size=K), 10.0 ** rng.uniform(-16, 6, K))
    assert answer.observed.mean() > 0.2


@pytest.mark.parametrize("dims", [2, 3])
def test_eq1_where_nothing_hides_an_error(dims: int) -> None:
    """Weights of one sign add up all that is cut, and tiny variances do not soften the sigmoid."""
    points, hinge = _points_and_hinges(dims, K, 4)
    weight = np.abs(np.random.default_rng(5).normal(size=K)) * 1e-2
    answer = _check(points, hinge, _gammas(6, K), weight, np.full(K, 1e-3))
    assert np.abs(answer.mean - 0.5).max() > 0.01


@pytest.mark.parametrize("dims", [2, 3])
def test_eq1_where_large_weights_of_one_sign_nearly_cancel(dims: int) -> None:
    points, hinge = _points_and_hinges(dims, K, 7)
    weight = np.abs(np.random.default_rng(8).normal(size=K)) * 5.0
    answer = _check(points, hinge, _gammas(9, K), weight - weight.mean(), np.full(K, 1e-3))
    assert ((answer.mean > 0.01) & (answer.mean < 0.99)).sum() > 2


def test_eq1_five_thousand_kilometres_from_the_origin() -> None:
    points, hinge = _points_and_hinges(3, K, 10)
    offset = np.array([5e6, -5e6, 5e6])
    rng = np.random.default_rng(11)
    _check(points + offset, hinge + offset, _gammas(12, K), rng.normal(size=K), 10.0 ** rng.uniform(-3, 6, K))


def test_eq1_two_maps_ten_thousand_kilometres_apart() -> None:
    points, hinge = _points_and_hinges(3, 2_000, 13)
    rng = np.random.default_rng(14)
    far = np.array([1e7, 1e7, 0.0])
    both_points, both = np.concatenate([points, points + far]), np.concatenate([hinge, hinge + far])
    _check(both_points, both, np.tile(_gammas(15, 2_000), 2), rng.normal(size=4_000), np.full(4_000, 0.5))


@pytest.mark.parametrize("n_stacked", [100, 1_000, 3_000])
def test_eq1_with_kernels_stacked_on_one_spot(n_stacked: int) -> None:
    """A robot that stands still: each kernel falls below a cut that their sum does not."""
    rng = np.random.default_rng(16)
    side = 200
    cells = np.arange(side * side)
    hinge = np.stack([cells % side, cells // side, 0 * cells], axis=1) * 1.5
    gamma, weight = np.full(side * side, 8.0), rng.normal(size=side * side)
    hinge[:n_stacked], gamma[:n_stacked], weight[:n_stacked] = (100.0, 100.0, 0.0), 0.05, 1.0
    ray = np.stack([100.0 + np.linspace(0, 30, 121), np.full(121, 100.0), np.zeros(121)], axis=1)
    _check(ray, hinge, gamma, weight, np.full(side * side, 1e-3))


def test_eq1_with_all_kernels_on_one_spot() -> None:
    rng = np.random.default_rng(17)
    ray = np.stack([np.linspace(0, 6, 61), np.zeros(61), np.zeros(61)], axis=1)
    _check(ray, np.zeros((K, 3)), np.ones(K), rng.uniform(0.5, 1.5, K), np.full(K, 1e-3))


def test_eq1_of_weak_kernels_still_counts_as_observed() -> None:
    """Activation is cut apart from weights: three hundred kernels of almost no weight were still seen."""
    ray = np.stack([np.linspace(0, 4, 300), np.zeros(300), np.zeros(300)], axis=1)
    _check(ray, np.zeros((300, 3)), np.ones(300), np.full(300, 1e-6), np.full(300, 1e-9))


def test_eq1_of_one_kernel() -> None:
    ray = np.stack([np.linspace(0, 6, 300), np.zeros(300), np.zeros(300)], axis=1)
    _check(ray, np.zeros((1, 3)), np.ones(1), np.array([4.0]), np.array([0.3]))


def test_eq1_of_no_kernels() -> None:
    answer = KernelMap.from_arrays(np.zeros((0, 3)), [], [], []).occupancy(np.zeros((3, 3)))
    np.testing.assert_array_equal(answer.mean, 0.5)
    np.testing.assert_array_equal(answer.latent_var, np.float32(PRIOR_VAR))
    assert not answer.observed.any()


def test_eq1_far_outside_is_unknown_and_never_free() -> None:
    points, hinge = _points_and_hinges(3, 500, 18)
    kernels = KernelMap.from_arrays(hinge, _gammas(19, 500), np.full(500, -9.0), np.full(500, 0.1))
    far = np.array([[1e4, 0, 0], [0, -1e7, 0], [1e9, 1e9, 1e9], [0, 0, 500.0]])
    answer = kernels.occupancy(np.concatenate([points, far]))
    assert not answer.observed[-4:].any()
    np.testing.assert_array_equal(answer.mean[-4:], 0.5)
    np.testing.assert_allclose(answer.mean[:-4], kernels.occupancy(points).mean, atol=WITHIN)


def test_predictive_mean_is_the_probit_scaled_sigmoid() -> None:
    """Row A19."""
    mean, var = np.meshgrid(np.linspace(-40.0, 40.0, 81), np.concatenate([[0.0], np.logspace(-6, 6, 40)]))
    np.testing.assert_allclose(occupancy_mean(mean, var), reference.moderated(mean, var), atol=1e-12)


def test_predictive_moments_against_quadrature() -> None:
    """The closed forms are approximations: here the mean is off by at most 0.0165 and the variance by at most 0.0150."""
    mean_off, var_off = 0.0, 0.0
    for mean in np.linspace(0.0, 12.0, 17):
        for var in np.logspace(-3, 6, 28):
            true_mean, true_var = reference.probability_moments(mean, var)
            got = occupancy_mean(np.array([mean]), np.array([var]))
            mean_off = max(mean_off, abs(float(got[0]) - true_mean))
            var_off = max(var_off, abs(float(occupancy_var(got, np.array([var]))[0]) - true_var))
    assert 0.01 < mean_off <= 0.018, mean_off
    assert 0.01 < var_off <= 0.016, var_off
