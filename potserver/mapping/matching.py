"""Which atom, turned how, is nearest to each sector (paper eq. 6-7)."""

from __future__ import annotations

from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, Float32, Float64, Sector
from potserver.numerics.coupling import CouplingCosts, Ragged, coupling_costs
from potserver.numerics.geometry import rotation_z, thin

_LEVELS = 16  # quantiles of a sketch along an axis


class RankScore(str, Enum):
    """How atoms are ranked against a sector."""

    W2 = "w2"  # eq. 7: squared 2-Wasserstein distance of hits plus that of free points
    # the authors' code: each divided by its largest over all candidates, then added
    NORMALISED = "normalised"


class Ranking(NamedTuple):
    """How atoms are compared with sectors (eq. 6-7)."""

    n_hits: int = 48  # points compared, at most; cost grows with their square
    n_free: int = 32
    voxel_m: float = 0.4  # points are thinned to one a voxel first; 0 draws them at random
    # weight of the entropy: a blur of about 2 m ranks as a sharper plan does, in a tenth of the time
    reg_m2: float = 5.0
    tolerance: float = 3e-2  # of the marginals, in L1: enough to rank
    max_iterations: int = 1000
    score: RankScore = RankScore.W2
    # atoms in rotations that a sector is compared with, at most: of more the nearest by a bound, see `_sketch`
    n_compared: int = 128
    # of the atom: sectors are 60 degrees wide
    rotations_deg: tuple[float, ...] = (-30.0, -15.0, 0.0, 15.0, 30.0)


class Match(NamedTuple):
    """The nearest atom to one sector."""

    atom: Atom
    rotation_rad: float  # of the atom, about its centroid
    w2_m2: float  # squared 2-Wasserstein distance under the entropic plan, hits plus free points


def shared_centres(atom: Atom, sector: Sector) -> tuple[Float64, Float64]:
    """(3,) and (3,) m: what an atom and a sector are centred on when they are compared, each in its own frame.

    Their hits where both have some, else their free points: two clouds are only comparable about the same kind of centre.
    """
    if len(atom.hit_points) and len(sector.hit_points):
        return _mean(atom.hit_points), _mean(sector.hit_points)
    return _mean(atom.free_points), _mean(sector.free_points)


def _mean(points: Float32) -> Float64:
    return points.mean(axis=0, dtype=np.float64) if len(points) else np.zeros(3)


class Matcher:
    """Ranks every atom of a dictionary, in every rotation, against the sectors of a scan."""

    def __init__(self, dictionary: AtomDictionary, ranking: Ranking, *, threads: int, seed: int) -> None:
        """Subsample, centre and rotate the atoms once."""
        self._ranking = ranking
        self._threads = threads
        self._seed = seed
        rng = np.random.default_rng(seed)
        self._candidates: list[tuple[Atom, float]] = []
        hits, free, free_alone = _Side(), _Side(), _Side()
        for atom in dictionary:
            h = self._subsample(atom.hit_points, ranking.n_hits, rng)
            f = self._subsample(atom.free_points, ranking.n_free, rng)
            centre = _mean(atom.hit_points if len(h) else atom.free_points)
            for angle in np.deg2rad(ranking.rotations_deg):
                rotation = rotation_z(float(angle))
                self._candidates.append((atom, float(angle)))
                hits.add((h - centre) @ rotation.T)
                free.add((f - centre) @ rotation.T)
                free_alone.add((f - _mean(atom.free_points)) @ rotation.T)
        self._hits, self._free, self._free_alone = hits, free, free_alone

    def match(self, sectors: list[Sector]) -> list[Match | None]:
        """The best candidate for each sector; None where none is comparable (no atoms, or an empty sector)."""
        rng = np.random.default_rng(self._seed + 1)
        hits, free, alone = (
            _Batch(side, len(sectors)) for side in (self._hits, self._free, self._free_alone)
        )
        for number, sector in enumerate(sectors):
            f = self._subsample(sector.free_points, self._ranking.n_free, rng)
            if len(sector.hit_points):
                centre = _mean(sector.hit_points)
                h = self._subsample(sector.hit_points, self._ranking.n_hits, rng) - centre
                near = self._nearest([(self._hits, h), (self._free, f - centre)])
                hits.add(number, h, near)
                free.add(number, f - centre, near)
            else:
                g = f - _mean(sector.free_points)
                alone.add(number, g, self._nearest([(self._free_alone, g)]))
        solved = [(batch, self._solve(batch)) for batch in (hits, free, alone)]
        return [
            self._best([batch.of(number, costs) for batch, costs in solved]) for number in range(len(sectors))
        ]

    def _nearest(self, compared: list[tuple[_Side, Float64]]) -> NDArray[np.intp]:
        """The candidates that a sector's points are compared with: what that costs does not grow with the dictionary."""
        n, most = len(self._candidates), self._ranking.n_compared
        if n <= most:
            return np.arange(n)
        bound = np.sum([side.bounds(points) for side, points in compared if len(points)], axis=0)
        return np.sort(np.argpartition(np.broadcast_to(bound, n), most)[:most])

    def _subsample(self, points: Float32, n: int, rng: np.random.Generator) -> Float32:
        return points[thin(points, n, self._ranking.voxel_m, rng)]

    def _solve(self, batch: _Batch) -> CouplingCosts:
        r = self._ranking
        return coupling_costs(
            batch.side.packed, Ragged.of(batch.targets), np.asarray(batch.pairs, np.int64).reshape(-1, 2),
            reg=r.reg_m2, tolerance=r.tolerance, max_iterations=r.max_iterations, threads=self._threads,
        )  # fmt: skip

    def _best(self, costs_by_label: list[Float64 | None]) -> Match | None:
        """Eq. 7 over all candidates; each label's costs are (C,) m^2, infinite where a solve failed or there is no set."""
        compared = [costs for costs in costs_by_label if costs is not None]
        if not compared or not self._candidates:
            return None
        w2 = np.sum(compared, axis=0)
        score = w2
        if self._ranking.score is RankScore.NORMALISED:
            score = np.sum(
                [c / max(float(c[np.isfinite(c)].max(initial=0.0)), 1e-12) for c in compared], axis=0
            )
        best = int(np.argmin(score))
        if not np.isfinite(score[best]):
            return None
        atom, angle = self._candidates[best]
        return Match(atom, angle, float(w2[best]))


class _Side:
    """One label's point sets of all candidates; a candidate may have none."""

    def __init__(self) -> None:
        self.sets: list[Float32] = []
        self.set_of: list[int | None] = []  # candidate -> set
        self._sketches: list[Float64] = []

    def add(self, points: Float64) -> None:
        self.set_of.append(len(self.sets) if len(points) else None)
        self._sketches.append(_sketch(points) if len(points) else np.full(3 * _LEVELS, np.inf))
        if len(points):
            self.sets.append(points.astype(np.float32))

    @cached_property
    def packed(self) -> Ragged:
        """All sets."""
        return Ragged.of(self.sets)

    @cached_property
    def _table(self) -> Float64:
        return np.array(self._sketches)

    def bounds(self, points: Float64) -> Float64:
        """(C,) m^2: about what the cheapest plan from a candidate's points to these costs at least; infinite without points."""
        return np.asarray(np.square(self._table - _sketch(points)).sum(axis=1) / _LEVELS)


def _sketch(points: Float64) -> Float64:
    """Quantiles along each axis.

    Costs of transport are sums over the axes, and along one axis the cheapest plan keeps the order: so squared differences of
    two sketches, summed over the axes, are a lower bound of the squared 2-Wasserstein distance, up to what quantiles leave out.
    """
    levels = (np.arange(_LEVELS) + 0.5) / _LEVELS
    return np.quantile(points, levels, axis=0).astype(np.float64).reshape(-1)


class _Batch:
    """All problems of one label: the sectors that have it against every candidate that has it."""

    def __init__(self, side: _Side, n_sectors: int) -> None:
        self.side = side
        self.targets: list[Float32] = []
        self.pairs: list[tuple[int, int]] = []
        self._row: NDArray[np.int64] = np.full((n_sectors, len(side.set_of)), -1, np.int64)
        self._has: NDArray[np.bool_] = np.zeros(n_sectors, bool)

    def add(self, sector: int, points: Float64, candidates: NDArray[np.intp]) -> None:
        """Pose the problems of one sector with some candidates; none if it has no points of this label."""
        if len(points) == 0:
            return
        self._has[sector] = True
        for candidate in candidates:
            number = self.side.set_of[candidate]
            if number is not None:
                self._row[sector, candidate] = len(self.pairs)
                self.pairs.append((number, len(self.targets)))
        self.targets.append(points.astype(np.float32))

    def of(self, sector: int, solved: CouplingCosts) -> Float64 | None:
        """(C,) m^2: cost of each candidate; None if the sector has no points of this label."""
        if not self._has[sector]:
            return None
        costs = np.full(len(self.side.set_of), np.inf)
        row = self._row[sector]
        known = row >= 0
        # a solve that failed cannot win
        costs[known] = np.where(solved.converged[row[known]], solved.cost[row[known]], np.inf)
        return costs
