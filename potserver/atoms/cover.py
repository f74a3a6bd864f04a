"""Which atoms to keep: a greedy cover, so that every candidate has a kept atom near it and no two kept ones are alike."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potserver.atoms.distance import atom_distances
from potserver.domain.types import Atom, Float64
from potserver.errors import EmptyError, ShapeError
from potserver.mapping.matching import Ranking
from potserver.numerics.geometry import rotation_z

_DISTANCE_DECIMALS = 3  # compared in these: last bits must not decide
# Points of each label that are compared. Two draws of one outdoor sector are 2 m apart with so many, 3 m with half of them.
_HITS, _FREE = 200, 120
_QUANTILES = (np.arange(16) + 0.5) / 16


class Cover(NamedTuple):
    """The choice among N candidates."""

    chosen: list[int]  # in the order of choice
    covered_by: NDArray[np.int64]  # (N,) a chosen one within the tolerance; itself if chosen; -1 = none
    distance_m: Float64  # (N,) least distance to a chosen one that was computed; infinite if none was


def greedy_cover(
    atoms: Sequence[Atom],
    content_nats: ArrayLike,
    tolerance_m: ArrayLike,
    *,
    max_atoms: int | None = None,
    group: Sequence[int] | None = None,
    max_of_group: Sequence[int | None] = (),
    threads: int = 1,
    on_chosen: Callable[[int, int], None] | None = None,
) -> Cover:
    """Take the atom that tells most, then again and again the one that would be missed most, until all are near enough.

    What is missed without an atom is its content times its distance from all chosen, in units of its own tolerance: a
    farthest-first cover with weights. Atoms are weighed by what they tell and not by their NLL: a lone wall at arm's length has
    the lowest NLL and tells next to nothing, since a constant predicts it nearly as well. Distances are those of `distances_m`.
    What is covered is not compared again: the work is at most one distance for each chosen atom and each candidate. The choice
    does not depend on the order of the candidates.

    Args:
        atoms: N candidates of one number of dimensions, with different ids.
        content_nats: (N,) how much each tells about the beams held out of it: the gain in log-likelihood over the share of
            occupied points among them, summed over these points. Less than 1 counts as 1.
        tolerance_m: (N,) or one number: a candidate this near to a chosen atom is not needed.
        max_atoms: Stop at so many, covered or not.
        group: (N,) numbers from 0, for `max_of_group`; default: all in group 0.
        max_of_group: At most so many are taken of each group; then the rest of it is left out.
        threads: For the distances.
        on_chosen: Called after each choice with the number chosen and the number still to be covered.
    Raises:
        EmptyError: no candidates.
        ShapeError: an argument of another length than the atoms.
    """
    n = len(atoms)
    if n == 0:
        raise EmptyError("no atoms to choose from")
    content = np.maximum(np.round(np.asarray(content_nats, np.float64)), 1.0)
    tolerance = np.broadcast_to(np.asarray(tolerance_m, np.float64), n)
    groups = np.zeros(n, np.int64) if group is None else np.asarray(group, np.int64)
    if content.shape != (n,) or groups.shape != (n,):
        raise ShapeError(f"{n} atoms, but content_nats {content.shape} and group {groups.shape}")
    left = dict(enumerate(max_of_group))
    compared = _Compared(atoms, threads)
    distance = np.full(n, np.inf)
    covered_by = np.full(n, -1, np.int64)
    is_open = np.ones(n, bool)
    chosen: list[int] = []
    while is_open.any() and (max_atoms is None or len(chosen) < max_atoms):
        far = distance / np.maximum(tolerance, 1e-9) if chosen else np.ones(n)
        missed = np.where(is_open, content * far, -1.0)
        best = min(np.flatnonzero(missed == missed.max()).tolist(), key=lambda i: atoms[i].atom_id)
        chosen.append(best)
        is_open[best], covered_by[best], distance[best] = False, best, 0.0
        compared.lower(distance, best, np.flatnonzero(is_open))
        covered = is_open & (distance <= tolerance)
        covered_by[covered] = best
        is_open &= ~covered
        room = left.get(int(groups[best]))
        if room is not None:
            left[int(groups[best])] = room - 1
            if room <= 1:
                is_open &= groups != groups[best]
        if on_chosen is not None:
            on_chosen(len(chosen), int(is_open.sum()))
    return Cover(chosen, covered_by, distance)


def distances_m(one: Atom, others: Sequence[Atom], *, threads: int = 1) -> Float64:
    """(N,) m, to the millimetre: how far an atom is from others, the least over the turns that mapping tries.

    The root of the squared 2-Wasserstein distance of hits plus that of free points, without the blur of the entropy: half of
    either atom's distance to itself is taken off, so that equal atoms are at 0. Infinite where a solve failed.
    """
    return _Compared([one, *others], threads).distances(0, np.arange(1, len(others) + 1))


class _Compared:
    """The candidates, with what is worth computing once for each of them."""

    def __init__(self, atoms: Sequence[Atom], threads: int) -> None:
        self._atoms, self._threads = atoms, threads
        blur = np.array([float(self._blurred([atom], [atom])[0, 0]) for atom in atoms])
        # a failed solve leaves the blur in: farther, never nearer
        self._blur = np.where(np.isfinite(blur), blur, 0.0)
        self._profile = np.stack([_profile(atom) for atom in atoms])

    def lower(self, distance: Float64, one: int, others: NDArray[np.intp]) -> None:
        """Lower the least distances (N,) by those between one atom and some others."""
        # projections on the axes can only be nearer than the points themselves: most others need no solve
        turned = np.stack([_profile(atom) for atom in _turns(self._atoms[one])])
        bound = np.square(turned[:, None] - self._profile[others]).sum(axis=2).min(axis=0)
        worth = others[np.sqrt(bound) < distance[others]]
        distance[worth] = np.minimum(distance[worth], self.distances(one, worth))

    def distances(self, one: int, others: NDArray[np.intp]) -> Float64:
        if len(others) == 0:
            return np.zeros(0)
        blurred = self._blurred(_turns(self._atoms[one]), [self._atoms[i] for i in others]).min(axis=0)
        sharp = blurred - (self._blur[one] + self._blur[others]) / 2.0
        return np.round(np.sqrt(np.maximum(sharp, 0.0)), _DISTANCE_DECIMALS)

    def _blurred(self, a: list[Atom], b: list[Atom]) -> Float64:
        return atom_distances(a, b, n_hits=_HITS, n_free=_FREE, threads=self._threads)


def _turns(atom: Atom) -> list[Atom]:
    """The atom in every rotation that mapping tries by default."""
    turned = []
    for angle in np.deg2rad(Ranking().rotations_deg):
        rotation = rotation_z(float(angle)).T.astype(np.float32)
        turned.append(
            dataclasses.replace(
                atom, hit_points=atom.hit_points @ rotation, free_points=atom.free_points @ rotation
            )
        )
    return turned


def _profile(atom: Atom) -> Float64:
    """(96,) m: quantiles of both point sets along each axis, so scaled that squared distances bound those of the atoms."""
    parts = [
        np.quantile(points - atom.centre, _QUANTILES, axis=0)
        if len(points)
        else np.zeros((len(_QUANTILES), 3))
        for points in (atom.hit_points, atom.free_points)
    ]
    return np.concatenate(parts).ravel() / np.sqrt(len(_QUANTILES))
