"""Grounds and height models of made-up places."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.heights import HeightLabels, HeightModels, fit_heights, ground_of


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.1, -0.05)])
def test_the_ground_is_found_below_what_stands_on_it(slopes: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    level = rng.uniform(-20, 20, (2000, 2))
    floor = np.column_stack([level, -1.7 + level @ slopes + rng.normal(0, 0.02, 2000)])
    things = np.column_stack([rng.uniform(-20, -12, (3000, 2)), rng.uniform(-1, 4, 3000)])
    ground = ground_of(np.concatenate([floor, things]))
    assert ground.height_m == pytest.approx(-1.7, abs=0.1)
    assert (ground.slope_x, ground.slope_y) == pytest.approx(slopes, abs=0.02)
    assert np.abs(ground.below(floor)).max() < 0.3
    assert ground.n_near > 200


def test_the_model_says_the_share_of_each_height_and_range() -> None:
    rng = np.random.default_rng(2)
    height, reach = rng.uniform(-1, 6, 60_000), rng.uniform(0, 25, 60_000)
    true = np.where(height < 0, 3.0, -2.0 + 0.05 * reach)
    occupied = rng.random(60_000) < 1 / (1 + np.exp(-true))
    model = fit_heights(HeightLabels(height, reach, occupied, np.full(60_000, 20.0)))
    asked = np.abs(height) > 0.4
    np.testing.assert_allclose(model.at(height, reach)[asked], true[asked], atol=0.6)
    # beyond the knots as on the outermost ones
    assert model.at(np.array([50.0]), np.array([99.0])) == model.log_odds[-1, -1]


def test_the_models_that_make_labels_likely_count() -> None:
    knots, reaches = np.array([0.0, 3.0]), np.array([0.0, 20.0])
    models = HeightModels(knots, reaches, np.array([np.full((2, 2), 2.0), np.full((2, 2), -2.0)]))
    where = np.ones(400)

    def mixed(occupied: np.ndarray) -> float:
        labels = HeightLabels(where, where, occupied, where)
        return float(models.mixed(models.shares(labels)).at(where, where)[0])

    assert mixed(np.ones(400, bool)) == pytest.approx(2.0, abs=1e-3)
    assert mixed(np.zeros(400, bool)) == pytest.approx(-2.0, abs=1e-3)
    assert mixed(np.arange(400) % 2 == 0) == pytest.approx(0.0, abs=1e-9)
