"""The map's messages, decoded by rosbags."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from potclient.octomap import KEY_ORIGIN, OcTreeBuilder
from potclient.ros import maps, types
from tests.ros import messages as ros

HEAD = {"frame_id": "map", "stamp_ns": 5 * 10**9 + 3}


def through_rosbags(message: Any, type_name: str) -> Any:
    return ros.STORE.deserialize_cdr(types.encode(message, type_name), type_name)


def test_the_likeliest_observed_cell_of_a_column_counts() -> None:
    mean = np.array([[[0.1, 0.9], [0.004, 0.0]], [[1.0, 0.2], [0.5, 0.5]]], np.float32)
    observed = np.array([[[True, True], [True, True]], [[False, True], [False, False]]])
    assert maps.grid_values(mean, observed).tolist() == [[90, 0], [20, -1]]


def test_an_occupancy_grid_runs_along_x_first() -> None:
    values = np.array([[1, 2, 3], [4, 5, -1]], np.int8)
    grid = through_rosbags(maps.occupancy_grid(values, (-3.0, 2.5), 0.5, **HEAD), types.OCCUPANCY_GRID)
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (2, 3, 0.5)
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-3.0, 2.5)
    assert grid.data.tolist() == [1, 4, 2, 5, 3, -1]
    assert (grid.header.frame_id, grid.header.stamp.sec, grid.header.stamp.nanosec) == ("map", 5, 3)


def test_an_update_names_its_first_cell() -> None:
    message = maps.occupancy_grid_update(np.array([[7], [8]], np.int8), (3, 4), **HEAD)
    update = through_rosbags(message, types.OCCUPANCY_GRID_UPDATE)
    assert (update.x, update.y, update.width, update.height, update.data.tolist()) == (3, 4, 2, 1, [7, 8])


@pytest.mark.parametrize("n", [0, 1, 9])
def test_an_octomap_has_the_tree_and_no_header_of_a_file(n: int) -> None:
    tree = OcTreeBuilder()
    tree.add(np.arange(3 * n).reshape(n, 3) + KEY_ORIGIN, np.arange(n) % 2 == 0)
    message = through_rosbags(maps.octomap(tree.leaves(), 0.25, **HEAD), types.OCTOMAP)
    assert (message.id, message.binary, message.resolution) == ("OcTree", True, 0.25)
    assert (len(message.data) > 0) == (n > 0)
    assert len(message.data) % 2 == 0


def test_sure_points_are_blue_and_doubtful_ones_yellow() -> None:
    cloud = through_rosbags(
        maps.surface_cloud(np.eye(3), np.array([0.0, 0.25, 0.5], np.float32), **HEAD), types.POINT_CLOUD
    )
    rows = np.frombuffer(cloud.data.tobytes(), np.dtype([("xyz", "<f4", 3), ("sd", "<f4"), ("rgb", "<u4")]))
    assert [f"{colour:06x}" for colour in rows["rgb"]] == ["0000ff", "808080", "ffff00"]


def test_a_map_without_a_surface_is_an_empty_cloud() -> None:
    cloud = through_rosbags(
        maps.surface_cloud(np.zeros((0, 3)), np.zeros(0, np.float32), **HEAD), types.POINT_CLOUD
    )
    assert (cloud.width, len(cloud.data)) == (0, 0)
