"""`PointCloud2` in every layout that drivers write, and back."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potclient.errors import RosMessageError
from potclient.ros import types
from potclient.ros.point_clouds import make_point_cloud, read_point_cloud
from tests.ros import messages as ros

NUMBERS = st.floats(-1e4, 1e4, width=32)


@st.composite
def layouts(draw: st.DrawFn) -> np.dtype:
    """x, y, z of either width and order among other fields, with gaps between and behind."""
    order = draw(st.sampled_from("<>"))
    kinds = {name: draw(st.sampled_from(("f4", "f8"))) for name in "xyz"}
    kinds |= {name: draw(st.sampled_from(("u1", "i2", "u4", "f4"))) for name in ("intensity", "ring")}
    names = draw(st.permutations(sorted(kinds)))
    offsets, end = [], 0
    for name in names:
        end += draw(st.integers(0, 5))
        offsets.append(end)
        end += np.dtype(kinds[name]).itemsize
    formats = [order + kinds[name] for name in names]
    step = end + draw(st.integers(0, 9))
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


@given(
    layout=layouts(),
    points=st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=12),
    height=st.sampled_from((1, 2, 3)),
    padding=st.integers(0, 7),
)
def test_points_are_found_by_their_fields_offsets_and_steps(
    layout: np.dtype, points: list, height: int, padding: int
) -> None:
    array = np.array(points * height, np.float32)
    message = ros.cloud(ros.xyz_rows(array, layout), stamp_ns=7, height=height, row_padding=padding)
    read = read_point_cloud(types.decode(ros.cdr(message, types.POINT_CLOUD), types.POINT_CLOUD))
    assert np.array_equal(read.points, array)
    assert (read.frame_id, read.stamp_ns, read.n_invalid, read.times) == ("lidar", 7, 0, None)


def test_points_that_are_no_numbers_are_left_out_and_counted() -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [4, 5, np.inf], [6, 7, 8]], np.float32)
    read = read_point_cloud(ros.cloud(ros.xyz_rows(points), height=2))
    assert read.points.tolist() == [[1, 2, 3], [6, 7, 8]]
    assert read.n_invalid == 2


def test_doubles_beyond_float32_are_no_numbers() -> None:
    points = np.array([[1, 2, 3], [1e300, 0, 0]])
    read = read_point_cloud(ros.cloud(ros.xyz_rows(points, [("x", "<f8"), ("y", "<f8"), ("z", "<f8")])))
    assert (read.points.tolist(), read.n_invalid) == ([[1, 2, 3]], 1)


@pytest.mark.parametrize(("name", "kind"), [("t", "<u4"), ("time", "<f4"), ("timestamp", "<f8")])
def test_the_times_of_points_are_kept_beside_them(name: str, kind: str) -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [6, 7, 8]], np.float32)
    rows = ros.xyz_rows(points, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), (name, kind)])
    rows[name] = [10, 20, 30]
    times = read_point_cloud(ros.cloud(rows)).times
    assert times is not None
    assert times.tolist() == [10, 30]


def test_a_cloud_of_no_points_is_read_as_such() -> None:
    assert read_point_cloud(ros.cloud(ros.xyz_rows(np.zeros((0, 3))))).points.shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"width": 4}, "bad_layout"),
        ({"height": 2**32 - 1, "row_step": 2**32 - 1}, "bad_layout"),
        ({"point_step": 0}, "bad_layout"),
        ({"point_step": 8}, "bad_layout"),
        ({"height": 3, "width": 1, "row_step": 1}, "bad_layout"),
        ({"fields": []}, "bad_fields"),
    ],
)
def test_a_message_that_contradicts_itself_is_refused(change: dict, reason: str) -> None:
    message = dataclasses.replace(ros.cloud(ros.xyz_rows(np.ones((3, 3)))), **change)
    with pytest.raises(RosMessageError) as caught:
        read_point_cloud(message)
    assert caught.value.reason == reason


def test_coordinates_that_are_integers_are_refused_by_name() -> None:
    rows = ros.xyz_rows(np.ones((3, 3)), [("x", "<i4"), ("y", "<f4"), ("z", "<f4")])
    with pytest.raises(RosMessageError, match="no float field x; its fields are x, y, z"):
        read_point_cloud(ros.cloud(rows))


@given(cut=st.integers(0, 200))
def test_a_truncated_message_is_refused(cut: int) -> None:
    whole = ros.cdr(ros.cloud(ros.xyz_rows(np.ones((9, 3)))), types.POINT_CLOUD)
    with pytest.raises(RosMessageError):
        types.decode(whole[:cut], types.POINT_CLOUD)


def test_what_is_made_is_what_rosbags_reads() -> None:
    x, y, z, ring = np.arange(12, dtype=np.float32).reshape(4, 3)
    made = make_point_cloud({"x": x, "y": y, "z": z, "ring": ring.astype(np.uint16)}, "map", 3_000_000_001)
    message = ros.STORE.deserialize_cdr(types.encode(made, types.POINT_CLOUD), types.POINT_CLOUD)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (3, 1)
    assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
        ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 12, 4),
    ]  # fmt: skip
    assert (message.width, message.point_step, message.row_step) == (3, 14, 42)
    assert np.array_equal(read_point_cloud(message).points, np.stack([x, y, z], 1))
