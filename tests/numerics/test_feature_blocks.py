"""Blocks of features against a dense float64 matrix."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics import feature_blocks as fb
from potserver.numerics.feature_blocks import feature_blocks


@pytest.fixture(scope="module")
def case() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    points, hinge = rng.uniform(0, 12, (900, 3)), rng.uniform(-1, 13, (400, 3))
    gamma = rng.choice([0.5, 3.0], 400)
    d2 = np.square(points[:, None] - hinge[None]).sum(axis=2)
    return points, hinge, gamma, np.exp(-gamma * d2)


def _dense(blocks: fb.Blocks) -> np.ndarray:
    out = np.zeros((len(blocks.order), blocks.n_kernels))
    for part in blocks.parts:
        for c in range(len(part.cuts) - 1):
            numbers = part.numbers[part.kernels[c] : part.kernels[c + 1]]
            phi = part.phi[part.starts[c] : part.starts[c + 1]].reshape(-1, len(numbers))
            for r, row in zip(range(part.cuts[c], part.cuts[c + 1]), phi, strict=True):
                np.add.at(out[blocks.order[r]], numbers, row)
    return out


@pytest.mark.parametrize("edge_m", [0.3, 1.0, 30.0])
@pytest.mark.parametrize("threads", [1, 3])
def test_every_feature_above_the_cut_is_there(case, edge_m: float, threads: int) -> None:
    points, hinge, gamma, truth = case
    blocks = feature_blocks(points, hinge, gamma, edge_m=edge_m, cut=0.02, threads=threads)
    dense = _dense(blocks)
    stored = dense > 0
    np.testing.assert_allclose(dense[stored], truth[stored], rtol=2e-4, atol=1e-7)
    assert stored[truth >= 0.021].all()
    assert blocks.n_values == sum(len(p.phi) for p in blocks.parts) >= stored.sum()


@pytest.mark.parametrize("bytes_a_value", [1, 4])
def test_products(case, bytes_a_value: int) -> None:
    points, hinge, gamma, _ = case
    rng = np.random.default_rng(1)
    blocks = feature_blocks(
        points, hinge, gamma, edge_m=1.0, cut=0.02, bytes_a_value=bytes_a_value, threads=2
    )
    phi = _dense(blocks)[blocks.order] * blocks.unit
    w, r, c = (rng.normal(size=n).astype(np.float32) for n in (400, 900, 900))
    c = np.abs(c)
    np.testing.assert_allclose(fb.product(blocks, w), phi @ w, atol=1e-4)
    gradient, diagonal = fb.gradient_and_diagonal(blocks, r, c)
    np.testing.assert_allclose(gradient, phi.T @ r, atol=1e-4)
    np.testing.assert_allclose(diagonal, np.square(phi).T @ c, atol=1e-4)
    one, other = fb.two_diagonals(blocks, c, r)
    np.testing.assert_allclose(one, np.square(phi).T @ c, atol=1e-4)
    np.testing.assert_allclose(other, np.square(phi).T @ r, atol=1e-4)
    np.testing.assert_allclose(fb.normal_product(blocks, c, w), phi.T @ (c * (phi @ w)), atol=1e-3)


def test_products_are_the_same_to_the_bit_on_any_number_of_threads(case) -> None:
    points, hinge, gamma, _ = case
    w, c = np.linspace(-1, 1, 400, dtype=np.float32), np.ones(900, np.float32)
    results = []
    for threads in (1, 2, 5):
        blocks = feature_blocks(points, hinge, gamma, edge_m=1.0, cut=0.02, threads=threads)
        results.append(
            (
                *fb.gradient_and_diagonal(blocks, c, c, threads=threads),
                fb.normal_product(blocks, c, w, threads=threads),
            )
        )
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("n", "k"), [(0, 5), (5, 0)])
def test_nothing(n: int, k: int) -> None:
    blocks = feature_blocks(np.zeros((n, 3)), np.zeros((k, 3)), np.ones(k), edge_m=1.0, cut=0.02)
    assert blocks.n_values == 0
    assert len(fb.product(blocks, np.zeros(k, np.float32))) == n
    assert len(fb.gradient_and_diagonal(blocks, np.zeros(n, np.float32), np.zeros(n, np.float32))[0]) == k
    assert len(fb.normal_product(blocks, np.zeros(n, np.float32), np.zeros(k, np.float32))) == k
