"""Dispersions of hinges and widths enter what transported kernels answer."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, KernelSet
from potserver.mapping.dispersions import integrated_out
from tests.conformance import reference


def _sharp(kernels: KernelSet) -> KernelSet:
    """The same means, known exactly."""
    shape = np.full(len(kernels), 1e6, np.float32)
    return kernels.replace(
        hinge_var=np.zeros_like(kernels.hinge_var), gamma_shape=shape, gamma_rate=shape / kernels.gamma
    )


def _latent(kernels: KernelSet, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) mean and (N,) standard deviation of the latent."""
    found = reference.latent(
        points, kernels.hinge_mean, kernels.gamma, kernels.weight_mean, kernels.weight_var
    )
    return found.mean, np.sqrt(found.var)


def _sampled(atom: Atom, points: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """The same by draws of all three distributions."""
    rng, k = np.random.default_rng(0), atom.kernels
    draws = np.empty((n, len(points)))
    for i in range(n):
        hinge = k.hinge_mean + rng.normal(size=k.hinge_mean.shape) * np.sqrt(k.hinge_var)
        weight = k.weight_mean + rng.normal(size=len(k)) * np.sqrt(k.weight_var)
        gamma = rng.gamma(k.gamma_shape, 1.0 / k.gamma_rate)
        draws[i] = reference.latent(points, hinge, gamma, weight, k.weight_var).mean
    return draws.mean(axis=0), draws.std(axis=0)


@pytest.mark.parametrize("dims", [2, 3])
def test_one_bump_a_kernel_answers_as_draws_of_hinge_width_and_weight_do(dims: int) -> None:
    for atom in list(AtomDictionary.builtin().of_dims(dims))[:3]:
        points = np.concatenate([atom.hit_points[:80], atom.free_points[:80]]).astype(np.float64)
        mean, sd = _sampled(atom, points, 300)
        found_mean, found_sd = _latent(integrated_out(atom.kernels, planar=dims == 2), points)
        bare_mean, bare_sd = _latent(atom.kernels, points)
        assert np.corrcoef(found_mean, mean)[0, 1] > 0.985
        assert np.sqrt(np.square(found_mean - mean).mean()) < 0.75 * np.sqrt(
            np.square(bare_mean - mean).mean()
        )
        assert found_sd.mean() == pytest.approx(sd.mean(), rel=0.15)
        assert bare_sd.mean() < 0.87 * sd.mean()


def test_what_is_known_exactly_stays_as_it_is() -> None:
    kernels = _sharp(reference.kernels_at(np.zeros((20, 3)), np.random.default_rng(1)))
    found = integrated_out(kernels, planar=False)
    for name in ("gamma", "weight_mean", "weight_var"):
        np.testing.assert_allclose(getattr(found, name), getattr(kernels, name), rtol=1e-4)


@pytest.mark.parametrize("planar", [True, False])
def test_more_dispersion_lowers_and_widens_every_bump(planar: bool) -> None:
    kernels = reference.kernels_at(np.zeros((50, 3)), np.random.default_rng(2))
    vaguer = kernels.replace(
        hinge_var=kernels.hinge_var * 3,
        gamma_shape=kernels.gamma_shape / 3,
        gamma_rate=kernels.gamma_rate / 3,
    )
    less, more = (integrated_out(k, planar=planar) for k in (kernels, vaguer))
    assert (np.abs(more.weight_mean) < np.abs(less.weight_mean)).all()
    assert (more.gamma < less.gamma).all()
    if planar:
        flat = kernels.replace(hinge_var=kernels.hinge_var * np.float32([1, 1, 9]))
        np.testing.assert_array_equal(integrated_out(flat, planar=True).weight_mean, less.weight_mean)
