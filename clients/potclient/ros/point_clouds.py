"""`sensor_msgs/PointCloud2` and arrays, both ways."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Float32, Float64
from potclient.errors import RosMessageError
from potclient.ros.types import POINT_CLOUD, frame_of, header, make, stamp_of

_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField.datatype
_DATATYPES = {np.dtype(name): number for number, name in _DTYPES.items()}
_TIME_NAMES = ("t", "time", "timestamp", "time_stamp", "offset_time")  # of Ouster, Velodyne, Hesai, Livox


class PointCloud(NamedTuple):
    """The points of one message that are numbers."""

    points: Float32  # (N, 3) m, in the frame `frame_id`; finite
    times: (
        Float64 | None
    )  # (N,) of each point, in the sensor's own unit and from its own start; None if there are none
    frame_id: str
    stamp_ns: int
    n_invalid: int  # points that were left out: NaN or infinite


def read_point_cloud(message: Any) -> PointCloud:
    """The points of a `PointCloud2`, found by its fields, offsets and steps; either byte order, organised or not.

    Raises:
        RosMessageError: no float field x, y or z; fields, steps and bytes do not fit together.
    """
    rows = _rows(message)
    xyz = np.empty((len(rows), 3), np.float32)
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and is left out
        for column, axis in zip(xyz.T, "xyz", strict=True):
            column[...] = rows[axis]
    finite = np.isfinite(xyz).all(axis=1)
    time_name = next((name for name in _TIME_NAMES if name in (rows.dtype.names or ())), None)
    times = None if time_name is None else rows[time_name].astype(np.float64)[finite]
    return PointCloud(
        points=xyz if finite.all() else xyz[finite],
        times=times,
        frame_id=frame_of(message.header.frame_id),
        stamp_ns=stamp_of(message.header),
        n_invalid=int((~finite).sum()),
    )


def make_point_cloud(fields: Mapping[str, NDArray[Any]], frame_id: str, stamp_ns: int) -> Any:
    """A dense, unorganised `PointCloud2`.

    Args:
        fields: (N,) arrays by name, in the order of the fields; x, y, z in m.
    """
    dtype = np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in fields.items()])
    rows = np.zeros(len(next(iter(fields.values()))), dtype)
    for name, array in fields.items():
        rows[name] = array
    offsets = np.cumsum([0, *(array.dtype.itemsize for array in fields.values())]).tolist()
    return make(
        POINT_CLOUD,
        header=header(frame_id, stamp_ns),
        height=1,
        width=len(rows),
        fields=[
            make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=_DATATYPES[array.dtype.newbyteorder("=")],
                count=1,
            )
            for offset, (name, array) in zip(offsets, fields.items(), strict=False)
        ],
        is_bigendian=False,
        point_step=dtype.itemsize,
        row_step=dtype.itemsize * len(rows),
        data=np.frombuffer(rows.tobytes(), np.uint8),
        is_dense=True,
    )


def _rows(message: Any) -> NDArray[np.void]:
    """(N,) the points as records of their scalar fields; a view of the message's bytes where rows have no padding."""
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    row_step = int(message.row_step) if height > 1 else width * step  # of one row, some drivers leave it 0
    n_bytes = len(message.data)
    if step < 1 or row_step < width * step or (height - 1) * row_step + width * step > n_bytes:
        raise RosMessageError(
            f"point cloud: {height} rows of {width} points, {step} bytes a point and {row_step} a row, need more than its"
            f" {n_bytes} bytes",
            reason="bad_layout",
        )
    order = ">" if message.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for field in message.fields:
        kind = _DTYPES.get(int(field.datatype))
        if kind is None or int(field.count) > 1 or field.name in names:
            continue  # a histogram, or a type of tomorrow: no coordinate
        dtype = np.dtype(order + kind)
        if int(field.offset) + dtype.itemsize > step:
            raise RosMessageError(
                f"point cloud: field {field.name!r} ends at byte {field.offset + dtype.itemsize} of {step}",
                reason="bad_layout",
            )
        names.append(str(field.name))
        formats.append(dtype)
        offsets.append(int(field.offset))
    missing = [axis for axis in "xyz" if axis not in names or formats[names.index(axis)].kind != "f"]
    if missing:
        have = ", ".join(str(field.name) for field in message.fields) or "none"
        raise RosMessageError(
            f"point cloud: no float field {', '.join(missing)}; its fields are {have}", reason="bad_fields"
        )
    record = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    grid: NDArray[np.void] = np.ndarray(
        (height, width), record, np.ascontiguousarray(message.data), strides=(row_step, step)
    )
    return grid.reshape(-1)
