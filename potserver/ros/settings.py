"""The table `ros` of the settings."""

from __future__ import annotations

import dataclasses
import re
from typing import Annotated

import numpy as np

from potclient.arrays import Float64
from potclient.poses import quaternion_pose
from potserver.errors import SettingsError

TF = "/tf"  # as the source of poses
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+\Z")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class RosSettings:
    """ROS 2 topics that come in and go out; none come in unless `clouds` names some."""

    clouds: Annotated[
        tuple[str, ...],
        "topics of PointCloud2 or LaserScan to map, in every namespace; each namespace is a robot",
    ] = ()
    domain: Annotated[int, "ROS_DOMAIN_ID"] = 0
    map: Annotated[str | None, "id of the map; unset: the first that is served"] = None
    robot: Annotated[str, "id of the robot of topics without a namespace"] = "ros"
    map_frame: Annotated[str, "the map's frame, in `/tf` and in what goes out"] = "map"
    poses: Annotated[
        str, "`/tf`, with `/tf_static`; or a topic of Odometry, PoseStamped or PoseWithCovarianceStamped"
    ] = TF
    extrinsic: Annotated[
        tuple[float, ...],
        "sensor in the frame of such a topic's poses: x y z (m) qx qy qz qw; none: by `/tf_static`",
    ] = ()
    sim_time: Annotated[
        bool,
        "stamps are a simulation's: clouds go in with the computer's time, so that a second run is not too old",
    ] = False
    wait_s: Annotated[float, "how long a cloud waits for its pose"] = 0.5
    min_range_m: Annotated[float, "points nearer than this are the robot itself"] = 0.0
    out: Annotated[
        str,
        'namespace of what goes out: `map`, `map_updates`, `octomap`, `surfaces`; `/`: none before them; `""`: nothing',
    ] = "/potserver"
    grid_m: Annotated[float, "edge of the cells of `map`, an OccupancyGrid"] = 0.1
    band_m: Annotated[
        tuple[float, ...], "heights that count in `map`, lowest and highest; of a planar map its plane"
    ] = (0.1, 1.5)
    voxel_m: Annotated[float, "edge of the voxels of `octomap` and `surfaces`"] = 0.25
    box_m: Annotated[
        tuple[float, ...], "what goes out of the map: lower and upper corner, six numbers; none: all"
    ] = ()
    period_s: Annotated[float, "shortest time between two messages of a topic that goes out"] = 1.0

    def __post_init__(self) -> None:
        for name, topics in (("clouds", self.clouds), ("poses", (self.poses,))):
            for topic in topics:
                _need(f"ros.{name}", topic, _TOPIC.match(topic) is not None, "a topic, e.g. /lidar/points")
        legal = self.out in ("", "/") or _TOPIC.match(self.out) is not None
        _need("ros.out", self.out, legal, "a namespace, e.g. /potserver")
        _need("ros.domain", self.domain, 0 <= self.domain <= 232, "0 to 232")
        _need("ros.map_frame", self.map_frame, bool(self.map_frame.strip("/")), "a frame")
        for name in ("wait_s", "min_range_m"):
            _need(f"ros.{name}", getattr(self, name), 0 <= getattr(self, name) < np.inf, "0 or more")
        for name in ("grid_m", "voxel_m", "period_s"):
            _need(f"ros.{name}", getattr(self, name), 0 < getattr(self, name) < np.inf, "a positive number")
        band, box, extrinsic = self.band_m, self.box_m, self.extrinsic
        _need("ros.band_m", band, len(band) == 2 and band[0] <= band[1], "lowest and highest, m")
        sorted_box = len(box) == 6 and all(box[i] < box[i + 3] for i in range(3))
        _need(
            "ros.box_m", box, not box or sorted_box, "x y z of the lower corner, and x y z of the upper one"
        )
        unit = len(extrinsic) == 7 and abs(float(np.linalg.norm(extrinsic[3:])) - 1) < 0.01
        _need(
            "ros.extrinsic", extrinsic, not extrinsic or unit, "x y z qx qy qz qw, the quaternion of length 1"
        )

    def out_topic(self, name: str) -> str:
        """A topic that goes out."""
        return f"{self.out.rstrip('/')}/{name}"

    @property
    def sensor_pose(self) -> Float64 | None:
        """(4, 4) of `extrinsic`; None if there is none."""
        if not self.extrinsic:
            return None
        x, y, z, qx, qy, qz, qw = self.extrinsic
        return quaternion_pose(np.array([x, y, z]), np.array([qw, qx, qy, qz]))


def _need(name: str, value: object, ok: bool, what: str) -> None:
    if not ok:
        raise SettingsError(f"{name} is {value!r}, need {what}")
