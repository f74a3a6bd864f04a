"""Rows C19 and A12: how a coupling of points moves kernels between them, against POT's own maps."""

from __future__ import annotations

import warnings

import numpy as np
import ot
import pytest

from potserver.numerics.coupling import Coupling, couple
from potserver.numerics.displacement import OutOfSample, affine_map, barycentric_images, carry

REG = 2.0  # m^2


@pytest.fixture(scope="module")
def case() -> tuple[np.ndarray, np.ndarray, np.ndarray, Coupling]:
    rng = np.random.default_rng(0)
    source = rng.uniform(-8, 8, (120, 3)).astype(np.float32)
    target = (rng.uniform(-8, 8, (90, 3)) * [1.2, 0.7, 0.3] + [1.0, -2.0, 0.5]).astype(np.float32)
    kernels = rng.uniform(-9, 9, (200, 3))
    return kernels, source, target, couple(source, target, reg=REG, relative=False, tolerance=1e-5)


def _pot(source: np.ndarray, target: np.ndarray, out_of_sample: str) -> ot.da.SinkhornTransport:
    pot = ot.da.SinkhornTransport(
        reg_e=REG, method="sinkhorn_log", max_iter=20_000, tol=1e-10, out_of_sample_map=out_of_sample
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # POT's own, about its default
        return pot.fit(Xs=source.astype(np.float64), Xt=target.astype(np.float64))


def test_in_sample_points_go_to_the_barycentres_of_their_rows(case) -> None:
    _, source, target, coupling = case
    truth = _pot(source, target, "ferradans").transform(Xs=source.astype(np.float64))
    np.testing.assert_allclose(barycentric_images(coupling, target), truth, atol=1e-3)


def test_nearest_is_the_map_of_ferradans(case) -> None:
    kernels, source, target, coupling = case
    truth = _pot(source, target, "ferradans").transform(Xs=kernels)
    np.testing.assert_allclose(
        carry(kernels, source, target, coupling, OutOfSample.NEAREST), truth, atol=1e-3
    )


def test_entropic_is_the_continuous_map(case) -> None:
    kernels, source, target, coupling = case
    truth = _pot(source, target, "continuous").transform(Xs=kernels)
    np.testing.assert_allclose(
        carry(kernels, source, target, coupling, OutOfSample.ENTROPIC), truth, atol=2e-3
    )


@pytest.mark.parametrize("ridge", [1e-6, 1e-3, 0.3])
def test_linear_is_the_linear_step_of_perrot_for_a_given_plan(case, ridge: float) -> None:
    """With no outer iterations, joint_OT_mapping_linear is its L-step on the plan of the linear program."""
    kernels, source, target, _ = case
    xs, xt = source.astype(np.float64), target.astype(np.float64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        plan, linear = ot.mapping.joint_OT_mapping_linear(
            xs, xt, eta=ridge * xs.size, bias=True, numItermax=0
        )
    given = Coupling(plan.astype(np.float32), 0.0, np.zeros(120), np.zeros(90), REG, 0.0, 1, True)
    truth = kernels @ linear[:3] + linear[3]
    moved = carry(kernels, source, target, given, OutOfSample.LINEAR, ridge=ridge)
    np.testing.assert_allclose(moved, truth, atol=1e-4)
    assert np.abs(moved - kernels).max() > 1.0


def test_linear_finds_an_affine_map_exactly() -> None:
    rng = np.random.default_rng(1)
    source, turn, shift = rng.normal(size=(50, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    linear, offset = affine_map(source, source @ turn + shift, 0.0)
    np.testing.assert_allclose(linear, turn, atol=1e-9)
    np.testing.assert_allclose(offset, shift, atol=1e-9)
