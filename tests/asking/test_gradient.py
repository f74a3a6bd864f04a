"""Gradients of the answers: analytic ones against central differences in float64, and offline as on the server."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from potclient.kernels import KernelSet as ClientKernels
from potschemas.answers import AnswerRule
from potserver.asking.points import Points
from potserver.codec.kernels import encode_kernels
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet
from potserver.errors import BadPointsError
from potserver.limits import Limits
from tests.conformance import reference

Array = np.ndarray[Any, Any]
STEP_M = 1e-5


def scene(k: int = 400, shift_m: float = 0.0, residual_var: float = 20.0) -> KernelMap:
    rng = np.random.default_rng(3)
    return KernelMap.from_arrays(
        rng.uniform(-5, 5, (k, 3)) + shift_m,
        rng.uniform(0.3, 4.0, k),
        rng.normal(0.0, 3.0, k),
        rng.uniform(0.1, 2.0, k),
        rule=AnswerRule(residual_var=residual_var),
        threads=2,
    )


def by_hand(kernels: KernelMap, points: Array) -> tuple[Array, Array, Array]:
    """Mean, latent mean and activation in float64, with no rule for unobserved points."""
    k = kernels.kernels
    gamma = k.gamma_shape.astype(float) / k.gamma_rate
    sums = reference.latent(points, k.hinge_mean, gamma, k.weight_mean, k.weight_var)
    s2 = sums.var + kernels.rule.residual_var * np.maximum(1 - sums.activation, 0)
    return reference.moderated(sums.mean, s2), sums.mean, sums.activation


def differences(kernels: KernelMap, points: Array) -> tuple[Array, Array]:
    slopes = np.zeros((2, len(points), 3))
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = STEP_M
        ahead, behind = by_hand(kernels, points + step), by_hand(kernels, points - step)
        for i in (0, 1):
            slopes[i, :, axis] = (ahead[i] - behind[i]) / (2 * STEP_M)
    return slopes[0], slopes[1]


@pytest.mark.parametrize("residual_var", [0.0, 20.0])
def test_gradients_are_the_central_differences(residual_var: float) -> None:
    kernels = scene(residual_var=residual_var)
    points = np.random.default_rng(0).uniform(-6, 6, (500, 3))
    answer = kernels.occupancy_with_gradient(points)
    mean, latent = differences(kernels, points)
    # at an activation of 1 the residual variance has a kink, at the edge of the observed the answer a jump
    activation = by_hand(kernels, points)[2]
    smooth = np.abs(activation - 1.0) > 1e-3
    known = answer.observed & smooth
    assert known.sum() > 300
    assert ((activation < 1.0) & known).sum() > 20, "where the residual variance has a slope too"
    np.testing.assert_allclose(answer.gradient[known], mean[known], atol=1e-3)
    np.testing.assert_allclose(answer.latent_gradient[known], latent[known], atol=5e-3)
    assert np.abs(mean[known]).max() > 0.3, "there is something to be seen"
    assert not answer.gradient[~answer.observed].any()
    assert not answer.latent_gradient[~answer.observed].any()
    plain = kernels.occupancy(points)
    assert plain.gradient is None
    np.testing.assert_array_equal(plain.mean, answer.mean)


@pytest.mark.parametrize("shift_m", [0.0, 3e6])
def test_offline_gradients_are_the_servers(shift_m: float) -> None:
    kernels = scene(shift_m=shift_m)
    message = encode_kernels(kernels.kernels, kernels.rule)
    offline = ClientKernels.from_message(message)
    points = np.random.default_rng(0).uniform(-7, 7, (800, 3)) + shift_m
    here, there = offline.occupancy(points, gradient=True), kernels.occupancy_with_gradient(points)
    same = here.observed == there.observed
    assert same.mean() > 0.99
    assert here.gradient is not None
    assert here.latent_gradient is not None
    np.testing.assert_allclose(here.gradient[same], there.gradient[same], atol=2e-3)
    np.testing.assert_allclose(here.latent_gradient[same], there.latent_gradient[same], atol=1e-2)
    assert here.gradient.dtype == here.latent_gradient.dtype == np.float32
    plain = offline.occupancy(points)
    assert plain.gradient is plain.latent_gradient is None
    np.testing.assert_array_equal(plain.mean, here.mean)


def test_offline_gradients_are_exact_in_float64() -> None:
    """The client sums in float64: only the differences themselves limit what can be seen."""
    kernels = scene(k=60)
    offline = ClientKernels.from_message(encode_kernels(kernels.kernels, kernels.rule))
    k = kernels.kernels
    exact = KernelMap(
        KernelSet(
            hinge_mean=offline.hinge_mean,
            hinge_var=k.hinge_var,
            gamma_shape=k.gamma_shape,
            gamma_rate=k.gamma_rate,
            weight_mean=k.weight_mean,
            weight_var=k.weight_var,
        ),
        rule=AnswerRule(residual_var=20.0),
    )
    points = np.random.default_rng(1).uniform(-4, 4, (200, 3))
    answer = offline.occupancy(points, gradient=True)
    mean, latent = differences(exact, points)
    known = answer.observed & (np.abs(by_hand(exact, points)[2] - 1.0) > 1e-3)
    assert known.sum() > 50
    assert answer.gradient is not None
    assert answer.latent_gradient is not None
    np.testing.assert_allclose(answer.gradient[known], mean[known], atol=1e-6, rtol=1e-5)
    np.testing.assert_allclose(answer.latent_gradient[known], latent[known], atol=1e-6, rtol=1e-5)


def test_an_empty_map_is_flat() -> None:
    answer = KernelMap(KernelSet.empty()).occupancy_with_gradient([[1.0, 2, 3]])
    np.testing.assert_array_equal(answer.gradient, np.zeros((1, 3)))
    assert KernelMap(KernelSet.empty()).occupancy_with_gradient(np.zeros((0, 3))).gradient.shape == (0, 3)


def test_points_get_them_on_request() -> None:
    kernels, limits = scene(), Limits()
    assert Points([[0.0, 0, 0]]).plan(kernels, limits).part(0).gradient is None
    answer = Points([[0.0, 0]], with_gradient=True).plan(kernels, limits).part(0)
    assert answer.gradient.shape == (1, 3)
    with pytest.raises(BadPointsError):
        Points([[np.nan, 0, 0]], with_gradient=True).plan(kernels, limits)
