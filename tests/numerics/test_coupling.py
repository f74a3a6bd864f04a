"""Couplings: packing, refusals, how a solve ends, and point sets that are no real problem."""

from __future__ import annotations

import math

import numpy as np
import pytest

from potserver.errors import EmptyError, ShapeError
from potserver.numerics.coupling import Coupling, CouplingCosts, Ragged, couple, coupling_costs


def _cloud(seed: int, n: int, spread: float = 5.0) -> np.ndarray:
    return (np.random.default_rng(seed).normal(size=(n, 3)) * spread).astype(np.float32)


def _honest(solved: Coupling | CouplingCosts) -> None:
    """A solve that says it converged has only finite numbers."""
    converged = np.atleast_1d(solved.converged)
    assert np.isfinite(np.atleast_1d(solved.cost)[converged]).all()
    assert np.isfinite(np.atleast_1d(solved.marginal_error)[converged]).all()
    if isinstance(solved, Coupling) and solved.converged:
        for array in (solved.plan, solved.source_potential, solved.target_potential):
            assert np.isfinite(array).all()


def test_ragged_gives_back_what_was_packed() -> None:
    sets = [_cloud(i, n) for i, n in enumerate((3, 1, 8))]
    packed = Ragged.of(sets)
    assert len(packed) == 3
    for i, points in enumerate(sets):
        np.testing.assert_array_equal(packed.set(i), points)
    assert len(Ragged.of([])) == 0


@pytest.mark.parametrize("points", [np.zeros((4, 2)), np.zeros(3), np.zeros((2, 3, 1))])
def test_ragged_refuses_other_shapes(points: np.ndarray) -> None:
    with pytest.raises(ShapeError):
        Ragged.of([points])
    with pytest.raises(ShapeError):
        couple(points, _cloud(0, 3), reg=0.01)


def test_an_empty_set_has_no_coupling() -> None:
    with pytest.raises(EmptyError):
        Ragged.of([_cloud(0, 3), np.zeros((0, 3), np.float32)])
    with pytest.raises(EmptyError):
        couple(_cloud(0, 3), np.zeros((0, 3), np.float32), reg=0.01)


@pytest.mark.parametrize("reg", [0.0, -1.0, math.nan, math.inf])
def test_reg_must_be_positive(reg: float) -> None:
    packed = Ragged.of([_cloud(0, 3)])
    with pytest.raises(ValueError, match="reg"):
        couple(_cloud(0, 3), _cloud(1, 3), reg=reg)
    with pytest.raises(ValueError, match="reg"):
        coupling_costs(packed, packed, np.zeros((1, 2), np.int64), reg=reg)


@pytest.mark.parametrize("pairs", [[[0, 1]], [[1, 0]], [[-1, 0]], [[0, -1]]])
def test_pairs_must_name_sets_that_exist(pairs: list[list[int]]) -> None:
    packed = Ragged.of([_cloud(0, 3)])
    with pytest.raises(ShapeError):
        coupling_costs(packed, packed, np.asarray(pairs), reg=1.0)
    with pytest.raises(ShapeError):
        coupling_costs(packed, packed, np.zeros((2, 3), np.int64), reg=1.0)


def test_no_pairs_no_costs() -> None:
    solved = coupling_costs(Ragged.of([]), Ragged.of([]), np.zeros((0, 2), np.int64), reg=1.0)
    assert all(len(field) == 0 for field in solved)


def test_a_batch_solves_the_pairs_it_is_given_in_that_order() -> None:
    sources, targets = [_cloud(1, 20), _cloud(2, 30)], [_cloud(3, 25), _cloud(4, 10, 9.0)]
    pairs = np.array([[1, 1], [0, 0], [1, 0], [0, 1], [0, 0]])
    batch = coupling_costs(
        Ragged.of(sources), Ragged.of(targets), pairs, reg=0.01, relative=True, tolerance=1e-4
    )
    for p, (s, t) in enumerate(pairs):
        alone = couple(sources[s], targets[t], reg=0.01)
        assert float(batch.cost[p]) == pytest.approx(alone.cost, rel=1e-3)
    assert batch.cost[1] == batch.cost[4]


@pytest.mark.parametrize("max_iterations", [1, 3])
def test_a_solve_cut_short_says_so(max_iterations: int) -> None:
    x, y = _cloud(1, 60), _cloud(2, 80)
    alone = couple(x, y, reg=0.0005, max_iterations=max_iterations)
    batch = coupling_costs(
        Ragged.of([x]), Ragged.of([y]), np.zeros((1, 2), np.int64), reg=0.1, max_iterations=max_iterations
    )
    assert not alone.converged
    assert alone.n_iterations <= max_iterations
    assert alone.marginal_error > 0.01
    assert not batch.converged.any()
    assert (batch.n_iterations <= max_iterations).all()


def test_the_marginal_error_is_that_of_the_plan() -> None:
    for max_iterations in (5, 40, 2000):
        solved = couple(_cloud(1, 60), _cloud(2, 80), reg=0.001, max_iterations=max_iterations)
        plan = solved.plan.astype(np.float64)
        true_error = np.abs(plan.sum(axis=0) - 1 / 80).sum() + np.abs(plan.sum(axis=1) - 1 / 60).sum()
        assert solved.marginal_error == pytest.approx(true_error, abs=2e-6, rel=1e-2)
        assert solved.converged == (true_error <= 1e-4)


def test_mass_that_has_to_go_far_is_not_called_done_early() -> None:
    """Two clusters of unequal share: scaling moves the last mass between them very slowly."""
    left, right = _cloud(1, 30), _cloud(2, 30) + np.float32([1000, 0, 0])
    solved = couple(
        np.concatenate([left, right]), np.concatenate([left[:10], right, left[:20] + np.float32([1000, 0, 0])]),
        reg=1e-4, max_iterations=300,
    )  # fmt: skip
    plan = solved.plan.astype(np.float64)
    if solved.converged:
        assert np.abs(plan.sum(axis=0) - 1 / 60).sum() < 1e-3
    else:
        assert solved.marginal_error > 1e-4


LINE = np.stack([np.linspace(0, 20, 50), np.zeros(50), np.zeros(50)], axis=1).astype(np.float32)
DEGENERATE = {
    "one point each": (_cloud(1, 1), _cloud(2, 1)),
    "one point to itself": (_cloud(1, 1), _cloud(1, 1)),
    "one point to many": (_cloud(1, 1), _cloud(2, 40)),
    "many points to one": (_cloud(2, 40), _cloud(1, 1)),
    "all on one spot": (np.repeat(_cloud(1, 1), 7, axis=0), np.repeat(_cloud(1, 1), 3, axis=0)),
    "two spots": (np.repeat(_cloud(1, 1), 7, axis=0), np.repeat(_cloud(2, 1), 3, axis=0)),
    "on a line": (LINE, LINE[:33] + np.float32([0, 1, 0])),
    "the same set": (LINE, LINE),
    "duplicates": (np.repeat(_cloud(1, 20), 3, axis=0), np.repeat(_cloud(2, 30), 2, axis=0)),
    "far from the origin": (_cloud(1, 30) + np.float32(1e6), _cloud(2, 30) + np.float32(1e6)),
    "far from each other": (_cloud(1, 30), _cloud(2, 30) + np.float32(1e5)),
    "as large as planets": (_cloud(1, 30) * np.float32(1e6), _cloud(2, 30) * np.float32(1e6)),
    "smaller than atoms": (_cloud(1, 30) * np.float32(1e-20), _cloud(2, 30) * np.float32(1e-20)),
    "squares overflow": (_cloud(1, 30) * np.float32(1e20), _cloud(2, 30) * np.float32(1e20)),
    "squares underflow": (_cloud(1, 30) * np.float32(1e-25), _cloud(2, 30) * np.float32(1e-25)),
}


@pytest.mark.parametrize("reg", [1e-6, 5e-4, 1e-2])
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_sets_end_finite_or_say_that_they_failed(name: str, reg: float) -> None:
    x, y = DEGENERATE[name]
    _honest(couple(x, y, reg=reg, max_iterations=300))
    for relative in (True, False):
        _honest(
            coupling_costs(
                Ragged.of([x]),
                Ragged.of([y]),
                np.zeros((1, 2), np.int64),
                reg=reg,
                relative=relative,
                max_iterations=300,
            )
        )


@pytest.mark.parametrize("name", ["one point each", "one point to many", "two spots", "all on one spot"])
def test_trivial_sets_have_their_obvious_cost(name: str) -> None:
    x, y = DEGENERATE[name]
    solved = couple(x, y, reg=0.01)
    assert solved.converged
    truth = np.square(x[:, None].astype(np.float64) - y[None]).sum(axis=2).mean()
    assert solved.cost == pytest.approx(truth, rel=1e-5, abs=1e-6)


def test_an_overflowing_solve_is_not_converged() -> None:
    x, y = DEGENERATE["squares overflow"]
    assert not couple(x, y, reg=0.01).converged
    assert not coupling_costs(
        Ragged.of([x]), Ragged.of([y]), np.zeros((1, 2), np.int64), reg=2.0
    ).converged.any()
    assert not couple(_cloud(1, 30), _cloud(2, 30), reg=1e-30).converged
