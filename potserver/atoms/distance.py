"""How far atoms are from one another: the squared 2-Wasserstein distance of their hits plus that of their free points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import attrgetter

import numpy as np

from potserver.domain.types import Atom, Float32, Float64
from potserver.numerics.coupling import Ragged, coupling_costs
from potserver.numerics.geometry import thin

_VOXEL_M = 0.4  # points compared are thinned to one a voxel first
_REG_M2 = 2.0  # weight of the entropy; it blurs the couplings: an atom's distance to itself is above zero


def atom_distances(
    a: Sequence[Atom], b: Sequence[Atom], *, n_hits: int = 100, n_free: int = 60, threads: int = 1
) -> Float64:
    """Compare every atom of `a` with every atom of `b`, as they lie: neither is turned.

    Args:
        a: A atoms.
        b: B atoms.
        n_hits, n_free: Points of each label that are compared, at most.
        threads: Threads to spread the problems over.
    Returns:
        (A, B) m^2, hits plus free points, each pair about the means of its hits (of its free points where one has no
        hits); infinite where a solve did not converge or only one of the two has points of a label. The same two atoms
        always have the same distance.
    Source: paper eq. 6.
    """
    distance = np.zeros((len(a), len(b)))
    for points_of, count in ((attrgetter("hit_points"), n_hits), (attrgetter("free_points"), n_free)):
        distance += _of_label(a, b, points_of, count, threads)
    return distance


def near_in_spread(atom: Atom, other: Atom, limit_m2: float) -> bool:
    """Whether two atoms may be nearer than a limit. False is certain; it costs microseconds.

    The squared 2-Wasserstein distance of two sets is at least the sum over the axes of that of their projections. That of two
    projections is at least the squared difference of the means plus that of the standard deviations.
    """
    bound = 0.0
    centre, other_centre = atom.centre, other.centre
    for points, others in ((atom.hit_points, other.hit_points), (atom.free_points, other.free_points)):
        if len(points) and len(others):
            shift = (points.mean(axis=0) - centre) - (others.mean(axis=0) - other_centre)
            spread = points.std(axis=0) - others.std(axis=0)
            bound += float(np.square(shift).sum() + np.square(spread).sum())
        elif len(points) != len(others):
            return False
    return bound < limit_m2


def _of_label(
    a: Sequence[Atom],
    b: Sequence[Atom],
    points_of: Callable[[Atom], Float32],
    count: int,
    threads: int,
) -> Float64:
    rows = [_thinned(atom, points_of(atom), count) for atom in a]
    columns = rows if a is b else [_thinned(atom, points_of(atom), count) for atom in b]
    row_has = np.array([len(points) > 0 for points in rows], bool)
    column_has = np.array([len(points) > 0 for points in columns], bool)
    costs = np.where(row_has[:, None] == column_has[None, :], 0.0, np.inf)  # both without: nothing differs
    i, j = np.nonzero(row_has[:, None] & column_has[None, :])
    row_set, column_set = np.cumsum(row_has) - 1, np.cumsum(column_has) - 1
    solved = coupling_costs(
        Ragged.of([points for points in rows if len(points)]),
        Ragged.of([points for points in columns if len(points)]),
        np.stack([row_set[i], column_set[j]], axis=1),
        reg=_REG_M2,
        tolerance=1e-3,
        threads=threads,
    )
    costs[i, j] = np.where(solved.converged, solved.cost, np.inf)
    return costs


def _thinned(atom: Atom, points: Float32, count: int) -> Float32:
    """(n, 3) m about the atom's centre; the choice depends on the points alone, so that equal atoms stay equal."""
    if len(points) == 0:
        return points
    picked = thin(points, count, _VOXEL_M, np.random.default_rng(0))
    return (points[picked] - atom.centre).astype(np.float32)
