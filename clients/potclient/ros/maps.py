"""A map as ROS messages: `OccupancyGrid` and its updates, `Octomap`, and a cloud of surface points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Bool, Float32, Float64
from potclient.octomap import Leaves, tree_bytes
from potclient.ros.point_clouds import make_point_cloud
from potclient.ros.types import OCCUPANCY_GRID, OCCUPANCY_GRID_UPDATE, OCTOMAP, header, make

Int8 = NDArray[np.int8]

UNKNOWN = -1  # the value of an `OccupancyGrid`'s cell where nothing was observed
_SD_OF_YELLOW = 0.5  # sd of the probability: the largest there is


def grid_values(mean: Float32, observed: Bool) -> Int8:
    """Columns of cells as an `OccupancyGrid` has them: the likeliest observed cell in percent, -1 where none was observed.

    Args:
        mean: (nx, ny, nz) P(occupied).
        observed: (nx, ny, nz).
    Returns:
        (nx, ny) -1, or 0 .. 100.
    """
    return percent(np.where(observed, mean, np.float32(-1.0)).max(axis=2))


def percent(likeliest: Float32) -> Int8:
    """Probabilities (nx, ny), below 0 where nothing was observed, as an `OccupancyGrid` has them: -1, or 0 .. 100."""
    return np.where(likeliest < 0, UNKNOWN, np.rint(100.0 * likeliest)).astype(np.int8)


def occupancy_grid(
    values: Int8, lower: tuple[float, float], resolution: float, *, frame_id: str, stamp_ns: int
) -> Any:
    """A `nav_msgs/OccupancyGrid`.

    Args:
        values: (nx, ny) -1, or 0 .. 100.
        lower: m, map frame: the corner of cell (0, 0).
        resolution: m.
    """
    x, y = lower
    origin = make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
        orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
    )
    head = header(frame_id, stamp_ns)
    info = make(
        "nav_msgs/msg/MapMetaData",
        map_load_time=head.stamp,
        resolution=resolution,
        width=values.shape[0],
        height=values.shape[1],
        origin=origin,
    )
    return make(OCCUPANCY_GRID, header=head, info=info, data=np.ascontiguousarray(values.T).reshape(-1))


def occupancy_grid_update(values: Int8, first: tuple[int, int], *, frame_id: str, stamp_ns: int) -> Any:
    """A `map_msgs/OccupancyGridUpdate`: cells of the last `OccupancyGrid` that have other values now.

    Args:
        values: (nx, ny) -1, or 0 .. 100.
        first: The grid's cell that values[0, 0] is.
    """
    return make(
        OCCUPANCY_GRID_UPDATE,
        header=header(frame_id, stamp_ns),
        x=first[0],
        y=first[1],
        width=values.shape[0],
        height=values.shape[1],
        data=np.ascontiguousarray(values.T).reshape(-1),
    )


def octomap(leaves: Leaves, resolution: float, *, frame_id: str, stamp_ns: int) -> Any:
    """A binary `octomap_msgs/Octomap`: voxels are free or occupied, the others unknown."""
    tree, _ = tree_bytes(leaves)
    return make(
        OCTOMAP,
        header=header(frame_id, stamp_ns),
        binary=True,
        id="OcTree",
        resolution=resolution,
        data=np.frombuffer(tree, np.int8),
    )


def surface_cloud(points: Float32 | Float64, sd: Float32, *, frame_id: str, stamp_ns: int) -> Any:
    """A `PointCloud2` of surface points with the fields x, y, z, sd and rgb: blue where the map is sure, yellow where not.

    Args:
        points: (N, 3) m, map frame.
        sd: (N,) standard deviation of the probability there.
    """
    doubt = np.clip(sd / _SD_OF_YELLOW, 0.0, 1.0).astype(np.float64)
    red_green = np.rint(255 * doubt).astype(np.uint32)
    blue = np.rint(255 * (1.0 - doubt)).astype(np.uint32)
    rgb = (red_green << 16 | red_green << 8 | blue).view(np.float32)  # as RViz and PCL pack a colour
    x, y, z = np.ascontiguousarray(points.T, np.float32)
    fields = {"x": x, "y": y, "z": z, "sd": sd.astype(np.float32), "rgb": rgb}
    return make_point_cloud(fields, frame_id, stamp_ns)
