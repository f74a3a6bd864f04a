"""Iterative closest point in place of a coupling: the rigid alignment that transport is said to go beyond."""

from __future__ import annotations

import numpy as np

from potserver.numerics.arrays import Float32
from potserver.numerics.coupling import Coupling
from potserver.numerics.displacement import rigid_map


def icp(source: Float32, target: Float32, *, reg: float, tolerance: float, max_iterations: int) -> Coupling:
    """Each source point coupled to the target nearest to it, once it is moved by the rigid map that these pairs give.

    `rigid_map` of the coupling's images is the alignment (Besl and McKay 1992). Their clouds' centres begin on each other.

    Args:
        source: (n, 3) m.
        target: (m, 3) m.
        reg, tolerance: Of `couple`; there is no entropy here, and the columns may sum to anything.
        max_iterations: It has converged when the pairs stay.
    """
    x, y = source.astype(np.float64), target.astype(np.float64)
    moved, pairs, converged, n_done = x, np.full(len(x), -1), False, 0
    while not converged and n_done < max_iterations:
        n_done += 1
        before, pairs = pairs, np.square(moved[:, None] - y).sum(axis=2).argmin(axis=1)
        converged = bool((pairs == before).all())
        rotation, shift = rigid_map(x, y[pairs])
        moved = x @ rotation + shift
    plan = np.zeros((len(x), len(y)), np.float32)
    plan[np.arange(len(x)), pairs] = 1.0 / len(x)
    cost = float(np.square(x - y[pairs]).sum(axis=1).mean())
    error = float(np.abs(plan.sum(axis=0) - 1.0 / len(y)).sum())
    none = np.zeros(len(x), np.float32), np.zeros(len(y), np.float32)
    return Coupling(plan, cost, *none, reg, error, n_done, converged)
