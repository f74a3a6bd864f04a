"""Which atom, turned how, is nearest to each sector (paper eq. 6-7)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, Float32, Float64, Sector
from potserver.numerics.coupling import Ragged, coupling_costs
from potserver.numerics.geometry import rotation_z, thin
from potserver.services.settings import MappingSettings, RankScore

_RANK_VOXEL_M = 0.4


class Match(NamedTuple):
    """The nearest atom to one sector."""

    atom: Atom
    rotation_rad: float  # of the atom, about its centroid
    w2_m2: float  # squared 2-Wasserstein distance, hits plus free points
    converged: bool


def centre_of(hit_points: Float32, free_points: Float32) -> Float64:
    """(3,) m: what a point set is centred on before it is compared: its hits, or its free points if it has none."""
    return (hit_points if len(hit_points) else free_points).mean(axis=0, dtype=np.float64)


class Matcher:
    """Ranks every atom of a dictionary, in every rotation, against the sectors of a scan."""

    def __init__(
        self, dictionary: AtomDictionary, settings: MappingSettings, *, threads: int, seed: int
    ) -> None:
        """Subsample, centre and rotate the atoms once."""
        self._settings = settings
        self._threads = threads
        self._seed = seed
        rng = np.random.default_rng(seed)
        self._candidates: list[tuple[Atom, float]] = []
        hits: list[Float32] = []
        free: list[Float32] = []
        self._hit_set: list[int] = []  # candidate -> set number, -1 for none
        self._free_set: list[int] = []
        for atom in dictionary:
            centre = centre_of(atom.hit_points, atom.free_points)
            h = self._subsample(atom.hit_points, settings.rank_hits, rng) - centre
            f = self._subsample(atom.free_points, settings.rank_free, rng) - centre
            for angle in np.deg2rad(settings.rotations_deg):
                rotation = rotation_z(float(angle))
                self._candidates.append((atom, float(angle)))
                self._hit_set.append(len(hits) if len(h) else -1)
                self._free_set.append(len(free) if len(f) else -1)
                if len(h):
                    hits.append((h @ rotation.T).astype(np.float32))
                if len(f):
                    free.append((f @ rotation.T).astype(np.float32))
        self._hits, self._free = Ragged.of(hits), Ragged.of(free)

    def match(self, sectors: list[Sector]) -> list[Match | None]:
        """The best candidate for each sector; None where none is comparable (no atoms, or an empty sector)."""
        rng = np.random.default_rng(self._seed + 1)
        target_hits: list[Float32] = []
        target_free: list[Float32] = []
        hit_pairs: list[tuple[int, int]] = []
        free_pairs: list[tuple[int, int]] = []
        n = len(self._candidates)
        rows_hits = np.full((len(sectors), n), -1, np.int64)  # -> row of the solved batch
        rows_free = np.full((len(sectors), n), -1, np.int64)
        for s, sector in enumerate(sectors):
            if len(sector.hit_points) + len(sector.free_points) == 0:
                continue
            centre = centre_of(sector.hit_points, sector.free_points)
            for points, count, sets, pairs, rows, candidate_sets in (
                (
                    sector.hit_points,
                    self._settings.rank_hits,
                    target_hits,
                    hit_pairs,
                    rows_hits,
                    self._hit_set,
                ),
                (
                    sector.free_points,
                    self._settings.rank_free,
                    target_free,
                    free_pairs,
                    rows_free,
                    self._free_set,
                ),
            ):
                if len(points) == 0:
                    continue
                sets.append((self._subsample(points, count, rng) - centre).astype(np.float32))
                for c, number in enumerate(candidate_sets):
                    if number >= 0:
                        rows[s, c] = len(pairs)
                        pairs.append((number, len(sets) - 1))
        hits = self._solve(self._hits, target_hits, hit_pairs)
        free = self._solve(self._free, target_free, free_pairs)
        return [
            self._best(sector, rows_hits[s], rows_free[s], hits, free) for s, sector in enumerate(sectors)
        ]

    def _subsample(self, points: Float32, n: int, rng: np.random.Generator) -> Float32:
        return points[thin(points, n, _RANK_VOXEL_M, rng)]

    def _solve(
        self, sources: Ragged, targets: list[Float32], pairs: list[tuple[int, int]]
    ) -> tuple[Float64, np.ndarray]:
        s = self._settings
        solved = coupling_costs(
            sources, Ragged.of(targets), np.asarray(pairs, np.int64).reshape(-1, 2), reg=s.rank_reg_m2,
            tolerance=s.rank_tolerance, max_iterations=s.rank_iterations, threads=self._threads,
        )  # fmt: skip
        return solved.cost.astype(np.float64), solved.converged

    def _best(self, sector: Sector, rows_hits, rows_free, hits, free) -> Match | None:
        score = np.zeros(len(self._candidates))
        w2 = np.zeros(len(self._candidates))
        converged = np.ones(len(self._candidates), bool)
        compared = False
        for points, rows, (cost, ok) in (
            (sector.hit_points, rows_hits, hits),
            (sector.free_points, rows_free, free),
        ):
            if len(points) == 0:
                continue  # rank by the other label alone
            known = rows >= 0
            value = np.where(known, cost[np.maximum(rows, 0)] if len(cost) else np.inf, np.inf)
            solved = np.where(known, ok[np.maximum(rows, 0)] if len(ok) else False, False)
            value = np.where(solved, value, np.inf)  # a solve that failed cannot win
            compared |= bool(np.isfinite(value).any())
            w2 += value
            if self._settings.rank_score is RankScore.NORMALISED:
                finite = value[np.isfinite(value)]
                value = value / max(float(finite.max(initial=0.0)), 1e-12)
            score += value
            converged &= solved
        if not compared or not np.isfinite(score).any():
            return None
        best = int(np.argmin(score))
        atom, angle = self._candidates[best]
        return Match(atom, angle, float(w2[best]), bool(converged[best]))
