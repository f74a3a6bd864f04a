"""The variances of hinges and the shapes of gammas."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from scipy.special import expit

from potserver.numerics.abhm.dispersions import weight_divergence
from potserver.numerics.abhm.problem import Weights
from tests.numerics.abhm.checkerboard import QUICK, data_of


@pytest.mark.usefixtures("no_cut")
def test_the_first_dispersions_are_laplaces() -> None:
    """With no epoch of the dispersions they stay at the curvature of posterior and prior."""
    data = data_of()
    options = dataclasses.replace(QUICK, max_epochs=0, dispersion_epochs=0, hinge_reach=0.7, gamma_shape=3.0)
    fit = data.fit(options, sample_weight=data.count)
    phi = np.exp(-data.gamma * np.square(data.points[:, None] - data.hinge).sum(axis=2))
    away = data.points[:, None] - data.hinge
    p = expit(phi @ fit.weight_mean)
    each = (data.count * p * (1 - p))[:, None, None]
    slope = 2.0 * data.gamma[:, None] * (fit.weight_mean * phi)[..., None] * away
    length = 1.0 / np.sqrt(2.0 * data.gamma)[:, None]
    precision = (each * slope**2).sum(axis=0) + 1.0 / (0.7 * length) ** 2
    np.testing.assert_allclose(fit.hinge_var[:, :2], 1.0 / precision[:, :2], rtol=2e-3)
    slope = fit.weight_mean * phi * data.gamma * np.square(away).sum(axis=2)  # of the latent in log gamma
    np.testing.assert_allclose(fit.gamma_shape, (each[..., 0] * slope**2).sum(axis=0) + 3.0, rtol=2e-3)
    assert fit.elbos == []


def test_the_weights_divergence_is_that_of_two_normals() -> None:
    rng = np.random.default_rng(0)
    mean, var = rng.normal(0.0, 5.0, 20).astype(np.float32), rng.uniform(0.01, 50.0, 20).astype(np.float32)
    posterior = torch.distributions.Normal(
        torch.from_numpy(mean).double(), torch.from_numpy(var).double().sqrt()
    )
    prior = torch.distributions.Normal(torch.zeros(20).double(), torch.full((20,), 7.0).double())
    expected = float(torch.distributions.kl_divergence(posterior, prior).sum())
    weights = Weights(mean, var, True)
    assert weight_divergence(weights, 49.0) == pytest.approx(expected, rel=1e-6)
