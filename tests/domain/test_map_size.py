"""What a map takes, by tiles and by robots."""

from __future__ import annotations

import dataclasses

import numpy as np

from potserver.domain.map_size import MapSize
from potserver.domain.types import Scan, yaw_pose
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings


def _scan(robot: str, x_m: float, seq: int) -> Scan:
    rng = np.random.default_rng(seq)
    angle = rng.uniform(-np.pi, np.pi, 300)
    points = np.stack([6 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-1, 2, 300)], axis=1)
    return Scan(
        points=points.astype(np.float32), T_map_sensor=yaw_pose(x_m, 0.0, 0.0), robot_id=robot, seq=seq
    )


def test_the_size_of_a_map_follows_its_changes() -> None:
    mapper, size = MappingService(settings=MappingSettings(max_range_m=12.0), threads=1), MapSize()
    assert (size.of(mapper.state), size.of_robot("r1")) == (0, 0)
    for seq, (robot, x_m) in enumerate((("r1", 0.0), ("r2", 4.0), ("r1", 60.0), ("r2", 4.0))):
        mapper.integrate(_scan(robot, x_m, seq))
        n_bytes, fresh = size.of(mapper.state), MapSize()
        assert mapper.state.tiled is not None
        assert n_bytes == sum(tile.n_bytes for tile in mapper.state.tiled.tiles.values()) > 10_000
        assert fresh.of(mapper.state) == n_bytes
        shares = [size.of_robot(robot) for robot in ("r1", "r2")]
        assert shares == [fresh.of_robot(robot) for robot in ("r1", "r2")]
        assert 0.99 * n_bytes < sum(shares) <= n_bytes
    assert size.of_robot("r3") == 0
    assert size.of_robot("r1") > size.of_robot("r2"), "it saw two places"
    mapper.remove_robot("r1")
    assert size.of(mapper.state) < n_bytes
    assert size.of_robot("r1") == 0 < size.of_robot("r2")
    mapper.clear()
    assert (size.of(mapper.state), size.of_robot("r2")) == (0, 0)


def test_tiles_of_another_epoch_are_counted_anew() -> None:
    mapper, size = MappingService(settings=MappingSettings(max_range_m=12.0), threads=1), MapSize()
    mapper.integrate(_scan("r1", 0.0, 0))
    whole = size.of(mapper.state)
    tiled = mapper.state.tiled
    assert tiled is not None
    smaller = {index: tile._replace(rows=tile.rows.take(slice(0, 1))) for index, tile in tiled.tiles.items()}
    other = dataclasses.replace(
        mapper.state, tiled=tiled._replace(tiles=smaller), epoch=mapper.state.epoch + 1
    )
    assert size.of(other) == MapSize().of(other) < whole
    assert size.of(mapper.state) == whole
