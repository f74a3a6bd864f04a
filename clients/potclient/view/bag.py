"""A map and its robots as ROS 2 messages in an MCAP file, for Foxglove, RViz, and `potclient publish`. Needs the extra `ros`.

Topics:
  /potserver/surfaces   PointCloud2 x y z sd rgb: where the probability is one half; of a planar map the occupied cells
  /potserver/free, /potserver/unknown   PointCloud2: centres of free cells, and of unknown cells beside them
  /potserver/map        OccupancyGrid, where one was asked for
  /<robot>/points, /tf  PointCloud2 of each scan's echoes in the sensor's frame, and where the sensor was
"""

from __future__ import annotations

import re
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np

from potclient.arrays import Float32, Float64
from potclient.mesh import Mesh
from potclient.occupancy import Grid
from potclient.ros import types
from potclient.ros.maps import Int8, occupancy_grid, surface_cloud
from potclient.ros.point_clouds import make_point_cloud
from potclient.ros.transforms import transform
from potclient.view.layers import Layers, TileIndex, layers_of
from potclient.watched import WatchedCloud
from potschemas import messages

MAP_FRAME = "map"
SURFACES, FREE, UNKNOWN, GRID = (f"/potserver/{name}" for name in ("surfaces", "free", "unknown", "map"))


class BagPicture:
    """Writes what it is shown: a `potclient.view.layers.Picture`. Not thread-safe.

    Robots' beams without an echo are left out, because a PointCloud2 cannot tell them, and so are numbers over time.

    Args:
        path: The `.mcap`, which is there after `close`.
    Raises:
        UsageError: the package rosbags is missing.
    """

    def __init__(self, path: Path) -> None:
        self._store = types.typestore()
        from rosbags.rosbag2 import StoragePlugin, Writer

        self._path, self._folder = path, path.with_name(f".{path.stem}.partial")
        shutil.rmtree(self._folder, ignore_errors=True)
        self._writer: Any = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._is_open = True
        self._topics: dict[str, Any] = {}
        self._stamp_ns = time.time_ns()
        self._tiles: dict[TileIndex, Layers] = {}

    def close(self) -> None:
        """Put the file in its place."""
        self._writer.close()
        self._is_open = False
        (written,) = self._folder.glob("*.mcap")
        written.replace(self._path)
        self.discard()

    def discard(self) -> None:
        """Leave nothing behind but a file that was closed."""
        if self._is_open:
            self._writer.close()
            self._is_open = False
        shutil.rmtree(self._folder, ignore_errors=True)

    def at(self, stamp_ns: int, revision: int | None = None) -> None:
        """What is told of the map from now on was so then."""
        self._stamp_ns = stamp_ns

    def draw_tile(self, tile: TileIndex, grid: Grid) -> None:
        """Take in a tile as it is now; `all_drawn` writes it."""
        self._tiles[tile] = layers_of(grid)

    def forget_tiles(self) -> None:
        """The map was cleared or replaced."""
        self._tiles.clear()
        self.all_drawn()

    def all_drawn(self) -> None:
        """Write the map: every tile was shown as it is now."""
        tiles = self._tiles.values()
        mesh = Mesh.concatenate([layers.mesh for layers in tiles])
        surface = surface_cloud(mesh.vertices, mesh.sd, frame_id=MAP_FRAME, stamp_ns=self._stamp_ns)
        self._write(SURFACES, surface, types.POINT_CLOUD)
        free, unknown = ([layers.free for layers in tiles], [layers.unknown for layers in tiles])
        for topic, parts in ((FREE, free), (UNKNOWN, unknown)):
            points = make_point_cloud(
                _xyz(np.concatenate([np.zeros((0, 3)), *parts])), MAP_FRAME, self._stamp_ns
            )
            self._write(topic, points, types.POINT_CLOUD)

    def draw_grid(self, values: Int8, lower: tuple[float, float], resolution: float) -> None:
        """Write the map seen from above, see `potclient.ros.maps.occupancy_grid`."""
        message = occupancy_grid(values, lower, resolution, frame_id=MAP_FRAME, stamp_ns=self._stamp_ns)
        self._write(GRID, message, types.OCCUPANCY_GRID)

    def draw_cloud(self, cloud: WatchedCloud) -> bool:
        """Write a robot's scan and where it was taken; False if the cloud does not say so."""
        if cloud.T_map_sensor is None:
            return False
        frame = _name(cloud.robot)
        tf = transform(MAP_FRAME, frame, cloud.T_map_sensor, cloud.stamp_ns)
        self._write("/tf", tf, types.TF)
        echoes = make_point_cloud(_xyz(cloud.points[cloud.is_return]), frame, cloud.stamp_ns)
        self._write(f"/{frame}/points", echoes, types.POINT_CLOUD)
        return True

    def draw_receipt(self, receipt: messages.Receipt) -> None:
        """Not kept."""

    def draw_stats(self, stats: messages.Stats, map_id: str) -> None:
        """Not kept."""

    def _write(self, topic: str, message: Any, kind: str) -> None:
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._topics[topic], time.time_ns(), types.encode(message, kind))


def _xyz(points: Float32 | Float64) -> dict[str, Float32]:
    x, y, z = np.ascontiguousarray(points.T, np.float32)
    return {"x": x, "y": y, "z": z}


def _name(robot: str) -> str:
    """A robot's id as a word that ROS takes for a name."""
    word = re.sub(r"\W", "_", robot, flags=re.ASCII)
    return word if word[0].isalpha() else f"r{word}"
