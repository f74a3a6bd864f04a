"""Equations 3 and 4: the entropic coupling, against POT in float64 and against the linear program."""

from __future__ import annotations

import itertools

import numpy as np
import ot
import pytest

from potserver.numerics.coupling import Ragged, couple, coupling_costs
from tests.conformance import reference

RANK_REG = 0.005 * 50.0**2  # the authors' 0.005 in coordinates divided by 50: 12.5 m^2
FINAL_REG = 0.0005  # of the largest cost


def _walls(rng: np.random.Generator, n: int, dims: int) -> np.ndarray:
    """A corner of two walls within 20 m, centred, as sectors are."""
    along, which = rng.uniform(-8.0, 8.0, n), rng.random(n) < 0.5
    height = rng.uniform(-1.5, 3.0, n) if dims == 3 else np.zeros(n)
    points = np.stack([np.where(which, along, 6.0), np.where(which, 5.0, along), height], axis=1)
    points[:, :2] += rng.normal(0.0, 0.05, (n, 2))
    return (points - points.mean(axis=0)).astype(np.float32)


def _truth(x: np.ndarray, y: np.ndarray, reg: float, method: str) -> tuple[np.ndarray, float]:
    cost = reference.squared_distances(x, y)
    plan = ot.sinkhorn([], [], cost, reg, method=method, stopThr=1e-9, numItermax=50_000)
    return plan, float((plan * cost).sum())


@pytest.mark.parametrize("method", ["sinkhorn", "sinkhorn_log"])
@pytest.mark.parametrize(("n", "m", "dims"), [(200, 200, 2), (200, 120, 3), (37, 50, 3)])
def test_eq4_at_the_ranking_settings(n: int, m: int, dims: int, method: str) -> None:
    rng = np.random.default_rng(n + m)
    x, y = _walls(rng, n, dims), _walls(rng, m, dims) * np.float32(0.8)
    plan, cost = _truth(x, y, RANK_REG, method)
    ours = couple(x, y, reg=RANK_REG, relative=False, tolerance=1e-5)
    assert ours.converged
    assert ours.cost == pytest.approx(cost, rel=1e-4)
    assert np.abs(ours.plan - plan).sum() < 1e-3
    batch = coupling_costs(Ragged.of([x]), Ragged.of([y]), np.zeros((1, 2), np.int64), reg=RANK_REG)
    assert batch.converged.all()
    assert float(batch.cost[0]) == pytest.approx(cost, rel=1e-4)


@pytest.mark.parametrize("dims", [2, 3])
def test_eq4_at_the_final_settings(dims: int) -> None:
    """500 points, reg 0.0005 of the largest cost, which is the authors' 0.0005 on the cost divided by its maximum."""
    rng = np.random.default_rng(dims)
    x, y = _walls(rng, 500, dims), (reference.rotated(_walls(rng, 450, dims), 0.2) * 1.1).astype(np.float32)
    ours = couple(x, y, reg=FINAL_REG, max_iterations=20_000)
    assert ours.converged
    cost = reference.squared_distances(x, y)
    assert ours.reg == pytest.approx(FINAL_REG * cost.max(), rel=1e-5)
    # eq. 4 has one solution, wherever a solver starts; from nowhere, POT would need minutes to get there
    start = (ours.source_potential.astype(np.float64), ours.target_potential.astype(np.float64))
    plan = ot.bregman.sinkhorn_stabilized(
        np.full(500, 1 / 500), np.full(450, 1 / 450), cost, FINAL_REG * cost.max(), stopThr=1e-8, numItermax=20_000,
        warmstart=start,
    )  # fmt: skip
    assert np.abs(plan.sum(axis=0) - 1 / 450).sum() + np.abs(plan.sum(axis=1) - 1 / 500).sum() < 1e-6
    assert ours.cost == pytest.approx(float((plan * cost).sum()), rel=1e-4)
    assert np.abs(ours.plan - plan).sum() < 1e-3


@pytest.mark.parametrize("reg", [1e-3, 1e-2, 0.1])
def test_eq3_rows_and_columns_of_the_plan(reg: float) -> None:
    """Row C18: rows sum to 1/n and columns to 1/m, not to one."""
    rng = np.random.default_rng(5)
    x, y = _walls(rng, 90, 3), _walls(rng, 140, 3)
    plan = couple(x, y, reg=reg, tolerance=1e-5, max_iterations=5_000).plan.astype(np.float64)
    assert np.abs(plan.sum(axis=1) - 1 / 90).sum() < 1e-5
    assert np.abs(plan.sum(axis=0) - 1 / 140).sum() < 2e-5


def test_eq4_plan_has_the_form_that_its_potentials_say() -> None:
    """P_ij = exp((f_i + g_j - D_ij) / reg) / (n m): the stationary point of eq. 4."""
    rng = np.random.default_rng(6)
    x, y = _walls(rng, 60, 3), _walls(rng, 80, 3)
    ours = couple(x, y, reg=0.002)
    exponent = (
        ours.source_potential[:, None] + ours.target_potential - reference.squared_distances(x, y)
    ) / ours.reg
    np.testing.assert_allclose(ours.plan, np.exp(exponent) / (60 * 80), rtol=2e-3, atol=1e-9)


def test_eq4_with_growing_lambda_tends_to_the_linear_program() -> None:
    """lambda = 1 / reg: the cost falls to that of ot.emd2 and the plan becomes as sparse."""
    rng = np.random.default_rng(7)
    x, y = _walls(rng, 50, 3), (_walls(rng, 50, 3) + np.float32(1.0)).astype(np.float32)
    exact = float(ot.emd2([], [], reference.squared_distances(x, y)))
    gaps = []
    for reg in (3e-2, 1e-2, 3e-3, 1e-3, 3e-4):
        ours = couple(x, y, reg=reg, tolerance=1e-4, max_iterations=50_000)
        assert ours.converged, reg
        gaps.append(ours.cost - exact)
    assert all(earlier > later for earlier, later in itertools.pairwise(gaps)), gaps
    assert -1e-3 * exact < gaps[-1] < 0.005 * exact, (gaps, exact)
    assert gaps[0] > 0.05 * exact, "the largest reg must be visibly blurred, or the limit shows nothing"
