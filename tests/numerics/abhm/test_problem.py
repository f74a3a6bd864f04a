"""The pieces of the ABHM learner against torch in float64."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.special import expit

from potserver.numerics.abhm import AbhmOptions, AbhmStart, dispersions
from potserver.numerics.abhm.problem import KernelPrior, Problem
from tests.numerics.abhm.checkerboard import (
    QUICK,
    Data,
    Float32,
    Float64,
    data_of,
    exact_log_likelihood,
    somewhere,
)


def _problem(data: Data, hinge: Float64, gamma: Float64, *, batch: int = 150, threads: int = 1):
    """The learner's own problem, with no activation left out."""
    options = dataclasses.replace(QUICK, batch=batch)
    problem = Problem(data.points, data.occupied, data.count, options, threads)
    problem.gather(hinge, gamma)
    return problem


def _rows(problem, first: NDArray[np.int64]) -> NDArray[np.int64]:
    """Which points are in a batch, by their number in the problem's order."""
    starts = np.concatenate([part.cuts[:-1] for part in problem.blocks.parts])
    ends = np.concatenate([part.cuts[1:] for part in problem.blocks.parts])
    assert len(starts) == len(first)
    return np.concatenate(
        [np.arange(a + f, b, problem.n_batches) for a, b, f in zip(starts, ends, first, strict=True)]
    )


@pytest.mark.usefixtures("no_cut")
@pytest.mark.parametrize("flat", [None, 2], ids=["3d", "2d"])
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("batch", [400, 100], ids=["all points", "some points"])
def test_the_log_likelihood_and_its_gradients_are_those_of_torch(
    flat: int | None, threads: int, batch: int
) -> None:
    data = data_of(flat=flat)
    at = somewhere(data)
    problem = _problem(data, at[0], at[1], batch=batch, threads=threads)
    first = next(problem.batches(np.random.default_rng(2)))
    rows = _rows(problem, first)
    assert (len(rows) == 400) == (batch == 400)

    exact = [torch.from_numpy(a).requires_grad_() for a in at]
    truth = 400 / batch * exact_log_likelihood(data, *exact, rows=problem.blocks.order[rows])
    (0.5 * truth).backward()

    given = [at[0] - problem.corner, at[1], at[2]]
    ours = [torch.from_numpy(a.astype(np.float32)).requires_grad_() for a in given]
    value = dispersions.log_likelihood(problem, *ours, first)
    (0.5 * value).backward()

    assert value.item() == pytest.approx(truth.item(), rel=1e-5)
    for single, double in zip(ours, exact, strict=True):
        gradient = double.grad.numpy()
        assert np.abs(gradient).max() > 1.0
        # residuals below 1e-4 have no say
        np.testing.assert_allclose(
            single.grad.numpy(), gradient, rtol=2e-3, atol=1e-3 * np.abs(gradient).max()
        )


@pytest.mark.usefixtures("no_cut")
def test_curvatures_are_those_of_gauss_and_newton() -> None:
    data = data_of(flat=None)
    hinge, gamma, weight = somewhere(data)
    problem = _problem(data, hinge, gamma)
    by_hinge, by_gamma = problem.curvatures(
        *(a.astype(np.float32) for a in (hinge - problem.corner, gamma, weight))
    )
    away = data.points[:, None] - hinge
    d2 = np.square(away).sum(axis=2)
    phi = np.exp(-gamma * d2)
    p = expit(phi @ weight)
    each = (data.count * p * (1 - p))[:, None]
    slope = 2.0 * gamma[:, None] * (weight * phi)[..., None] * away  # of the latent in each hinge coordinate
    np.testing.assert_allclose(by_hinge, (each[..., None] * slope**2).sum(axis=0), rtol=1e-3)
    np.testing.assert_allclose(by_gamma, (each * np.square(weight * phi * gamma * d2)).sum(axis=0), rtol=1e-3)


def test_a_pass_sees_every_point_once_and_a_step_some_of_every_place() -> None:
    """So the steps of a pass add up to the whole gradient, whatever the pass begins with."""
    data = data_of()
    hinge, gamma, weight = somewhere(data)
    problem = _problem(data, hinge, gamma, batch=60)
    assert problem.n_batches == 7
    at = [a.astype(np.float32) for a in (hinge - problem.corner, gamma, weight)]
    whole = _problem(data, hinge, gamma, batch=400).log_likelihood(*at, np.zeros(400, np.int64))
    batches = problem.batches(np.random.default_rng(0))
    starts = []
    for _ in range(20):
        steps = [next(batches) for _ in range(7)]
        starts.append(steps[0])
        rows = [_rows(problem, first) for first in steps]
        np.testing.assert_array_equal(np.sort(np.concatenate(rows)), np.arange(400))
        for first in steps:
            assert np.isin(first, np.arange(7)).all()
        parts = [problem.log_likelihood(*at, first) for first in steps]
        assert sum(part[0] for part in parts) / 7 == pytest.approx(whole[0], rel=1e-6)
        for which in (1, 2, 3):
            together = np.mean([part[which] for part in parts], axis=0)
            np.testing.assert_allclose(together, whole[which], atol=1e-4 * np.abs(whole[which]).max())
    counts = np.bincount(np.concatenate(starts), minlength=7)
    assert np.square(counts - counts.mean()).sum() / counts.mean() < 6 + 5 * np.sqrt(12), (
        "chi squared, five deviations: no place begins with the same points in every pass"
    )


def test_what_counts_for_nothing_depends_on_how_much_points_count() -> None:
    """Points of much weight are never left out for a residual that is small only beside it; points of little weight stay in."""
    data = data_of()
    hinge, gamma, weight = somewhere(data)
    at = [a.astype(np.float32) for a in (hinge - data.points.min(axis=0), gamma, 3.0 * weight)]
    for scale in (1e-3, 1.0, 1e3):
        scaled = data._replace(count=(scale * data.count).astype(np.float32))
        problem = _problem(scaled, hinge, gamma, batch=400)
        exact = [torch.from_numpy(a.astype(float)).requires_grad_() for a in (hinge, gamma, at[2])]
        exact_log_likelihood(scaled, *exact).backward()
        gradient = exact[2].grad.numpy()
        ours = problem.log_likelihood(*at, np.zeros(400, np.int64))[3]
        np.testing.assert_allclose(ours, gradient, rtol=2e-3, atol=1e-3 * np.abs(gradient).max())


def test_the_penalty_is_the_log_density_of_the_priors() -> None:
    options = AbhmOptions(hinge_reach=0.7, gamma_shape=3.0)
    gamma = np.array([0.2, 1.0, 5.0])
    start = KernelPrior(AbhmStart(np.zeros((3, 3)), gamma), np.array([1, 1, 0], np.float32), options)
    rng = np.random.default_rng(0)
    shift = rng.normal(0.0, 1.0, (3, 3)).astype(np.float32)
    ratio = rng.normal(0.0, 0.5, 3).astype(np.float32)

    def log_density(shift: Float32, ratio: Float32) -> float:
        reach = torch.tensor(0.7, dtype=torch.float64)
        moved = torch.distributions.Normal(0.0, reach).log_prob(torch.from_numpy(shift[:, :2]).double()).sum()
        g = torch.from_numpy(start.gamma_at(ratio))
        prior = torch.distributions.Gamma(torch.full((3,), 3.0).double(), torch.from_numpy(3.0 / gamma))
        return float(moved + (prior.log_prob(g) + g.log()).sum())  # in log gamma: times dgamma / dlog gamma

    nowhere = np.zeros((3, 3), np.float32), np.zeros(3, np.float32)
    assert start.penalty(*nowhere) == 0.0
    assert start.penalty(shift, ratio) == pytest.approx(
        log_density(*nowhere) - log_density(shift, ratio), rel=1e-5
    )
