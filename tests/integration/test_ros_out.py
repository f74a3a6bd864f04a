"""The map as ROS 2 topics, received and decoded by code that strangers wrote."""

from __future__ import annotations

import contextlib
import queue
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyoctomap import OcTree

from potclient import MapClient
from potclient.cells import CellBox
from potclient.export import export_bt
from potclient.octomap import read_bt
from potclient.ros import types
from potclient.ros.point_clouds import read_point_cloud
from potschemas.answers import occupancy_var
from potserver.config import load_settings
from potserver.server import MapServer
from tests.ros import messages as ros

from .conftest import DEADLINE_S, until
from .ros_strangers import Stranger

# without a namespace: the strangers look for latched messages of no other topics
GRID, OCTOMAP, SURFACES = "/map", "/octomap", "/surfaces"


@pytest.fixture(scope="module")
def server() -> Iterator[MapServer]:
    settings = load_settings(
        overrides={
            "mapping.max_range_m": 12.0,
            "ros.clouds": ["/points"],
            "ros.period_s": 0.05,
            "ros.out": "/",
            "ros.grid_m": 0.5,
            "ros.voxel_m": 0.5,
        }
    )
    with MapServer(settings, listen="tcp/127.0.0.1:0") as server:
        yield server


@pytest.fixture
def client(server: MapServer) -> Iterator[MapClient]:
    """Of a map with one room in it."""
    with MapClient(server.endpoint, timeout_s=DEADLINE_S) as client:
        client.control("clear")
        client.integrate(room(), pose(0.0), robot="r1")
        yield client


@pytest.fixture
def nodes(server: MapServer) -> Iterator[Stranger]:
    nodes = Stranger(server.endpoint)
    yield nodes
    nodes.close()


def room() -> np.ndarray[Any, Any]:
    """The walls and the floor of a room of 12 by 10 m, seen from 1 m above its middle."""
    rng = np.random.default_rng(5)
    walls = rng.uniform((-6, -5, -1), (6, 5, 1.5), (3000, 3))
    side = rng.integers(0, 2, 3000) * 2 - 1
    along = rng.integers(0, 2, 3000) == 0
    walls[along, 0] = 6 * side[along]
    walls[~along, 1] = 5 * side[~along]
    floor = rng.uniform((-6, -5, -1), (6, 5, -1), (1000, 3))
    return np.concatenate([walls, floor]).astype(np.float32)


def pose(x: float) -> np.ndarray[Any, Any]:
    T = np.eye(4)
    T[:3, 3] = x, 0.0, 1.0
    return T


def expected_grid(client: MapClient, grid: Any) -> np.ndarray[Any, Any]:
    """What an OccupancyGrid should hold, from one dense question: percent, -1 where no height of its band was observed."""
    nx, ny, resolution = grid.info.width, grid.info.height, grid.info.resolution
    origin = np.array([grid.info.origin.position.x, grid.info.origin.position.y])
    x, y = (origin[a] + (np.arange(n) + 0.5) * resolution for a, n in enumerate((nx, ny)))
    n_heights = 3  # of the band from .1 to 1.5 m, half a metre apart at most
    heights = 0.1 + (np.arange(n_heights) + 0.5) * 1.4 / n_heights
    points = np.stack(np.meshgrid(x, y, heights, indexing="ij"), axis=-1)
    answer = client.occupancy(points.reshape(-1, 3))
    likeliest = np.where(answer.observed, answer.mean, -1).reshape(nx, ny, -1).max(axis=2)
    return np.where(likeliest < 0, -1, np.rint(100 * likeliest)).astype(int).T


def newest(inbox: queue.Queue[Any], condition: Any, what: str) -> Any:
    """Wait until a message fits."""
    seen: list[Any] = []

    def look() -> bool:
        with contextlib.suppress(queue.Empty):
            while True:
                seen.append(inbox.get_nowait())
        return bool(seen) and condition(seen[-1])

    until(look, what)
    return seen[-1]


def test_our_topics_are_listed(nodes: Stranger, client: MapClient) -> None:
    topics = until(lambda: (t := nodes.topics()) and {GRID, OCTOMAP, SURFACES} <= set(t) and t, "our topics")
    assert topics[GRID] == [types.OCCUPANCY_GRID]
    assert topics[f"{GRID}_updates"] == [types.OCCUPANCY_GRID_UPDATE]
    assert topics[OCTOMAP] == [types.OCTOMAP]
    assert topics[SURFACES] == [types.POINT_CLOUD]


def test_nothing_is_computed_while_nobody_listens() -> None:
    settings = load_settings(overrides={"ros.clouds": ["/points"], "ros.period_s": 0.01})
    with MapServer(settings, listen="tcp/127.0.0.1:0") as server:
        with MapClient(server.endpoint, timeout_s=DEADLINE_S) as client:
            for x in (0.0, 0.1, 0.2):  # each takes several of the bridge's periods
                client.integrate(room(), pose(x), robot="r1")
        assert server.health.counter("queries.grid.ok") == 0
        assert server.health.counter("ros.maps.sent") == 0


def test_the_occupancy_grid_is_the_band_of_the_map_by_nav2s_convention(
    nodes: Stranger, client: MapClient
) -> None:
    grid = nodes.subscribe(GRID, types.OCCUPANCY_GRID, latched=True).get(timeout=DEADLINE_S)
    values = grid.data.reshape(grid.info.height, grid.info.width)
    assert grid.header.frame_id == "map"
    assert values.min() == -1
    assert values.max() > 90
    assert np.abs(values - expected_grid(client, grid)).max() <= 1  # percent: rounding
    column = int((0.25 - grid.info.origin.position.x) / grid.info.resolution)
    row = int((0.25 - grid.info.origin.position.y) / grid.info.resolution)
    assert 0 <= values[row, column] < 10  # the middle of the room is free


class Costmap:
    """Keeps the grid as Nav2's static layer does: whole ones, and the updates between them, in the order in which they come."""

    def __init__(self, nodes: Stranger) -> None:
        self._inbox = nodes.subscribe(f"{GRID}_updates", types.OCCUPANCY_GRID_UPDATE)
        nodes.subscribe(GRID, types.OCCUPANCY_GRID, latched=True, inbox=self._inbox)
        self.grid: Any = None
        self.values = np.zeros((0, 0), int)
        self.n_updates = 0

    def listen(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._take(self._inbox.get_nowait())

    def _take(self, message: Any) -> None:
        if message.__msgtype__ == types.OCCUPANCY_GRID:
            self.grid = message
            self.values = message.data.reshape(message.info.height, message.info.width).astype(int)
            return
        assert message.width * message.height <= self.values.size
        rows, columns = (
            slice(message.y, message.y + message.height),
            slice(message.x, message.x + message.width),
        )
        self.values[rows, columns] = message.data.reshape(message.height, message.width)
        self.n_updates += 1

    def is_true(self, client: MapClient) -> bool:
        """Whether it is what a dense question gives."""
        self.listen()
        return self.grid is not None and bool(
            np.abs(self.values - expected_grid(client, self.grid)).max() <= 1
        )


def test_whoever_comes_late_gets_the_grid_and_then_what_changes(nodes: Stranger, client: MapClient) -> None:
    nodes.subscribe(GRID, types.OCCUPANCY_GRID, latched=True).get(timeout=DEADLINE_S)
    late = Costmap(nodes)
    until(lambda: late.is_true(client), "the whole grid")
    # things inside the room, so that the map does not grow; changes go out whole until the bridge knows who wants updates
    things = room()[::2] * np.array([0.6, 0.6, 1.0], np.float32)

    def is_updated() -> bool:
        client.integrate(things, pose(0.0), robot="r2")
        late.listen()
        return late.n_updates > 0

    until(is_updated, "an update")
    until(lambda: late.is_true(client), "the updates to make the grid that a dense question gives")


def test_a_grid_that_grows_is_sent_whole(nodes: Stranger, client: MapClient) -> None:
    inbox = nodes.subscribe(GRID, types.OCCUPANCY_GRID, latched=True)
    small = inbox.get(timeout=DEADLINE_S)
    client.integrate(room(), pose(40.0), robot="r1")
    large = newest(inbox, lambda g: g.info.width > small.info.width, "a larger grid")
    assert large.info.origin.position.x <= small.info.origin.position.x
    values = large.data.reshape(large.info.height, large.info.width)
    assert np.abs(values - expected_grid(client, large)).max() <= 1


def test_a_map_that_is_cleared_is_unknown(nodes: Stranger, client: MapClient) -> None:
    inbox = nodes.subscribe(GRID, types.OCCUPANCY_GRID, latched=True)
    inbox.get(timeout=DEADLINE_S)
    client.control("clear")
    newest(inbox, lambda grid: bool((grid.data == -1).all()), "a grid of unknown cells")


def test_the_octomap_is_the_one_that_is_exported(nodes: Stranger, client: MapClient, tmp_path: Path) -> None:
    message = nodes.subscribe(OCTOMAP, types.OCTOMAP, latched=True).get(timeout=DEADLINE_S)
    assert (message.binary, message.id, message.resolution) == (True, "OcTree", 0.5)
    file = tmp_path / "map.bt"
    info = client.info()
    tiles = np.floor(np.array([info.lower, info.upper]) / info.tile_size_m)
    box = CellBox.around(tiles[0] * info.tile_size_m, (tiles[1] + 1) * info.tile_size_m, 0.5)
    export_bt(client, file, box)
    _, _, tree = file.read_bytes().partition(b"\ndata\n")
    assert message.data.tobytes() == tree
    leaves, _ = read_bt(file)
    theirs = OcTree(str(file).encode())
    assert theirs.getNumLeafNodes() == len(leaves.depth)
    wall = theirs.search([6.0, 0.0, 1.0])
    assert theirs.isNodeOccupied(wall)
    assert not theirs.isNodeOccupied(theirs.search([0.0, 0.0, 1.0]))


def test_surfaces_are_where_the_map_says_one_half(nodes: Stranger, client: MapClient) -> None:
    message = nodes.subscribe(SURFACES, types.POINT_CLOUD, latched=True).get(timeout=DEADLINE_S)
    assert [field.name for field in message.fields] == ["x", "y", "z", "sd", "rgb"]
    points = read_point_cloud(message).points
    assert len(points) > 500
    answer = client.occupancy(points)
    assert np.median(np.abs(answer.mean - 0.5)) < 0.05
    rows = np.frombuffer(message.data.tobytes(), np.dtype([("xyz", "<f4", 3), ("sd", "<f4"), ("rgb", "<u4")]))
    sd = np.sqrt(occupancy_var(answer.mean.astype(np.float64), answer.latent_var))
    assert np.allclose(rows["sd"], sd, atol=1e-3)
    blue, red = rows["rgb"] & 255, rows["rgb"] >> 16
    assert (blue + red).min() >= 254
    assert np.corrcoef(red, rows["sd"])[0, 1] > 0.9
    walls = np.minimum(np.abs(np.abs(points[:, 0]) - 6), np.abs(np.abs(points[:, 1]) - 5))
    near = np.minimum(walls, np.abs(points[:, 2]))  # the floor is at 0
    assert np.median(near) < 0.5


def test_the_stamp_of_what_goes_out_is_that_of_the_newest_cloud(nodes: Stranger, client: MapClient) -> None:
    inbox = nodes.subscribe(GRID, types.OCCUPANCY_GRID, latched=True)
    stamp_ns = 1_700_000_123 * 10**9
    nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", stamp_ns, (0, 0, 1))))
    nodes.publish("/points", ros.cloud(ros.xyz_rows(room()), "lidar", stamp_ns))
    newest(inbox, lambda grid: grid.header.stamp.sec == 1_700_000_123, "a grid with the cloud's stamp")
