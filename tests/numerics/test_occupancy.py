"""The moderated sigmoid and the variance of the probability. Against quadrature: tests/conformance/test_eq1_occupancy.py."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.occupancy import predict_occupancy, sigmoid

MEAN, VAR = np.meshgrid(np.linspace(-60, 60, 121), np.concatenate([[0.0], np.logspace(-6, 8, 60)]))


def test_ranges() -> None:
    mean, var = predict_occupancy(MEAN, VAR)
    assert ((mean >= 0) & (mean <= 1)).all()
    assert ((var >= 0) & (var <= 0.25)).all()
    assert (var <= mean * (1 - mean) + 1e-15).all()


def test_no_variance_is_the_plain_sigmoid() -> None:
    mean, var = predict_occupancy(np.array([-2.0, 0.0, 3.0]), np.zeros(3))
    np.testing.assert_allclose(mean, 1 / (1 + np.exp([2.0, 0.0, -3.0])))
    np.testing.assert_array_equal(var, 0.0)


def test_symmetric_in_the_sign_of_the_latent() -> None:
    one, other = predict_occupancy(MEAN, VAR), predict_occupancy(-MEAN, VAR)
    np.testing.assert_allclose(one.mean, 1 - other.mean, atol=1e-12)
    np.testing.assert_allclose(one.var, other.var, atol=1e-12)


def test_more_variance_pulls_the_mean_towards_one_half() -> None:
    mean = predict_occupancy(MEAN, VAR).mean
    assert (np.diff(np.abs(mean - 0.5), axis=0) <= 1e-12).all()
    assert np.abs(predict_occupancy(np.array([10.0]), np.array([1e12])).mean - 0.5) < 1e-4


def test_the_moderation_scales_the_variance_for_the_mean_alone() -> None:
    part = predict_occupancy(MEAN, VAR, 0.25)
    np.testing.assert_allclose(part.mean, predict_occupancy(MEAN, 0.25 * VAR).mean)
    np.testing.assert_allclose(predict_occupancy(MEAN, VAR, 0.0).mean, sigmoid(MEAN))
    mean, var = MEAN[:, 50:71], VAR[:, 50:71]  # elsewhere p rounds to 0 or 1
    part, full = predict_occupancy(mean, var, 0.25), predict_occupancy(mean, var)
    np.testing.assert_allclose(
        part.var / (part.mean * (1 - part.mean)), full.var / (full.mean * (1 - full.mean)), atol=1e-9
    )


def test_all_uncertain_is_the_variance_of_a_coin() -> None:
    assert predict_occupancy(np.zeros(1), np.array([1e12])).var[0] == pytest.approx(0.25, abs=1e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sigmoid_never_overflows_and_keeps_its_dtype(dtype: type) -> None:
    x = np.array([-np.inf, -1e4, -90.0, 0.0, 90.0, 1e4, np.inf], dtype)
    s = sigmoid(x)
    assert s.dtype == dtype
    np.testing.assert_allclose(s, [0, 0, 0, 0.5, 1, 1, 1], atol=1e-30)
    assert (np.diff(s) >= 0).all()
    assert sigmoid(np.array([-80.0], dtype))[0] > 0
