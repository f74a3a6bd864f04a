"""The grid and the voxels that go out, of a map that is a formula."""

from __future__ import annotations

import functools
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potclient.errors import UsageError
from potclient.occupancy import Grid, Occupancy
from potclient.questions.tiles import MIRROR_MARGIN_M
from potserver.config import load_settings
from potserver.ros import grid_layer
from potserver.ros.changes import Change
from potserver.ros.grid_layer import GridLayer
from potserver.ros.settings import RosSettings
from potserver.ros.voxel_layer import VoxelLayer

TILE_M = 10.0
ANYTHING = Change(None, TILE_M)


class FormulaMap:
    """Answers like a `MapClient`. Log-odds are those of `latent`; observed is what lies in the bounds."""

    def __init__(self, lower: tuple, upper: tuple, latent: Callable[[Any], Any]) -> None:
        self.lower, self.upper, self.latent = list(lower), list(upper), latent
        self.asked: list[tuple[list, list]] = []

    def info(self) -> Any:
        return types.SimpleNamespace(lower=self.lower, upper=self.upper, tile_size_m=TILE_M)

    def occupancy(self, points: Any) -> Occupancy:
        latent = np.clip(self.latent(points), -30, 30).astype(np.float32)
        mean = (1 / (1 + np.exp(-latent))).astype(np.float32)
        inside = ((points >= self.lower) & (points <= self.upper)).all(axis=-1)
        return Occupancy(
            mean=mean,
            var=mean * (1 - mean),
            latent_mean=latent,
            latent_var=np.ones_like(mean),
            observed=inside,
            borrowed=np.zeros_like(mean),
        )

    def grid(self, lower: Any, upper: Any, resolution: float) -> Grid:
        self.asked.append((np.asarray(lower).tolist(), np.asarray(upper).tolist()))
        shape = np.rint((np.asarray(upper) - lower) / resolution).astype(int)
        shape = np.maximum(shape, 1)
        axes = [lower[a] + (np.arange(n) + 0.5) * resolution for a, n in enumerate(shape)]
        answer = self.occupancy(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
        return Grid(
            lower=np.asarray(lower, np.float64),
            resolution=resolution,
            revision=1,
            **{
                f: getattr(answer, f)
                for f in ("mean", "var", "latent_mean", "latent_var", "observed", "borrowed")
            },
        )


def ros_settings(**changes: Any) -> RosSettings:
    return load_settings(overrides={f"ros.{name}": value for name, value in changes.items()}).ros


def ball(centre: tuple, radius: float = 2.0) -> Callable[[Any], Any]:
    """Occupied inside, free outside: steep enough to be sure a metre away."""
    return lambda points: 5.0 * (radius - np.linalg.norm(points - np.array(centre), axis=-1))


def jumped(centre: Any, before: Callable[[Any], Any], points: Any) -> Any:
    """A ball about the centre, and what was before from 4 m on."""
    near = (np.abs(points - centre) <= 4).all(axis=-1)
    return np.where(near, ball(centre)(points), before(points))


def layers(source: FormulaMap, **changes: Any) -> tuple[GridLayer, VoxelLayer]:
    options = ros_settings(**({"grid_m": 0.5, "voxel_m": 0.5} | changes))
    return GridLayer(source, options), VoxelLayer(source, options)  # type: ignore[arg-type]


def test_a_planar_map_is_asked_in_its_plane() -> None:
    source = FormulaMap((-4, -4, 0.3), (4, 4, 0.3), ball((0, 0, 0.3)))
    grid, _ = layers(source)
    assert grid.update(ANYTHING) is None
    assert np.allclose([(low[2] + high[2]) / 2 for low, high in source.asked], 0.3)
    first, values = grid.whole
    assert values[0 - first[0], 0 - first[1]] > 95
    assert values[-7 - first[0], 0 - first[1]] < 5
    assert values[-12 - first[0], 0 - first[1]] == -1  # outside of what was observed


@pytest.mark.parametrize(
    ("band", "grid_m", "heights"), [((0.1, 1.5), 0.1, 6), ((0.1, 1.5), 0.5, 3), ((1.0, 1.0), 0.1, 1)]
)
def test_a_band_is_asked_at_some_heights(band: tuple, grid_m: float, heights: int) -> None:
    source = FormulaMap((-4, -4, -1), (4, 4, 2), ball((0, 0, 0)))
    layers(source, grid_m=grid_m, band_m=list(band))[0].update(ANYTHING)
    middles = sorted({round((low[2] + high[2]) / 2, 6) for low, high in source.asked})
    assert len(middles) == heights
    assert band[0] <= middles[0] <= middles[-1] <= band[1]


def test_only_a_box_goes_out() -> None:
    source = FormulaMap((-30, -30, -1), (30, 30, 2), ball((0, 0, 0)))
    grid, voxels = layers(source, box_m=[-2.0, -3, 0, 2, 3, 1])
    grid.update(ANYTHING)
    voxels.update(ANYTHING)
    assert grid.whole.first == (-4, -6)
    assert grid.whole.values.shape == (8, 12)
    assert voxels.voxels.cells.min(axis=0).tolist() == [-4, -6, 0]
    assert voxels.voxels.cells.max(axis=0).tolist() == [3, 5, 1]


def test_too_large_a_grid_is_refused_with_a_way_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grid_layer, "MAX_CELLS", 100)
    with pytest.raises(UsageError, match=r"set ros\.box_m, or a larger ros\.grid_m"):
        layers(FormulaMap((-4, -4, -1), (4, 4, 2), ball((0, 0, 0))))[0].update(ANYTHING)


def test_a_map_that_was_emptied_is_unknown() -> None:
    source = FormulaMap((-4, -4, -1), (4, 4, 2), ball((0, 0, 0)))
    grid, voxels = layers(source)
    grid.update(ANYTHING)
    voxels.update(ANYTHING)
    source.lower = source.upper = None  # type: ignore[assignment]
    cleared = Change(frozenset({(0, 0, 0)}), TILE_M)
    assert grid.update(cleared) is None
    assert (grid.whole.values == -1).all()
    voxels.update(cleared)
    assert len(voxels.voxels.cells) == len(voxels.surface.cells) == 0


def test_surface_points_lie_on_the_surface() -> None:
    _, voxels = layers(FormulaMap((-9, -9, -9), (9, 9, 9), ball((0.1, 0.2, 0.3))))
    voxels.update(ANYTHING)
    distance = np.linalg.norm(voxels.surface.points - np.array([0.1, 0.2, 0.3]), axis=1)
    assert len(distance) > 200
    assert np.abs(distance - 2.0).max() < 0.02
    assert np.allclose(voxels.surface.sd, 0.195, atol=0.01)  # of one half with a latent variance of 1


def test_only_the_changed_tiles_and_their_reach_are_asked_again() -> None:
    source = FormulaMap((-59.9, -59.9, -9.9), (59.9, 59.9, 9.9), ball((0, 0, 0)))
    layers_of_it = layers(source, grid_m=1.0, voxel_m=1.0)
    for layer in layers_of_it:
        layer.update(ANYTHING)
    tile = Change(frozenset({(3, -2, 0)}), TILE_M)
    reach_m = MIRROR_MARGIN_M + 1.0  # a cell more: boxes are of whole cells
    for layer in layers_of_it:
        source.asked.clear()
        layer.update(tile)
        assert source.asked
        for lower, upper in source.asked:
            assert np.all(np.array(lower)[:2] >= np.array([30, -20]) - reach_m)
            assert np.all(np.array(upper)[:2] <= np.array([40, -10]) + reach_m)


@settings(max_examples=10)
@given(centres=st.lists(st.tuples(*[st.floats(-17, 17)] * 2, st.floats(-2, 2)), min_size=1, max_size=3))
def test_what_changed_is_the_same_as_everything_anew(centres: list) -> None:
    """The ball jumps; told the tiles that the jump touches, the layers become what they would be from scratch."""
    coarse = {"grid_m": 1.0, "voxel_m": 1.0}
    source = FormulaMap((-19.9, -19.9, -9.9), (19.9, 19.9, 9.9), ball((0, 0, 0)))
    grid, voxels = layers(source, **coarse)
    grid.update(ANYTHING)
    voxels.update(ANYTHING)
    canvas = grid.whole.values.copy()
    at = np.zeros(3)
    for centre in np.array(centres):
        touched = np.concatenate([c + np.indices((5, 5, 5)).reshape(3, -1).T - 2 for c in (at, centre)])
        tiles = frozenset(tuple(t) for t in np.floor(touched / TILE_M).astype(int).tolist())
        source.latent = functools.partial(jumped, centre, source.latent)
        patches = grid.update(Change(tiles, TILE_M))
        assert patches is not None
        for first, values in patches:
            i, j = np.array(first) - grid.whole.first
            canvas[i : i + values.shape[0], j : j + values.shape[1]] = values
        voxels.update(Change(tiles, TILE_M))
        at = centre
    fresh_grid, fresh_voxels = layers(source, **coarse)
    fresh_grid.update(ANYTHING)
    fresh_voxels.update(ANYTHING)
    assert np.array_equal(grid.whole.values, fresh_grid.whole.values)
    assert np.array_equal(canvas, fresh_grid.whole.values)
    for ours, fresh in ((voxels.voxels, fresh_voxels.voxels), (voxels.surface, fresh_voxels.surface)):
        columns = [
            sorted(map(tuple, np.column_stack([a.reshape(len(a), -1) for a in x]).tolist()))
            for x in (ours, fresh)
        ]
        assert columns[0] == columns[1]
