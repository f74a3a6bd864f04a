"""ROS messages for tests, made with rosbags' own types and never with our conversions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
# as they stand in the packages map_msgs and octomap_msgs, which rosbags does not bring
STORE.register(
    get_types_from_msg(
        """std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
""",
        "map_msgs/msg/OccupancyGridUpdate",
    )
)
STORE.register(
    get_types_from_msg(
        """# A 3D map in binary format, as Octree
std_msgs/Header header

# Flag to denote a binary (only free/occupied) or full occupancy octree (.bt/.ot file)
bool binary

# Class id of the contained octree
string id

# Resolution (in m) of the smallest octree nodes
float64 resolution

# binary serialization of octree, use conversions.h to read and write octrees
int8[] data
""",
        "octomap_msgs/msg/Octomap",
    )
)


def make(type_name: str, **fields: Any) -> Any:
    return STORE.types[type_name](**fields)


def header(frame: str, stamp_ns: int) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def cdr(message: Any, type_name: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, type_name))


def quaternion(yaw: float = 0.0, roll: float = 0.0) -> Any:
    """Turned by `roll` about x, and then by `yaw` about z."""
    cy, sy, cr, sr = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(roll / 2), np.sin(roll / 2)
    x, y, z, w = (float(v) for v in (cy * sr, sy * sr, sy * cr, cy * cr))
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def transform(
    parent: str,
    child: str,
    stamp_ns: int,
    xyz: Sequence[float] = (0, 0, 0),
    yaw: float = 0.0,
    roll: float = 0.0,
) -> Any:
    x, y, z = (float(v) for v in xyz)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(parent, stamp_ns),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=quaternion(yaw, roll),
        ),
    )


def tf(*transforms: Any) -> Any:
    return make("tf2_msgs/msg/TFMessage", transforms=list(transforms))


def pose(xyz: Sequence[float], yaw: float = 0.0) -> Any:
    x, y, z = (float(v) for v in xyz)
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=quaternion(yaw),
    )


def pose_stamped(frame: str, stamp_ns: int, xyz: Sequence[float], yaw: float = 0.0) -> Any:
    return make("geometry_msgs/msg/PoseStamped", header=header(frame, stamp_ns), pose=pose(xyz, yaw))


def odometry(frame: str, child: str, stamp_ns: int, xyz: Sequence[float], yaw: float = 0.0) -> Any:
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return make(
        "nav_msgs/msg/Odometry",
        header=header(frame, stamp_ns),
        child_frame_id=child,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(xyz, yaw), covariance=np.zeros(36)),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def cloud(
    rows: np.ndarray[Any, Any],
    frame: str = "lidar",
    stamp_ns: int = 0,
    *,
    height: int = 1,
    row_padding: int = 0,
) -> Any:
    """A `PointCloud2` of records: fields, offsets and byte order as their dtype says."""
    kinds = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=int(offset),
            datatype=kinds[dtype.base.str[1:]],
            count=int(np.prod(dtype.shape, dtype=int)),
        )
        for name, (dtype, offset) in ((n, rows.dtype.fields[n][:2]) for n in rows.dtype.names)
    ]
    width = len(rows) // height
    data = b"".join(
        rows[i * width : (i + 1) * width].tobytes() + b"\xaa" * row_padding for i in range(height)
    )
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header(frame, stamp_ns),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=rows.dtype["x"].str.startswith(">"),
        point_step=rows.dtype.itemsize,
        row_step=width * rows.dtype.itemsize + row_padding,
        data=np.frombuffer(data, np.uint8),
        is_dense=False,
    )


def xyz_rows(points: np.ndarray[Any, Any], dtype: Any = None) -> np.ndarray[Any, Any]:
    """(N, 3) points as records for `cloud`."""
    rows = np.zeros(len(points), dtype or [("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
    rows["x"], rows["y"], rows["z"] = points.T
    return rows


def laser(
    ranges: Sequence[float], *, frame: str = "laser", stamp_ns: int = 0, start: float = 0.0, step: float = 0.1
) -> Any:
    return make(
        "sensor_msgs/msg/LaserScan",
        header=header(frame, stamp_ns),
        angle_min=start,
        angle_max=start + step * (len(ranges) - 1),
        angle_increment=step,
        time_increment=0.0,
        scan_time=0.1,
        range_min=0.1,
        range_max=12.0,
        ranges=np.asarray(ranges, np.float32),
        intensities=np.zeros(0, np.float32),
    )
