"""The sparse solver of Bayesian logistic regression, held against a dense one and against what must be true of any."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import expit

from potserver.numerics.kernel_index import SparseFeatures, sparse_features
from potserver.numerics.logistic import WeightPosterior, fit_sparse
from tests.conformance.reference import fit_dense


class Case:
    """Points, kernels, labels and a prior that is neither zero nor the same for all kernels."""

    def __init__(self, k: int = 40, n: int = 400, seed: int = 0, prior_var: float = 20.0) -> None:
        rng = np.random.default_rng(seed)
        self.points = rng.uniform(-5, 5, (n, 3)) * [1, 1, 0.2]
        self.hinge = rng.uniform(-5, 5, (k, 3)) * [1, 1, 0.2]
        self.gamma = rng.uniform(0.2, 1.5, k)
        self.y = rng.random(n) < expit(4 * np.sin(self.points[:, 0]))
        self.mean = rng.normal(size=k).astype(np.float32)
        self.var = (prior_var * rng.uniform(0.5, 2.0, k)).astype(np.float32)
        self.phi = np.exp(-self.gamma * np.square(self.points[:, None] - self.hinge).sum(axis=2))
        self.features = sparse_features(self.points, self.hinge, self.gamma, cut=1e-7)

    def sparse(self, **options) -> WeightPosterior:
        settings = {"tolerance": 1e-7, "max_newton": 60, "max_conjugate_gradient": 400} | options
        features, y = settings.pop("features", self.features), settings.pop("labels", self.y)
        return fit_sparse(features, y, self.mean, self.var, **settings)

    def gradient(self, w, *, offset=0.0, count=1.0):
        p = expit(self.phi @ w + offset)
        return self.phi.T @ (count * (p - self.y)) + (w - self.mean) / self.var

    def objective(self, w):
        f = self.phi @ w
        return (np.logaddexp(0, f) - self.y * f).sum() + 0.5 * (np.square(w - self.mean) / self.var).sum()


@pytest.mark.parametrize(("k", "n", "prior_var"), [(40, 400, 20.0), (150, 1500, 5.0), (30, 20, 50.0)])
@pytest.mark.parametrize("threads", [1, 3])
def test_sparse_equals_dense(k: int, n: int, prior_var: float, threads: int) -> None:
    case = Case(k, n, prior_var=prior_var)
    dense = fit_dense(case.phi, case.y, case.mean, case.var)
    sparse = case.sparse(threads=threads)
    assert sparse.converged
    np.testing.assert_allclose(case.phi @ sparse.mean, case.phi @ dense.mean, atol=1e-3)
    np.testing.assert_allclose(sparse.var, dense.var, rtol=1e-3)


def test_the_gradient_is_zero_at_the_optimum_by_finite_differences() -> None:
    case = Case()
    w = fit_dense(case.phi, case.y, case.mean, case.var).mean
    for m in range(0, 40, 5):
        step = np.zeros(40)
        step[m] = 1e-4
        slope = (case.objective(w + step) - case.objective(w - step)) / 2e-4
        assert abs(slope) < 1e-4
        assert case.objective(w + 100 * step) > case.objective(w)
    np.testing.assert_allclose(case.gradient(case.sparse().mean.astype(np.float64)), 0.0, atol=5e-3)


def test_variance_is_one_over_the_diagonal_of_the_hessian() -> None:
    case = Case()
    for posterior in (case.sparse(), fit_dense(case.phi, case.y, case.mean, case.var)):
        p = expit(case.phi @ posterior.mean)
        hessian = (case.phi * (p * (1 - p))[:, None]).T @ case.phi + np.diag(1 / case.var)
        np.testing.assert_allclose(posterior.var, 1 / np.diag(hessian), rtol=1e-3)
        assert (posterior.var <= case.var * 1.00001).all(), "data never add variance"


def test_without_data_the_prior_stays() -> None:
    case = Case()
    nothing = sparse_features(case.points[:0], case.hinge, case.gamma, cut=0.01)
    far = sparse_features(case.points + 1e3, case.hinge, case.gamma, cut=0.01)
    for features, labels in ((nothing, case.y[:0]), (far, case.y)):
        kept = case.sparse(features=features, labels=labels)
        np.testing.assert_allclose(kept.mean, case.mean, atol=1e-6)
        np.testing.assert_allclose(kept.var, case.var, rtol=1e-6)
    dense = fit_dense(np.zeros((0, 40)), case.y[:0], case.mean, case.var)
    np.testing.assert_allclose(dense.mean, case.mean, atol=1e-6)
    np.testing.assert_allclose(dense.var, case.var, rtol=1e-6)


def test_a_kernel_without_data_keeps_its_prior_beside_others_that_learn() -> None:
    case = Case()
    case.hinge[0] += 1e3
    learned = case.sparse(features=sparse_features(case.points, case.hinge, case.gamma, cut=1e-6))
    assert learned.mean[0] == pytest.approx(case.mean[0], abs=1e-4)
    assert learned.var[0] == pytest.approx(case.var[0], rel=1e-5)
    assert np.abs(learned.mean[1:] - case.mean[1:]).max() > 0.5


def test_no_kernels() -> None:
    none = np.zeros(0, np.float32)
    features = sparse_features(np.zeros((3, 3)), np.zeros((0, 3)), np.zeros(0), cut=0.01)
    empty = fit_sparse(features, np.ones(3, bool), none, none)
    assert len(empty.mean) == len(empty.var) == 0


def test_data_twice_is_a_sample_weight_of_two() -> None:
    case = Case()
    twice = sparse_features(np.tile(case.points, (2, 1)), case.hinge, case.gamma, cut=1e-7)
    doubled = case.sparse(features=twice, labels=np.tile(case.y, 2))
    weighted = case.sparse(sample_weight=np.full(400, 2.0, np.float32))
    once = case.sparse()
    np.testing.assert_allclose(case.phi @ doubled.mean, case.phi @ weighted.mean, atol=2e-3)
    np.testing.assert_allclose(doubled.var, weighted.var, rtol=1e-3)
    assert np.abs(case.phi @ (doubled.mean - once.mean)).max() > 0.02
    assert (doubled.var < once.var).all()


def test_a_sample_weight_of_zero_leaves_a_point_out() -> None:
    case = Case()
    half = np.arange(400) < 200
    weighted = case.sparse(sample_weight=half.astype(np.float32))
    features = sparse_features(case.points[:200], case.hinge, case.gamma, cut=1e-7)
    alone = case.sparse(features=features, labels=case.y[:200])
    np.testing.assert_allclose(case.phi @ weighted.mean, case.phi @ alone.mean, atol=2e-3)


def test_the_offset_is_latent_that_is_explained_already() -> None:
    case = Case()
    offset = np.random.default_rng(5).normal(size=400).astype(np.float32)
    fitted = case.sparse(offset=offset)
    np.testing.assert_allclose(case.gradient(fitted.mean.astype(np.float64), offset=offset), 0.0, atol=5e-3)
    assert np.abs(case.gradient(fitted.mean.astype(np.float64))).max() > 1.0


def test_labels_are_in_the_order_of_the_points_whatever_the_order_of_the_features() -> None:
    case = Case()
    shuffle = np.random.default_rng(3).permutation(400)
    features = sparse_features(case.points[shuffle], case.hinge, case.gamma, cut=1e-7)
    assert not np.array_equal(features.order, np.arange(400))
    shuffled = case.sparse(features=features, labels=case.y[shuffle])
    np.testing.assert_allclose(case.phi @ shuffled.mean, case.phi @ case.sparse().mean, atol=1e-3)


@pytest.mark.parametrize("prior_var", [1.0, 100.0, 1e6])
def test_separable_data_stay_finite_and_on_their_side(prior_var: float) -> None:
    points = np.stack([np.linspace(-1, 1, 50), np.zeros(50), np.zeros(50)], axis=1)
    y, hinge, gamma = points[:, 0] > 0, np.array([[-1.0, 0, 0], [1.0, 0, 0]]), np.ones(2)
    prior = np.zeros(2, np.float32), np.full(2, prior_var, np.float32)
    sparse = fit_sparse(sparse_features(points, hinge, gamma, cut=1e-6), y, *prior, max_newton=100)
    phi = np.exp(-np.square(points[:, None] - hinge).sum(axis=2))
    for posterior in (sparse, fit_dense(phi, y, *prior)):
        assert np.isfinite(posterior.mean).all()
        assert np.isfinite(posterior.var).all()
        assert posterior.mean[0] < 0 < posterior.mean[1]
        assert (posterior.var > 0).all()


def test_one_label_only_stays_finite() -> None:
    case = Case()
    fitted = case.sparse(labels=np.ones(400, bool))
    assert np.isfinite(fitted.mean).all()
    assert (case.phi @ fitted.mean).mean() > 1.0


def test_a_prior_that_is_far_off_is_overcome() -> None:
    """Where the sigmoid is flat Newton crawls; the start must not be trapped there."""
    case = Case()
    case.mean = np.full(40, -80.0, np.float32)
    case.var = np.full(40, 1e4, np.float32)
    dense = fit_dense(case.phi, case.y, case.mean, case.var)
    sparse = case.sparse(max_newton=200)
    assert case.objective(sparse.mean.astype(np.float64)) <= case.objective(dense.mean) + 0.05


def test_a_good_start_is_begun_with() -> None:
    case = Case(150, 1500, prior_var=100.0)
    best = case.sparse()
    again = case.sparse(start=best.mean, tolerance=1e-3)
    assert again.converged
    assert again.n_newton <= 2 < best.n_newton
    np.testing.assert_allclose(case.phi @ again.mean, case.phi @ best.mean, atol=0.01)
    nudged = best.mean + np.float32(0.05) * np.random.default_rng(0).normal(size=150).astype(np.float32)
    one_step = {"max_newton": 1, "max_conjugate_gradient": 30}
    assert case.objective(case.sparse(start=nudged, **one_step).mean) < case.objective(
        case.sparse(**one_step).mean
    )


@pytest.mark.parametrize("size", [30.0, -500.0])
def test_a_start_worse_than_the_priors_plays_no_part(size: float) -> None:
    case = Case()
    start = np.full(40, size, np.float32)
    bad, without = case.sparse(start=start), case.sparse()
    np.testing.assert_array_equal(bad.mean, without.mean)
    assert bad.n_newton == without.n_newton
    np.testing.assert_array_equal(start, np.float32(size))


def test_the_start_only_starts() -> None:
    """Neither the optimum nor the given array changes."""
    case = Case()
    start = case.sparse().mean + np.float32(0.3)
    kept = start.copy()
    np.testing.assert_allclose(
        case.phi @ case.sparse(start=start).mean, case.phi @ case.sparse().mean, atol=1e-3
    )
    np.testing.assert_array_equal(start, kept)


def test_a_solve_cut_short_says_so() -> None:
    case = Case(150, 1500, prior_var=100.0)
    assert not case.sparse(max_newton=1).converged


def test_features_may_be_given_as_they_are() -> None:
    """Two points, one kernel, done by hand: w solves 2 (sigmoid(w) - 1/2) + w - 1 = 0 with labels 0 and 1."""
    features = SparseFeatures(
        np.arange(2), np.array([0, 1, 2]), np.zeros(2, np.int32), np.ones(2, np.float32)
    )
    fitted = fit_sparse(
        features, np.array([True, False]), np.ones(1, np.float32), np.ones(1, np.float32), tolerance=1e-7
    )
    w = float(fitted.mean[0])
    assert 2 * (expit(w) - 0.5) + w - 1.0 == pytest.approx(0.0, abs=1e-5)
