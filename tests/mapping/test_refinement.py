"""Kernels placed where the data ask for them, and weights solved with the scan's labels."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Float64, KernelSet
from potserver.errors import SolverError
from potserver.mapping.placing import activation, gamma_of_spacing, kernels_at
from potserver.mapping.refinement import Effort, refine
from potserver.numerics.beams import LabelledPoints
from potserver.numerics.geometry import voxel_pick
from potserver.numerics.warm_fit import WarmFit


def place_kernels(points: Float64, spacing_m: float, prior_var: float) -> KernelSet:
    """One kernel in every occupied voxel of the points, weight 0 with the prior variance.

    Args:
        points: (N, 3) m.
        spacing_m: Voxel edge.
        prior_var: log-odds^2.
    """
    picked = voxel_pick(points, spacing_m)
    hinge = (np.floor(points[picked] / spacing_m) + 0.5) * spacing_m
    if len(points) and np.ptp(points[:, 2]) == 0.0:
        hinge[:, 2] = points[0, 2]  # a planar map keeps its kernels in its plane
    return kernels_at(hinge, spacing_m, prior_var)


def _labelled(n: int = 600, seed: int = 0, planar: bool = False) -> LabelledPoints:
    """A wall at x = 5 with free space before it."""
    rng = np.random.default_rng(seed)
    occupied = np.arange(n) < n // 2
    x = np.where(occupied, 5.0, rng.uniform(0.0, 4.2, n))
    z = np.zeros(n) if planar else rng.uniform(0, 2, n)
    return LabelledPoints(np.stack([x, rng.uniform(-4, 4, n), z], axis=1), occupied, np.arange(n))


def _placed(labelled: LabelledPoints) -> KernelSet:
    """Coarse kernels anywhere, fine ones at hits."""
    hits = labelled.points[labelled.occupied]
    return KernelSet.concatenate([place_kernels(labelled.points, 1.0, 50.0), place_kernels(hits, 0.3, 50.0)])


TO_THE_END = Effort(newton_steps=12, gradient_steps=40)


def _refine(
    kernels: KernelSet,
    labelled: LabelledPoints,
    *,
    count: float = 1.0,
    effort: Effort = TO_THE_END,
    threads: int = 1,
) -> KernelSet:
    counts = np.full(len(labelled.points), count, np.float32)
    return refine(
        kernels, labelled.points, labelled.occupied, counts, edge_m=1.0, effort=effort, threads=threads
    ).kernels


@pytest.mark.parametrize("offset", [0.0, -7.3, 4e6])
def test_one_kernel_in_every_occupied_voxel(offset: float) -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (500, 3)) + offset
    kernels = place_kernels(points, 0.5, 9.0)
    cells = np.unique(np.floor(points / 0.5), axis=0)
    placed = kernels.hinge_mean / 0.5 - 0.5
    np.testing.assert_allclose(
        placed[np.lexsort(placed.T[::-1])], cells[np.lexsort(cells.T[::-1])], atol=1e-6
    )
    np.testing.assert_array_equal(kernels.weight_mean, 0.0)
    np.testing.assert_array_equal(kernels.weight_var, 9.0)
    np.testing.assert_allclose(kernels.gamma, gamma_of_spacing(0.5), rtol=1e-5)


def test_planar_points_keep_their_kernels_in_their_plane() -> None:
    points = np.random.default_rng(0).uniform(-3, 3, (50, 3)) * [1, 1, 0] + [0, 0, 1.234]
    np.testing.assert_array_equal(place_kernels(points, 0.5, 1.0).hinge_mean[:, 2], 1.234)


def test_nothing_to_place() -> None:
    assert len(place_kernels(np.zeros((0, 3)), 0.5, 1.0)) == 0


def test_activation_is_the_sum_of_phi() -> None:
    rng = np.random.default_rng(0)
    kernels = place_kernels(rng.uniform(-3, 3, (80, 3)), 0.6, 1.0)
    points = rng.uniform(-4, 4, (50, 3))
    d2 = np.square(points[:, None] - kernels.hinge_mean).sum(axis=2)
    truth = np.exp(-kernels.gamma.astype(np.float64) * d2).sum(axis=1)
    np.testing.assert_allclose(activation(kernels, points, threads=2), truth, atol=0.03)


def test_refined_kernels_tell_wall_from_free_space_on_points_they_did_not_see() -> None:
    labelled = _labelled()
    refined = _refine(_placed(labelled), labelled)
    held_out = _labelled(seed=1)
    p = KernelMap(refined).occupancy(held_out.points).mean
    assert ((p > 0.5) == held_out.occupied).mean() > 0.97


def test_only_the_weights_change() -> None:
    labelled = _labelled()
    before = _placed(labelled)
    after = _refine(before, labelled)
    for name in ("hinge_mean", "hinge_var", "gamma_shape", "gamma_rate"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    assert np.abs(after.weight_mean).max() > 1.0
    assert (after.weight_var <= before.weight_var * 1.0001).all()
    assert (after.weight_var > 0).all()


def test_the_prior_is_kept_where_there_are_no_data() -> None:
    kernels = place_kernels(np.random.default_rng(0).uniform(50, 60, (40, 3)), 2.0, 7.0)
    kernels = kernels.replace(weight_mean=np.linspace(-2, 2, len(kernels)).astype(np.float32))
    after = _refine(kernels, _labelled())
    np.testing.assert_allclose(after.weight_mean, kernels.weight_mean, atol=1e-5)
    np.testing.assert_allclose(after.weight_var, 7.0, rtol=1e-5)


def test_a_surer_prior_moves_less() -> None:
    labelled = _labelled()
    placed = _placed(labelled)
    moved = [
        float(
            np.abs(
                _refine(placed.replace(weight_var=np.full(len(placed), v, np.float32)), labelled).weight_mean
            ).mean()
        )
        for v in (0.01, 1.0, 100.0)
    ]
    assert moved[0] < moved[1] < moved[2]


def test_a_point_of_weight_two_is_two_points() -> None:
    labelled = _labelled()
    placed = _placed(labelled)
    twice = LabelledPoints(*(np.concatenate([column, column]) for column in labelled))
    one, other = _refine(placed, labelled, count=2.0), _refine(placed, twice)
    np.testing.assert_allclose(one.weight_mean, other.weight_mean, atol=0.02)


def test_nothing_to_refine() -> None:
    assert len(_refine(KernelSet.empty(), _labelled())) == 0


def test_weights_that_are_not_numbers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    labelled = _labelled()
    placed = _placed(labelled)
    nan = np.full(len(placed), np.nan, np.float32)
    bad = WarmFit(nan, nan, nan, 0.0, 0.0, 1, False)
    monkeypatch.setattr("potserver.mapping.refinement.warm_fit", lambda *_, **__: bad)
    with pytest.raises(SolverError, match="NaN"):
        _refine(placed, labelled)


def test_the_weights_do_not_depend_on_the_number_of_threads() -> None:
    labelled = _labelled()
    placed = _placed(labelled)
    one, three = (_refine(placed, labelled, effort=Effort(3, 40), threads=n) for n in (1, 3))
    np.testing.assert_array_equal(one.weight_mean, three.weight_mean)
