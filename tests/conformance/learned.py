"""Atoms learned from made-up towns, once for all tests that look at them, with where each began and what it saw."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from scipy.stats import mannwhitneyu

from potclient.datasets import open_dataset
from potserver.atoms.learning import LearningSettings, cut_sectors, learn_atoms
from potserver.domain.types import Atom, Bool, Float64, Scan
from potserver.numerics.abhm import AbhmEpoch

TOWNS = ("town:terraces:1", "town:offices:2d:1")  # a street in 3D; rooms and a corridor in 2D
SETTINGS = LearningSettings(
    max_range_m=15.0, max_kernels=120, max_labelled=2_000, batch=800, steps=25, min_hits=30
)
_SCANS = (5, 50)  # far enough apart to see different things


class LearnedSector(NamedTuple):
    """An atom and its past. Everything in the atom's frame."""

    atom: Atom
    start: AbhmEpoch  # the lattice, with its weights solved, before the first gradient step
    points: Float64  # (N, 3) m, all labelled points of the sector; the atom keeps some of them
    occupied: Bool  # (N,)

    @property
    def length_m(self) -> float:
        """The length scale that all kernels start with."""
        return float(1.0 / np.sqrt(2.0 * self.start.gamma[0]))

    def to_surface_m(self, where: ArrayLike) -> Float64:
        """(K,) m to the nearest hit."""
        return np.asarray(cKDTree(self.points[self.occupied]).query(where)[0])


@functools.cache
def learned_town(name: str) -> tuple[LearnedSector, ...]:
    """All atoms of two scans of a town."""
    recording = open_dataset(name, n_generated=60, max_range_m=SETTINGS.max_range_m)
    learned = []
    for number in _SCANS:
        recorded = recording[number]
        scan = Scan(
            points=recorded.points,
            is_return=recorded.is_return,
            T_map_sensor=recorded.T_map_sensor,
            is_planar=recorded.is_planar,
        )
        starts: dict[int, AbhmEpoch] = {}
        atoms = learn_atoms(
            scan,
            f"scan{number}",
            SETTINGS,
            {},
            on_epoch=lambda at, s=starts: s.setdefault(at.sector, at.epoch),
        )
        # the learner draws its free samples first, so the same seed gives the points that it learned from
        sectors = cut_sectors([scan], SETTINGS, np.random.default_rng(0))
        for atom in atoms:
            number_of_sector = int(atom.provenance["sector"])
            sector = sectors[number_of_sector]
            learned.append(LearnedSector(atom, starts[number_of_sector], sector.points, sector.occupied))
    return tuple(learned)


def auc(high: NDArray[np.floating], low: NDArray[np.floating]) -> float:
    """The chance that one of `high` is above one of `low`, ties half; NaN where either has fewer than three."""
    if min(len(high), len(low)) < 3:
        return float("nan")
    return float(mannwhitneyu(high, low).statistic) / (len(high) * len(low))
