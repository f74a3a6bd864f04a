"""Grounds of made-up places."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.ground import ground_of


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
