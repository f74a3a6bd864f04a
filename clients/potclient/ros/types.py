"""ROS message types: their bytes (CDR), their names, and the hashes by which rmw_zenoh tells definitions apart."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from potclient.errors import RosMessageError, UsageError
from potclient.extras import how_to_install

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
TF = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
OCCUPANCY_GRID_UPDATE = "map_msgs/msg/OccupancyGridUpdate"
OCTOMAP = "octomap_msgs/msg/Octomap"

NO_HASH = "TypeHashNotSupported"  # what ROS 2 Humble has in the place of a hash

# of packages that rosbags does not bring
_DEFINITIONS = {
    OCCUPANCY_GRID_UPDATE: """\
std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
""",
    OCTOMAP: """\
std_msgs/Header header
bool binary
string id
float64 resolution
int8[] data
""",
}


def rosbags_missing(error: ImportError) -> UsageError:
    """What to say where the extra is not installed."""
    return UsageError(f"ROS messages need the package rosbags: {how_to_install('ros')} ({error})")


@functools.cache
def typestore() -> Typestore:
    """All message types that are known here.

    Raises:
        UsageError: the package rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise rosbags_missing(error) from error
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


def decode(payload: bytes, type_name: str) -> Any:
    """A message from its CDR bytes, encapsulation header included.

    Raises:
        RosMessageError: they are no such message.
    """
    from rosbags.serde import SerdeError

    try:
        return typestore().deserialize_cdr(payload, type_name)
    except SerdeError as error:
        raise RosMessageError(f"{len(payload)} bytes are not a {type_name}: {error}") from error


def encode(message: Any, type_name: str) -> bytes:
    """The CDR bytes of a message, little-endian, encapsulation header included."""
    return bytes(typestore().serialize_cdr(message, type_name))


def make(type_name: str, **fields: Any) -> Any:
    """A message of these fields."""
    return typestore().types[type_name](**fields)


def header(frame_id: str, stamp_ns: int) -> Any:
    """A `std_msgs/Header`."""
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def stamp_of(header: Any) -> int:
    """The stamp of a header, ns."""
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def frame_of(frame_id: str) -> str:
    """A frame's name without the leading slash that old drivers write."""
    return frame_id.lstrip("/")


def type_hash(type_name: str) -> str:
    """`RIHS01_...` of a type's definition."""
    return typestore().hash_rihs01(type_name)


def dds_name(type_name: str) -> str:
    """`sensor_msgs/msg/PointCloud2` as it stands in the keys of rmw_zenoh."""
    package, folder, name = type_name.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def ros_name(dds: str) -> str | None:
    """The inverse of `dds_name`; None for other words."""
    parts = dds.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return None
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
