"""The index: what it may leave out, how it groups, and that any cut or order gives the sums of eq. 1."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from potserver.numerics.kernel_index import (
    build_index,
    group_points,
    latent_sums,
    reach,
    stack_sizes,
)


def _case(k: int = 400, n: int = 150, seed: int = 0, size: float = 20.0):
    rng = np.random.default_rng(seed)
    hinge, points = rng.uniform(-size, size, (k, 3)), rng.uniform(-1.2 * size, 1.2 * size, (n, 3))
    gamma = np.exp(rng.uniform(np.log(0.01), np.log(8.0), k))
    return points, hinge, gamma, rng.normal(size=k) * 3.0, 10.0 ** rng.uniform(-3, 2, k)


def _phi(points, hinge, gamma):
    return np.exp(-gamma * np.square(points[:, None] - hinge[None]).sum(axis=2))


@pytest.mark.parametrize("threads", [1, 4])
def test_sums_are_those_of_every_kernel(threads: int) -> None:
    points, hinge, gamma, w, v = _case()
    phi = _phi(points, hinge, gamma)
    sums = latent_sums(
        build_index(hinge, gamma, w, v, activation_cut=1e-6, tau=1e-9), points, threads=threads
    )
    np.testing.assert_allclose(sums.mean, phi @ w, atol=2e-5)
    np.testing.assert_allclose(sums.var, np.square(phi) @ v, rtol=2e-5, atol=2e-5)
    np.testing.assert_allclose(sums.activation, phi.sum(axis=1), rtol=2e-5, atol=2e-5)


def test_beyond_its_reach_a_kernel_adds_less_than_the_cut() -> None:
    _, _, gamma, w, v = _case()
    w[:5], v[5:10] = 0.0, 0.0
    r = reach(gamma, w, v, 1e-4, 0.01)
    phi = np.exp(-gamma * np.square(1.0001 * r))
    assert (np.abs(w) * phi < 1e-4).all()
    assert (v * np.square(phi) < 1e-4).all()
    assert (phi < 0.01).all()
    assert np.isfinite(r).all()


def test_the_chosen_cut_keeps_what_it_leaves_out_within_budget() -> None:
    points, hinge, gamma, w, v = _case(k=3000, seed=3)
    index = build_index(hinge, gamma, w, v, activation_cut=0.0025)
    assert 1e-12 <= index.tau <= 1e-3
    phi = _phi(points, hinge, gamma)
    cut = (np.abs(w) * phi < index.tau) & (v * np.square(phi) < index.tau)
    assert (np.where(cut, np.abs(w) * phi, 0.0).sum(axis=1) / 4.0 < 1e-4).all()


def test_a_known_cut_is_taken_as_it_is() -> None:
    _, hinge, gamma, w, v = _case()
    assert build_index(hinge, gamma, w, v, activation_cut=0.01, tau=3e-5).tau == 3e-5


def test_stacked_kernels_are_counted() -> None:
    rng = np.random.default_rng(0)
    hinge = np.concatenate([np.repeat([[3.3, 4.4, 5.5]], 500, axis=0), rng.uniform(-500, 500, (1000, 3))])
    sizes = stack_sizes(hinge, np.full(1500, 2.0))
    np.testing.assert_array_equal(sizes[:500], 500)
    assert sizes[500:].max() < 10
    apart = stack_sizes(np.zeros((4, 3)), np.array([0.01, 0.01, 8.0, 8.0]))
    np.testing.assert_array_equal(apart, 2)


def test_kernels_of_very_unequal_width() -> None:
    """One level of tiny kernels under a huge box: every one is looked at, none is missed."""
    points, hinge, gamma, w, v = _case(k=800, size=50.0)
    gamma[:300] = 1e6
    points[:50] = hinge[:50] + 1e-4
    sums = latent_sums(build_index(hinge, gamma, w, v, activation_cut=1e-6, tau=1e-9), points)
    np.testing.assert_allclose(sums.mean, _phi(points, hinge, gamma) @ w, atol=1e-3)


def test_no_kernels_and_no_points() -> None:
    points, hinge, gamma, w, v = _case()
    none = build_index(np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros(0), activation_cut=0.01)
    assert not any(np.any(s) for s in latent_sums(none, points))
    assert all(
        len(s) == 0 for s in latent_sums(build_index(hinge, gamma, w, v, activation_cut=0.01), points[:0])
    )


@pytest.mark.parametrize("spread", [0.0, 0.1, 30.0, 1e6])
@pytest.mark.parametrize("n", [1, 7, 2000])
def test_groups_hold_every_point_once_and_stay_small(n: int, spread: float) -> None:
    points = np.random.default_rng(0).normal(size=(n, 3)) * spread + 1e5
    order, cuts = group_points(points, 2.0)
    np.testing.assert_array_equal(np.sort(order), np.arange(n))
    assert cuts[0] == 0
    assert cuts[-1] == n
    assert (np.diff(cuts) > 0).all()
    widest = max(np.ptp(points[order[a:b]], axis=0).max() for a, b in itertools.pairwise(cuts))
    assert widest <= max(2.0 * 1.5 * 1.8, 10 * spread / 2**20)


def test_the_index_is_a_function_of_its_input() -> None:
    points, hinge, gamma, w, v = _case()
    first, again = (build_index(hinge, gamma, w, v, activation_cut=0.01) for _ in range(2))
    assert first.tau == again.tau
    for a, b in zip(latent_sums(first, points), latent_sums(again, points, threads=3), strict=True):
        np.testing.assert_array_equal(a, b)
