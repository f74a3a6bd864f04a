"""What is true of every coupling."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from potserver.numerics.coupling import Ragged, couple, coupling_costs

SEEDS = st.integers(0, 2**31)
SIZES = st.integers(1, 40)
REG = 0.02  # of the largest cost: solved in a few dozen iterations
TOLERANCE = 1e-5


def _pair(seed: int, n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    scale = rng.uniform(0.1, 10.0, 3)
    return (rng.normal(size=(n, 3)) * scale).astype(np.float32), (
        rng.normal(size=(m, 3)) * scale[::-1]
    ).astype(np.float32)


def _solve(x: np.ndarray, y: np.ndarray):
    return couple(x, y, reg=REG, tolerance=TOLERANCE, max_iterations=20_000)


@given(seed=SEEDS, n=SIZES, m=SIZES, reg=st.sampled_from([1e-3, 1e-2, 1e-1, 1.0]))
def test_marginals_are_what_the_solve_says(seed: int, n: int, m: int, reg: float) -> None:
    x, y = _pair(seed, n, m)
    solved = couple(x, y, reg=reg)
    plan = solved.plan.astype(np.float64)
    assert (plan >= 0).all()
    assert np.abs(plan.sum(axis=1) - 1 / n).sum() < 1e-5
    error = np.abs(plan.sum(axis=0) - 1 / m).sum()
    assert error == pytest.approx(solved.marginal_error, abs=1e-5)
    if solved.converged:
        assert error <= 1e-4 + 1e-5
        truth = float((plan * np.square(x[:, None].astype(np.float64) - y[None]).sum(axis=2)).sum())
        assert solved.cost == pytest.approx(truth, rel=1e-4, abs=1e-6)


@given(seed=SEEDS, n=SIZES, m=SIZES)
def test_swapping_source_and_target_transposes_the_plan(seed: int, n: int, m: int) -> None:
    x, y = _pair(seed, n, m)
    there, back = _solve(x, y), _solve(y, x)
    assume(there.converged and back.converged)  # a solve that says it ended early promises nothing
    assert there.cost == pytest.approx(back.cost, rel=1e-3, abs=1e-6)
    assert np.abs(there.plan - back.plan.T).sum() < 2e-3


@given(seed=SEEDS, n=SIZES, m=SIZES)
def test_moving_both_sets_rigidly_changes_nothing(seed: int, n: int, m: int) -> None:
    x, y = _pair(seed, n, m)
    rng = np.random.default_rng(seed + 1)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    shift = rng.uniform(-50, 50, 3)
    moved = [(p @ q.T + shift).astype(np.float32) for p in (x, y)]
    here, there = _solve(x, y), _solve(*moved)
    assert here.converged
    assert there.converged
    assert there.cost == pytest.approx(here.cost, rel=2e-3, abs=1e-4)


@given(seed=SEEDS, n=SIZES, m=SIZES)
def test_the_order_of_the_points_does_not_matter(seed: int, n: int, m: int) -> None:
    x, y = _pair(seed, n, m)
    rng = np.random.default_rng(seed)
    i, j = rng.permutation(n), rng.permutation(m)
    plain, shuffled = _solve(x, y), _solve(x[i], y[j])
    assert np.abs(shuffled.plan - plain.plan[np.ix_(i, j)]).sum() < 2e-3
    assert shuffled.cost == pytest.approx(plain.cost, rel=1e-3, abs=1e-6)


@settings(max_examples=25)
@given(seed=SEEDS, sizes=st.lists(SIZES, min_size=1, max_size=5), reg=st.sampled_from([0.5, 5.0]))
def test_a_ragged_batch_is_its_problems_one_by_one_on_any_number_of_threads(
    seed: int, sizes: list[int], reg: float
) -> None:
    sources = [_pair(seed + i, n, 1)[0] for i, n in enumerate(sizes)]
    targets = [_pair(seed + 1000 + i, 1, n)[1] for i, n in enumerate(reversed(sizes))]
    pairs = np.stack(np.meshgrid(np.arange(len(sizes)), np.arange(len(sizes))), axis=-1).reshape(-1, 2)
    batch, threaded = (
        coupling_costs(Ragged.of(sources), Ragged.of(targets), pairs, reg=reg, threads=threads)
        for threads in (1, 3)
    )
    for one, other in zip(batch, threaded, strict=True):
        np.testing.assert_array_equal(one, other)
    for p, (s, t) in enumerate(pairs):
        alone = coupling_costs(
            Ragged.of([sources[s]]), Ragged.of([targets[t]]), np.zeros((1, 2), np.int64), reg=reg
        )
        assert alone.cost[0] == batch.cost[p]
        assert alone.n_iterations[0] == batch.n_iterations[p]
        assert alone.converged[0] == batch.converged[p]


@given(
    seed=SEEDS,
    n=SIZES,
    m=SIZES,
    exponent=st.integers(-30, 30),
    reg=st.sampled_from([1e-9, 1e-6, 1e-3, 1.0, 1e6]),
    relative=st.booleans(),
    copies=st.integers(1, 3),
)
def test_no_solve_claims_success_with_numbers_that_are_not_finite(
    seed: int, n: int, m: int, exponent: int, reg: float, relative: bool, copies: int
) -> None:
    x, y = _pair(seed, n, m)
    x, y = np.repeat(x, copies, axis=0) * np.float32(10.0**exponent), y * np.float32(10.0**exponent)
    solved = couple(x, y, reg=reg, relative=relative, max_iterations=60)
    if solved.converged:
        assert np.isfinite(solved.cost)
        assert np.isfinite(solved.plan).all()
        assert abs(float(solved.plan.sum(dtype=np.float64)) - 1.0) < 1e-3
    batch = coupling_costs(
        Ragged.of([x]),
        Ragged.of([y]),
        np.zeros((1, 2), np.int64),
        reg=reg,
        relative=relative,
        max_iterations=60,
    )
    assert np.isfinite(batch.cost[batch.converged]).all()
