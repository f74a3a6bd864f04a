"""Row C12, the paper's Observation 1, on kernels learned from a street (3D) and from rooms (2D): what the parameters look like.

Every statement has a margin below what was measured, and fails for shuffled parameters or for the lattice that learning starts
from. One form of it does not hold and is not claimed: hinges of occupied kernels do not end
nearer to surfaces than they begin (median 0.59 length scales away against 0.44 on the street, 0.39 against 0.40 in rooms).
Nothing is seen behind a surface, so an occupied kernel does best some way behind it; see the last tests.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from potserver.atoms.learning import beam_weights
from potserver.domain.types import Float64
from potserver.numerics.abhm import AbhmOptions, AbhmStart, fit_abhm
from tests.conformance.learned import SETTINGS, TOWNS, LearnedSector, auc, learned_town

_NEAR, _FAR = 0.5, 1.5  # length scales from the nearest hit: at a surface, and away from all
town = pytest.mark.parametrize("name", TOWNS, ids=["street 3d", "rooms 2d"])


def _near_above_far(sectors: tuple[LearnedSector, ...], values: list[NDArray[np.floating]]) -> float:
    """Chance that a kernel at a surface has a larger value than one away from all: mean over sectors."""
    chances = []
    for sector, value in zip(sectors, values, strict=True):
        away = sector.to_surface_m(sector.atom.kernels.hinge_mean) / sector.length_m
        chances.append(auc(value[away < _NEAR], value[away > _FAR]))
    assert np.isfinite(chances).sum() >= 8, "sectors that have kernels of both kinds"
    return float(np.nanmean(chances))


def _shuffled(values: list[NDArray[np.floating]]) -> list[NDArray[np.floating]]:
    rng = np.random.default_rng(0)
    return [rng.permutation(value) for value in values]


@town
def test_row_c12_weights_are_high_where_there_are_hits(name: str) -> None:
    """Measured: 0.92 on the street, 0.98 in rooms; 0.5 if weights are shuffled among the kernels of a sector."""
    sectors = learned_town(name)
    weights = [sector.atom.kernels.weight_mean for sector in sectors]
    learned, by_chance = _near_above_far(sectors, weights), _near_above_far(sectors, _shuffled(weights))
    print(f"\n{name}: weights at surfaces above those in the open: {learned:.3f}, shuffled {by_chance:.3f}")
    assert learned > 0.75
    assert by_chance < 0.6


@town
def test_row_c12_gammas_are_high_at_edges(name: str) -> None:
    """Measured: 0.61 on the street (0.64 with 60 steps an epoch), 0.81 in rooms; 0.5 for the start and if shuffled."""
    sectors = learned_town(name)
    gammas = [sector.atom.kernels.gamma.astype(np.float64) for sector in sectors]
    learned, by_chance = _near_above_far(sectors, gammas), _near_above_far(sectors, _shuffled(gammas))
    at_start = _near_above_far(sectors, [sector.start.gamma for sector in sectors])
    print(f"\n{name}: gammas at surfaces above those in the open: {learned:.3f}, shuffled {by_chance:.3f}")
    assert learned > (0.57 if name == TOWNS[0] else 0.7)
    assert by_chance < 0.55
    assert at_start == 0.5, "all are equal there"


class _Box(NamedTuple):
    weight_var: NDArray[np.float32]
    to_data_m: Float64
    spacing_m: float


@functools.cache
def _learned_with_unseen_space(name: str) -> _Box:
    """Kernels all over a sector's bounding box, as in the paper: the lattice of an atom leaves out what was not seen."""
    sector = learned_town(name)[0]
    drawn = np.random.default_rng(0).choice(len(sector.points), min(2_000, len(sector.points)), replace=False)
    points, occupied = sector.points[drawn], sector.occupied[drawn]
    planar = sector.atom.dims == 2
    spacing = 1.2 if planar else 2.4
    lower, upper = points.min(axis=0) - 2.0, points.max(axis=0) + 2.0
    axes = [np.arange(low, high, spacing) for low, high in zip(lower, upper, strict=True)]
    if planar:
        axes[2] = np.zeros(1)
    hinge = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    fit = fit_abhm(
        points, occupied, AbhmStart(hinge, np.full(len(hinge), 0.5 / spacing**2)),
        AbhmOptions(batch=800, steps=25, dispersion_epochs=0),
        sample_weight=beam_weights(occupied, SETTINGS.free_per_beam),
    )  # fmt: skip
    return _Box(fit.weight_var, np.asarray(cKDTree(points).query(fit.hinge_mean)[0]), spacing)


@town
def test_row_c12_weights_are_uncertain_where_nothing_was_seen(name: str) -> None:
    """Measured: chance 1.00 and 1.00, median variance 180 and 200 (the prior's is 200) against 0.5 and 2.5; 0.5 if shuffled."""
    box = _learned_with_unseen_space(name)
    unseen, seen = box.to_data_m > 2.0 * box.spacing_m, box.to_data_m < 0.5 * box.spacing_m
    assert min(unseen.sum(), seen.sum()) >= 10
    learned = auc(box.weight_var[unseen], box.weight_var[seen])
    shuffled = np.random.default_rng(0).permutation(box.weight_var)
    by_chance = auc(shuffled[unseen], shuffled[seen])
    medians = np.median(box.weight_var[unseen]), np.median(box.weight_var[seen])
    print(f"\n{name}: variance where unseen above seen: {learned:.3f}, shuffled {by_chance:.3f}; {medians}")
    assert learned > 0.9
    assert medians[0] > 5.0 * medians[1]
    assert by_chance < 0.7


class _Moves(NamedTuple):
    """How the hinges that began at a surface moved; pooled over the sectors of a town."""

    along: Float64  # (M,) length scales, along the surface's normal, to the sensor's side
    distance: Float64  # (M,) length scales
    weight: NDArray[np.floating]  # (M,) that they ended with
    sector: NDArray[np.int64]  # (M,)


@functools.cache
def _moves(name: str) -> _Moves:
    parts = []
    for number, sector in enumerate(learned_town(name)):
        start, kernels = sector.start.hinge, sector.atom.kernels
        moved = (kernels.hinge_mean - start) / sector.length_m
        along = (moved * _normals(sector, start)).sum(axis=1)
        at_surface = sector.to_surface_m(start) < sector.length_m
        columns = (along, np.linalg.norm(moved, axis=1), kernels.weight_mean, np.full(len(start), number))
        parts.append([column[at_surface] for column in columns])
    return _Moves(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _normals(sector: LearnedSector, where: Float64) -> Float64:
    """(K, 3) normals of the surface at its nearest hit, by principal components of the hits about it, towards the sensor."""
    hits = sector.points[sector.occupied]
    planar = sector.atom.dims == 2
    _, index = cKDTree(hits).query(where, k=8 if planar else 40)
    spread = hits[index] - hits[index].mean(axis=1, keepdims=True)
    scatter = np.einsum("nki,nkj->nij", spread, spread)
    if planar:
        scatter[:, 2, 2] = 1e9  # never across the plane
    normal = np.linalg.eigh(scatter)[1][:, :, 0]
    nearest = hits[index[:, 0]]
    return normal * np.where((normal * nearest).sum(axis=1) > 0, -1.0, 1.0)[:, None]


@town
def test_row_c12_hinges_move_across_the_surfaces_shape(name: str) -> None:
    """Share of the way that is along the normal. Measured: 0.79 on the street, 0.75 in rooms; any direction: 0.50 and 0.64."""
    moves = _moves(name)
    share = float(np.abs(moves.along).sum() / moves.distance.sum())
    by_chance = 0.5 if name == TOWNS[0] else 2.0 / np.pi
    print(
        f"\n{name}: share along the normal {share:.3f}, in any direction {by_chance:.3f}; {len(moves.along)}"
    )
    assert share > by_chance + 0.03
    assert np.median(moves.distance) > 0.05, "length scales: they do move"


@town
def test_row_c12_hinges_take_their_side_of_the_surface(name: str) -> None:
    """Occupied kernels move behind the surface, free ones before it. Measured: 83 % and 74 %; weights shuffled: half."""
    moves = _moves(name)
    rng = np.random.default_rng(0)
    weight = moves.weight.copy()
    for number in np.unique(moves.sector):
        members = moves.sector == number
        weight[members] = rng.permutation(weight[members])
    learned = float((moves.along * moves.weight < 0).mean())
    by_chance = float((moves.along * weight < 0).mean())
    print(f"\n{name}: moved to their side {learned:.3f}, weights shuffled {by_chance:.3f}")
    assert learned > 0.65
    assert by_chance < 0.58
