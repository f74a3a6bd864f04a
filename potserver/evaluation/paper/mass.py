"""Couplings that need not move all mass: unbalanced and partial transport, in plain numpy, for comparison only.

Unbalanced: marginals may differ, at a price (Chizat et al. 2018). Partial: only a share of the mass moves, the rest goes to a
bin that costs nothing (Chapel, Alaya and Gasso 2020). A point whose mass stays behind still has a row of the plan, and moves to
where that row points.
"""

from __future__ import annotations

import numpy as np

from potserver.mapping.transport import Solve
from potserver.numerics.arrays import Float32, Float64
from potserver.numerics.coupling import Coupling, couple

_PRICE = 0.05  # of mass made or lost, as a share of the largest cost
_SHARE = 0.7  # of the mass that moves
_BARRED = 10.0  # largest costs: what it costs to send the bin's mass to the other bin
_CHECK_EVERY = 10


def unbalanced(
    source: Float32, target: Float32, *, reg: float, tolerance: float, max_iterations: int
) -> Coupling:
    """The coupling of eq. 4 with marginals that may differ, see `couple` for the arguments."""
    cost = _costs(source, target)
    largest = cost.max()
    eps, price = reg * largest, _PRICE * largest
    a, b = (np.full(n, -np.log(n)) for n in cost.shape)
    f, g, error, n_done = _scaled(cost, a, b, eps, price / (price + eps), tolerance, max_iterations)
    return _coupling(cost, a, b, (f, g), eps, error, n_done, tolerance)


def partial_share(
    source: Float32, target: Float32, *, reg: float, tolerance: float, max_iterations: int
) -> Coupling:
    """The coupling of eq. 4 of a share of the mass, see `couple` for the arguments."""
    cost = _costs(source, target)
    n, m = cost.shape
    largest = cost.max()
    wide = np.zeros((n + 1, m + 1))
    wide[:n, :m], wide[n, m] = cost, _BARRED * largest
    a, b = (np.log(np.append(np.full(k, 1.0 / k), 1.0 - _SHARE) / (2.0 - _SHARE)) for k in (n, m))
    eps = reg * largest
    f, g, error, n_done = _scaled(wide, a, b, eps, 1.0, tolerance, max_iterations)
    return _coupling(cost, a[:n], b[:m], (f[:n], g[:m]), eps, error, n_done, tolerance)


MASS: dict[str, Solve] = {
    "balanced": couple,
    f"unbalanced, price {_PRICE:g} of the largest cost": unbalanced,
    f"partial, {_SHARE:.0%} of the mass": partial_share,
}


def _costs(source: Float32, target: Float32) -> Float64:
    return np.asarray(np.square(source.astype(np.float64)[:, None] - target.astype(np.float64)).sum(axis=2))


def _soft_min(costs: Float64, log_mass: Float64, eps: float) -> Float64:
    """(N,) -eps log sum_j mass_j exp(-costs_ij / eps)."""
    exponent = log_mass - costs / eps
    highest = exponent.max(axis=1)
    return np.asarray(-eps * (highest + np.log(np.exp(exponent - highest[:, None]).sum(axis=1))))


def _scaled(
    cost: Float64, a: Float64, b: Float64, eps: float, power: float, tolerance: float, max_iterations: int
) -> tuple[Float64, Float64, float, int]:
    """Potentials after Sinkhorn's iterations in logarithms, the last relative change, and how many there were."""
    f, g = np.zeros(cost.shape[0]), np.zeros(cost.shape[1])
    change, level, n_done = np.inf, max(eps, 0.05 * float(cost.max())), 0
    while n_done < max_iterations:
        n_done += 1
        level = max(
            eps, 0.8 * level
        )  # the blur is lowered step by step, or the first iterations gain nothing
        before = f
        f = power * _soft_min(cost - g, b, level)
        g = power * _soft_min(cost.T - f, a, level)
        if n_done % _CHECK_EVERY == 0 and level == eps:
            change = float(np.abs(f - before).max() / eps)
            if change <= tolerance:
                break
    return f, g, change, n_done


def _coupling(
    cost: Float64,
    a: Float64,
    b: Float64,
    potentials: tuple[Float64, Float64],
    eps: float,
    change: float,
    n_done: int,
    tolerance: float,
) -> Coupling:
    f, g = potentials
    log_plan = (f[:, None] + g - cost) / eps + a[:, None] + b
    plan = np.exp(log_plan)
    # rows may hold next to nothing: each keeps its direction
    plan = np.maximum(plan, np.exp(log_plan - log_plan.max(axis=1, keepdims=True)) * 1e-30)
    return Coupling(
        plan.astype(np.float32), float((plan * cost).sum()), f.astype(np.float32), g.astype(np.float32), float(eps),
        change, n_done, change <= max(tolerance, 0.05) and bool(np.isfinite(plan).all()),
    )  # fmt: skip
