"""Parts of a map: kernels on lattices and others answer together, as an index of all of them does."""

from __future__ import annotations

import numpy as np
import pytest

from potschemas.answers import AnswerRule, LatentSums, answer, known
from potserver.asking.grid import Grid
from potserver.asking.rays import Rays
from potserver.asking.risk import Risk
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_part import in_a_plane
from potserver.domain.tiles import COARSE, MapKernels, Tile, TiledMap, TileIndex
from potserver.domain.types import KernelSet, Unknown, yaw_pose
from potserver.limits import Limits
from potserver.numerics.evidence import Rows
from tests.tiled_maps import GRID, free_kernels, lattice_kernels

RULE = AnswerRule(residual_var=50.0, mean_moderation=0.05, full_activation=3.4)
CLOSE = 2e-4  # of a probability: what the index may leave out, and what lies beyond a window
KINDS = ("lattices", "planes", "mixed", "free", "empty")


def _tiles(kind: str) -> dict[TileIndex, KernelSet]:
    if kind == "empty":
        return {}
    tiles = {}
    for x in range(-2, 3):
        for y in range(-1, 2):
            seed = 100 * x + y + 500
            sets = [free_kernels(40, seed)]
            if kind in ("lattices", "planes", "mixed"):
                spacings = (GRID.fine_m, GRID.coarse_m) if (x + y) % 2 else (GRID.fine_m / 2, GRID.fine_m)
                planar = kind == "planes"
                lattices = [lattice_kernels(600, seed, spacing, planar=planar) for spacing in spacings]
                sets = lattices + (sets if kind == "mixed" and x > 0 else [])
            tiles[(x, y, 0)] = KernelSet.concatenate(sets)
    return tiles


def _tiled(tiles: dict[TileIndex, KernelSet]) -> TiledMap:
    made = {index: Tile(Rows.empty(), MapKernels.new(own, COARSE), 1) for index, own in tiles.items()}
    return TiledMap.empty(GRID).with_tiles(made, threads=2)


def _maps(kind: str) -> tuple[KernelMap, KernelMap]:
    """One that knows lattices, and one that looks for each kernel."""
    tiled = _tiled(_tiles(kind))
    quick = KernelMap(list(tiled.parts.values()), rule=RULE, threads=2)
    return quick, KernelMap(quick.kernels, rule=RULE, threads=1)


def _points(n: int = 3000, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-20, -12, -3], [28, 20, 11], (n, 3))


def _exact(kernels: KernelSet, points: np.ndarray) -> LatentSums:
    """Eq. 1 over all kernels, float64."""
    gamma, w, v = (
        np.asarray(column, np.float64) for column in (kernels.gamma, kernels.weight_mean, kernels.weight_var)
    )
    phi = np.exp(-gamma * np.square(points[:, None] - kernels.hinge_mean[None]).sum(axis=2))
    return LatentSums(phi @ w, np.square(phi) @ v, phi @ known(v, RULE))


@pytest.mark.parametrize(
    ("kind", "close"), [("lattices", 3e-5), ("planes", 3e-5), ("mixed", 1e-3), ("free", 1e-3)]
)
def test_points_answer_as_eq_1_over_all_kernels(kind: str, close: float) -> None:
    """An index leaves out what is small, which the residual variance shows; bricks leave out nothing that can be seen."""
    quick, _ = _maps(kind)
    points = _points()
    sums = _exact(quick.kernels, points)
    on_edge = np.abs(sums.activation - RULE.observed_activation) < 10 * close
    exact, found = answer(sums, RULE), quick.occupancy(points)
    for name in ("mean", "var"):
        difference = np.abs(getattr(found, name) - getattr(exact, name))
        assert difference[~on_edge].max() < close
    np.testing.assert_array_equal(found.observed[~on_edge], exact.observed[~on_edge])


@pytest.mark.parametrize("height", [0.0, 0.1, 0.35])
def test_kernels_of_one_height_are_in_a_plane(height: float) -> None:
    flat = [lattice_kernels(600, seed, GRID.fine_m, planar=True) for seed in range(2)]
    tiles = {}
    for x, kernels in enumerate(flat):
        hinge = kernels.hinge_mean.copy()
        hinge[:, 2] = height
        tiles[(4 * x, 0, 0)] = kernels.replace(hinge_mean=hinge)
    assert in_a_plane(_tiled(tiles).parts.values())
    higher = {(0, 0, 1): flat[0], **tiles}
    assert not in_a_plane(_tiled(higher).parts.values())
    assert not in_a_plane(_tiled(_tiles("lattices")).parts.values())
    assert not in_a_plane([])


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_and_widths_are_those_of_an_index_of_all_kernels(kind: str) -> None:
    quick, slow = _maps(kind)
    points = _points()
    one, other = quick.occupancy_with_gradient(points), slow.occupancy_with_gradient(points)
    known = one.observed & other.observed & (slow.latent(points).activation > 2 * RULE.observed_activation)
    np.testing.assert_array_equal(one.mean, quick.occupancy(points).mean)
    np.testing.assert_allclose(one.gradient[known], other.gradient[known], atol=20 * CLOSE)
    np.testing.assert_allclose(one.latent_gradient[known], other.latent_gradient[known], atol=0.05)
    np.testing.assert_allclose(quick.widths(points)[known], slow.widths(points)[known], atol=0.02)
    for a, b in ((quick.typical_width_m, slow.typical_width_m), (quick.fine_step_m, slow.fine_step_m)):
        assert a == pytest.approx(b, rel=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("upper", [[21.0, 13.0, 5.0], [21.0, 13.0, 0.2], [-7.9, -5.9, 5.0]])
def test_grids_answer_as_points(kind: str, upper: list[float]) -> None:
    quick, _ = _maps(kind)
    plan = Grid([-8.0, -6.0, 0.0], upper, 0.3).plan(quick, Limits(), part_cells=4001)
    runs = list(plan.parts())
    cells = np.stack(np.unravel_index(np.arange(plan.n_items), plan.shape), axis=1)
    other = quick.occupancy(plan.lower + (cells + 0.5) * plan.resolution)
    # an index leaves out other kernels for other groups of points
    atol = 5e-3 if quick.n_off_lattice else 1e-5
    same = np.concatenate([run.occupancy.observed for run in runs]) == other.observed
    assert same.mean() > (0.999 if quick.n_off_lattice else 0.99999)
    for name in ("mean", "var"):
        one = np.concatenate([getattr(run.occupancy, name) for run in runs])
        np.testing.assert_allclose(one[same], getattr(other, name)[same], atol=atol)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("unknown", list(Unknown))
def test_rays_and_risk_answer_as_an_index_of_all_kernels(kind: str, unknown: Unknown) -> None:
    rng = np.random.default_rng(0)
    origins, directions = rng.uniform([-12, -6, 0.2], [20, 12, 6], (80, 3)), rng.normal(size=(80, 3))
    path = np.stack([yaw_pose(x, 2.0, 0.3, 0.3) for x in np.linspace(-10, 15, 12)])
    asked = Rays(origins, directions, max_range_m=12.0, unknown=unknown, step_m=0.1)
    risk = Risk(path, [[0.0, 0.0, 0.3, 0.5]], unknown=unknown)
    answers = []
    for m in _maps(kind):
        plan, walk = asked.plan(m, Limits()), risk.plan(m, Limits())
        answers.append((plan.result(plan.parts()), walk.result(walk.parts())))
    (rays, risks), (slow_rays, slow_risks) = answers
    # a point on the edge of "observed" may fall to either side: it moves a ray by a step
    for name, atol in (("hit_probability", 0.01), ("mean_m", 0.1), ("std_m", 0.1), ("unknown_share", 0.02)):
        difference = np.abs(getattr(rays, name) - getattr(slow_rays, name))
        assert np.quantile(difference, 0.95) < 2e-3
        assert difference.max() < atol
    np.testing.assert_allclose(risks.max_probability, slow_risks.max_probability, atol=2e-3)
    np.testing.assert_allclose(risks.union_probability, slow_risks.union_probability, atol=5e-3)


def test_kernels_on_no_lattice_are_counted() -> None:
    on, mixed, free = (_maps(kind)[0] for kind in ("lattices", "mixed", "free"))
    assert on.n_off_lattice == 0
    assert mixed.n_off_lattice == 2 * 3 * 40
    assert free.n_off_lattice == len(free) == 5 * 3 * 40


def test_a_map_that_grew_answers_as_one_that_was_made_at_once() -> None:
    tiles = _tiles("mixed")
    grown = TiledMap.empty(GRID)
    for index, own in tiles.items():
        made = {index: Tile(Rows.empty(), MapKernels.new(own, COARSE), 1)}
        grown = grown.with_tiles({index: Tile(Rows.empty(), MapKernels.new(free_kernels(5), COARSE), 1)})
        grown = grown.with_tiles(made)
    at_once = _tiled(tiles)
    answers = [
        KernelMap(list(tiled.parts.values()), rule=RULE).occupancy(_points()) for tiled in (grown, at_once)
    ]
    np.testing.assert_allclose(answers[0].mean, answers[1].mean, atol=CLOSE)


def test_a_changed_tile_leaves_other_parts_and_older_maps_as_they_are() -> None:
    tiled = _tiled(_tiles("lattices"))
    before = KernelMap(list(tiled.parts.values()), rule=RULE)
    truth = before.occupancy(_points()).mean
    gone = tiled.with_tiles({(0, 0, 0): Tile(Rows.empty(), MapKernels.new(KernelSet.empty(), COARSE))})
    assert [n for n in tiled.parts if gone.parts[n] is not tiled.parts[n]] == [(0, 0, 0)]
    after = KernelMap(list(gone.parts.values()), rule=RULE)
    inside = [[4.0, 4.0, 4.0]]
    assert before.occupancy(inside).observed.all()
    assert not after.occupancy(inside).observed.any()
    del tiled, gone
    np.testing.assert_array_equal(before.occupancy(_points()).mean, truth)


def test_parts_put_their_kernels_together_in_the_map_frame() -> None:
    tiles = _tiles("mixed")
    together = KernelMap(list(_tiled(tiles).parts.values())).kernels
    hinge = np.concatenate([own.hinge_mean + np.array(index) * GRID.size_m for index, own in tiles.items()])
    np.testing.assert_array_equal(np.unique(together.hinge_mean, axis=0), np.unique(hinge, axis=0))
