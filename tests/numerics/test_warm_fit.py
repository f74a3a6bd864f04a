"""The warm-started solve against the optimum that scipy finds in float64."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.optimize

from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

K, N = 60, 700


@pytest.fixture(scope="module")
def case():
    rng = np.random.default_rng(0)
    points, hinge = rng.uniform(0, 5, (N, 3)), rng.uniform(0, 5, (K, 3))
    gamma = np.full(K, 0.6)
    phi = np.exp(-gamma * np.square(points[:, None] - hinge[None]).sum(axis=2))
    labels = rng.random(N) < 1 / (1 + np.exp(-(points[:, 0] - 2.5) * 3))
    counts = rng.uniform(0.1, 3.0, N).astype(np.float32)
    mean, var = rng.normal(0, 1, K).astype(np.float32), rng.uniform(1, 50, K).astype(np.float32)
    blocks = feature_blocks(points, hinge, gamma, edge_m=1.0, cut=1e-7)
    return blocks, phi, labels, counts, mean, var


def _objective(case, w):
    _, phi, labels, counts, mean, var = case
    f = phi @ w
    return float((counts * (np.logaddexp(0, f) - labels * f)).sum() + 0.5 * (np.square(w - mean) / var).sum())


def _optimum(case, free=slice(None), fixed=None) -> np.ndarray:
    w = np.zeros(K) if fixed is None else fixed.astype(float).copy()

    def at(x):
        w[free] = x
        return _objective(case, w)

    _, phi, labels, counts, mean, var = case

    def slope(x):
        w[free] = x
        p = 1 / (1 + np.exp(-(phi @ w)))
        return (phi.T @ (counts * (p - labels)) + (w - mean) / var)[free]

    w[free] = scipy.optimize.minimize(
        at, w[free], jac=slope, method="L-BFGS-B", options={"maxiter": 5000, "ftol": 1e-15, "gtol": 1e-9}
    ).x
    return w


def test_many_steps_end_at_the_optimum(case) -> None:
    blocks, phi, labels, counts, mean, var = case
    fit = warm_fit(blocks, labels, counts, Prior(mean, var), np.zeros(K, np.float32), Solver(40, 60))
    assert fit.converged
    assert fit.objective <= _objective(case, _optimum(case)) * (1 + 1e-4)
    np.testing.assert_allclose(fit.objective, _objective(case, fit.weights), rtol=1e-4)
    p = 1 / (1 + np.exp(-(phi @ fit.weights)))
    least = np.square(phi).T @ (counts * p * (1 - p)) + 1 / var
    assert (1 / fit.var > 0.97 * least).all(), (
        "the Hessian's diagonal, or more where rows are on the wrong side"
    )
    np.testing.assert_allclose(1 / fit.var, fit.support + 1 / var, rtol=1e-3)


@pytest.mark.parametrize("longest", [2.0, 4.0, 64.0])
def test_longer_steps_end_at_the_same_optimum(case, longest: float) -> None:
    blocks, _, labels, counts, mean, var = case
    fit = warm_fit(
        blocks, labels, counts, Prior(mean, var), np.zeros(K, np.float32), Solver(40, 60, longest_step=longest),
    )  # fmt: skip
    assert fit.converged
    assert fit.objective <= _objective(case, _optimum(case)) * (1 + 1e-4)
    assert fit.objective == pytest.approx(_objective(case, fit.weights), rel=1e-4)


def test_where_labels_part_cleanly_one_longer_step_goes_farther_than_two(case) -> None:
    blocks, phi, _, counts, mean, _ = case
    clean, wide = phi @ np.sin(np.arange(K)) > 0, np.full(K, 1e4, np.float32)

    def after(n: int, longest: float) -> float:
        return warm_fit(
            blocks, clean, counts, Prior(mean, wide), np.zeros(K, np.float32), Solver(n, 20, longest),
        ).objective  # fmt: skip

    assert after(1, 4.0) < after(2, 1.0) < after(1, 1.0)


def test_few_steps_from_near_the_optimum_stay_there(case) -> None:
    blocks, _, labels, counts, mean, var = case
    best = _optimum(case).astype(np.float32)
    fit = warm_fit(blocks, labels, counts, Prior(mean, var), best)
    assert fit.objective <= fit.objective_at_start
    np.testing.assert_allclose(fit.objective_at_start, _objective(case, best), rtol=1e-5)
    np.testing.assert_allclose(fit.weights, best, atol=0.05)


@pytest.mark.parametrize("surely", [30.0, 300.0])
def test_rows_that_are_surely_wrong_do_not_get_it_stuck(case, surely: float) -> None:
    """All weights say occupied, surely, and all rows say free: plain Newton has no curvature here."""
    blocks, _, _, counts, _, var = case
    start = np.full(K, surely, np.float32)
    zeros = np.zeros(K, np.float32)
    weights = start
    for _ in range(30):
        fit = warm_fit(blocks, np.zeros(N, bool), counts, Prior(zeros, var), weights)
        assert fit.converged
        assert fit.objective <= fit.objective_at_start
        weights = fit.weights
    assert (case[1] @ weights < 0).all(), "no row stays on the wrong side"
    free = (case[0], case[1], np.zeros(N, bool), counts, zeros, var)
    assert fit.objective <= 1.25 * _objective(free, _optimum(free))


def test_held_weights_are_held_and_still_count(case) -> None:
    blocks, _, labels, counts, mean, var = case
    free = np.arange(K) % 3 > 0
    start = np.where(free, 0.0, 2.0).astype(np.float32)
    fit = warm_fit(blocks, labels, counts, Prior(mean, var), start, Solver(40, 60), free=free)
    np.testing.assert_array_equal(fit.weights[~free], start[~free])
    best = _optimum(case, free, start)
    assert _objective(case, fit.weights) <= _objective(case, best) * (1 + 1e-4)


def test_the_same_to_the_bit_on_any_number_of_threads(case) -> None:
    blocks, _, labels, counts, mean, var = case
    one, other = (warm_fit(blocks, labels, counts, Prior(mean, var), mean, threads=t) for t in (1, 4))
    np.testing.assert_array_equal(one.weights, other.weights)
    np.testing.assert_array_equal(one.var, other.var)


def test_without_data_weights_go_to_their_prior() -> None:
    blocks = feature_blocks(np.zeros((0, 3)), np.zeros((2, 3)), np.ones(2), edge_m=1.0, cut=0.02)
    mean, var = np.array([1.0, -2.0], np.float32), np.array([4.0, 9.0], np.float32)
    fit = warm_fit(
        blocks, np.zeros(0, bool), np.zeros(0, np.float32), Prior(mean, var), np.zeros(2, np.float32)
    )
    np.testing.assert_allclose(fit.weights, mean, atol=1e-5)
    np.testing.assert_allclose(fit.var, var, rtol=1e-5)
    np.testing.assert_array_equal(fit.support, 0.0)


def test_nothing_at_all() -> None:
    blocks = feature_blocks(np.zeros((0, 3)), np.zeros((0, 3)), np.ones(0), edge_m=1.0, cut=0.02)
    none = np.zeros(0, np.float32)
    assert len(warm_fit(blocks, np.zeros(0, bool), none, Prior(none, none), none).weights) == 0


def test_soft_labels_end_at_their_optimum(case) -> None:
    """A label of one half pulls towards 0, from both sides."""
    blocks, phi, _, counts, mean, var = case
    soft = np.random.default_rng(4).choice([0.0, 0.5, 1.0], N).astype(np.float32)
    solver = Solver(60, 60, longest_step=4.0)
    fit = warm_fit(blocks, soft, counts, Prior(mean, var), np.zeros(K, np.float32), solver)

    def objective(w):
        f = phi @ w
        return float(
            (counts * (np.logaddexp(0.0, f) - soft * f)).sum() + (np.square(w - mean) / (2.0 * var)).sum()
        )

    best = scipy.optimize.minimize(objective, np.zeros(K), method="L-BFGS-B", options={"maxiter": 5000}).fun
    assert objective(fit.weights.astype(np.float64)) <= best * (1 + 1e-4) + 0.05


def test_a_label_of_one_half_says_that_nothing_is_known() -> None:
    points = np.zeros((1, 3))
    blocks = feature_blocks(points, points, np.ones(1), edge_m=1.0, cut=1e-7)
    one = np.ones(1, np.float32)
    for start in (-5.0, 5.0):
        fit = warm_fit(
            blocks, 0.5 * one, 100.0 * one, Prior(0.0 * one, 100.0 * one), start * one, Solver(30, 10)
        )
        assert abs(float(fit.weights[0])) < 0.05
