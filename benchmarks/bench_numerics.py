"""Times of the hot functions, with the POT library beside the couplings in the same run.

`make bench` prints the table and keeps it as JSON with the machine and the commit. Sizes and accuracies are in `extra_info`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ot
import pytest

from potserver.domain.kernel_map import KernelMap
from potserver.numerics.coupling import Ragged, couple, coupling_costs
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.geometry import rotation_z
from potserver.numerics.threads import default_threads
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

THREADS = (1, default_threads())


def surface(n: int, seed: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """(n, 3) m: points on the ground and two walls of a street, out to 20 m."""
    rng = np.random.default_rng(seed)
    x, y, z = rng.uniform(-20, 20, n), rng.uniform(-8, 8, n), np.zeros(n)
    wall = rng.random(n) < 0.5
    y[wall], z[wall] = np.sign(y[wall]) * rng.uniform(7, 9), rng.uniform(0, 5, int(wall.sum()))
    return np.stack([x, y, z], axis=1).astype(np.float32)


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("n", [100, 200])
def test_ranking(benchmark: Any, n: int, threads: int) -> None:
    """5 sectors x 6 atoms x 8 turns, one label: 240 couplings."""
    atoms = [surface(n, seed) for seed in range(6)]
    sources = Ragged.of(
        [(a @ rotation_z(k * np.pi / 4).T).astype(np.float32) for a in atoms for k in range(8)]
    )
    targets = Ragged.of([surface(n, 100 + seed) for seed in range(5)])
    pairs = np.stack(np.meshgrid(np.arange(48), np.arange(5), indexing="ij"), axis=-1).reshape(-1, 2)
    solved = benchmark(coupling_costs, sources, targets, pairs, reg=12.5, tolerance=1e-4, threads=threads)
    assert solved.converged.all()
    benchmark.extra_info.update(
        n=n, pairs=len(pairs), threads=threads, iterations=float(solved.n_iterations.mean())
    )


def test_ranking_by_the_pot_library(benchmark: Any) -> None:
    """One of the 240 couplings of 200 points, float64, for scale."""
    x, y = surface(200, 0).astype(np.float64), surface(200, 100).astype(np.float64)
    weights, cost = np.full(200, 1 / 200), ot.dist(x, y)
    benchmark(ot.sinkhorn, weights, weights, cost, 12.5, method="sinkhorn", stopThr=1e-7, numItermax=1000)
    benchmark.extra_info.update(n=200, pairs=1)


@pytest.mark.parametrize("n", [300, 1500])
def test_final_coupling(benchmark: Any, n: int) -> None:
    """The authors' final setting: reg .0005 of the largest cost."""
    solved = benchmark(couple, surface(n, 0), surface(n, 1), reg=0.0005, tolerance=1e-4, max_iterations=4000)
    assert solved.converged
    benchmark.extra_info.update(
        n=n, threads=1, iterations=solved.n_iterations, marginal_error=solved.marginal_error
    )


def test_final_coupling_by_the_pot_library(benchmark: Any) -> None:
    """The same 1500 points, float64, at most 2000 iterations as the authors set it."""
    x, y = surface(1500, 0).astype(np.float64), surface(1500, 1).astype(np.float64)
    weights, cost = np.full(1500, 1 / 1500), ot.dist(x, y)

    def solve() -> Any:
        return ot.sinkhorn(
            weights,
            weights,
            cost / cost.max(),
            0.0005,
            method="sinkhorn",
            stopThr=1e-7,
            numItermax=2000,
            warn=False,
        )

    benchmark.pedantic(solve, rounds=1)
    benchmark.extra_info.update(n=1500)


def town(k: int) -> tuple[Any, Any, Any, Any]:
    """K kernels over 156 x 156 x 6 m with heavy-tailed widths and variances."""
    rng = np.random.default_rng(0)
    hinge = np.concatenate([rng.uniform(0, 156, (k, 2)), rng.uniform(0, 6, (k, 1))], axis=1)
    gamma = np.clip(np.exp(rng.normal(np.log(0.9), 1.2, k)), 0.01, 8.0)
    return hinge, gamma, rng.normal(0, 3, k), 10.0 ** rng.uniform(-3, 3.5, k)


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("n_queries", [1_000, 10_000, 100_000])
def test_queries(benchmark: Any, n_queries: int, threads: int) -> None:
    """Points near kernels of a 100 k kernel map."""
    hinge, gamma, weight, variance = town(100_000)
    kernel_map = KernelMap.from_arrays(hinge, gamma, weight, variance, threads=threads)
    rng = np.random.default_rng(1)
    points = hinge[rng.integers(0, len(hinge), n_queries)] + rng.normal(0, 0.5, (n_queries, 3))
    benchmark(kernel_map.occupancy, points)
    benchmark.extra_info.update(kernels=100_000, queries=n_queries, threads=threads)


def test_index(benchmark: Any) -> None:
    """Building the index of 100 k kernels."""
    benchmark(KernelMap.from_arrays, *town(100_000))
    benchmark.extra_info.update(kernels=100_000)


@pytest.mark.parametrize("threads", THREADS)
def test_refinement(benchmark: Any, threads: int) -> None:
    """Weights of about 3,000 kernels on 20,000 labelled points."""
    hits = surface(10_000, 0).astype(np.float64)
    free = hits * np.random.default_rng(1).uniform(0.05, 0.95, (len(hits), 1)) + [0.0, 0.0, 0.5]
    points = np.concatenate([hits, free])
    labels = np.arange(len(points)) < len(hits)
    hinge = np.unique(np.round(points / 1.0), axis=0) * 1.0
    gamma = np.full(len(hinge), 1.4)

    def solve() -> Any:
        blocks = feature_blocks(points, hinge, gamma, edge_m=1.0, cut=0.02, bytes_a_value=1, threads=threads)
        zeros, prior = np.zeros(len(hinge), np.float32), np.full(len(hinge), 50.0, np.float32)
        counts = np.ones(len(points), np.float32)
        return warm_fit(blocks, labels, counts, Prior(zeros, prior), zeros, Solver(4, 8), threads=threads)

    assert benchmark(solve).converged
    benchmark.extra_info.update(points=len(points), kernels=len(hinge), threads=threads)
