"""Readers of recordings, on small files made here; and on the shared sample data where it is present."""

from __future__ import annotations

import bz2
import gzip
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potclient.datasets import DatasetError, GeneratedScene, RecordedScan, Recording, open_dataset
from potclient.datasets.files import read_beams, read_viewpoint
from potclient.datasets.scans import growing, limit_range, natural_key

Points = np.ndarray[Any, np.dtype[np.float32]]
POINTS: Points = np.array([[1, 2, 3], [4, 5, 6.5], [-7, 8, 0.25], [0.5, 0.5, 0.5]], np.float32)


def points_of(path: Path) -> np.ndarray[Any, np.dtype[np.floating[Any]]]:
    return read_beams(path).points


def yaw_pose(x: float, y: float, yaw: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]], np.float64)


def write_poses(path: Path, poses: list[np.ndarray[Any, np.dtype[np.float64]]]) -> None:
    path.write_text("\n".join(" ".join(f"{v:.9g}" for v in p[:3].ravel()) for p in poses) + "\n")


def pcd(
    points: Points, *, data: str = "binary", viewpoint: str = "0 0 0 1 0 0 0", extra: bytes = b""
) -> bytes:
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\n"
        f"TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {viewpoint}\nPOINTS {len(points)}\n"
        f"DATA {data}\n"
    ).encode()
    rows = np.concatenate([points, np.full((len(points), 1), 9, np.float32)], axis=1).astype("<f4")
    if data == "ascii":
        return head + "\n".join(" ".join(str(v) for v in row) for row in rows).encode() + b"\n"
    return head + rows.tobytes() + extra


def ply(points: Points, *, ascii_: bool = False) -> bytes:
    kind = "ascii" if ascii_ else "binary_little_endian"
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    ).encode()
    if ascii_:
        return head + "\n".join(" ".join(str(v) for v in row) for row in points).encode() + b"\n"
    return head + points.astype("<f4").tobytes()


# --- PCD and PLY ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("data", ["ascii", "binary"])
def test_pcd_points_come_back(tmp_path: Path, data: str) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(POINTS, data=data))
    np.testing.assert_array_equal(points_of(tmp_path / "a.pcd"), POINTS)


def test_pcd_with_bytes_after_the_data_and_one_ascii_point(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_bytes(pcd(POINTS, extra=b"\0" * 77))
    np.testing.assert_array_equal(points_of(tmp_path / "a.pcd"), POINTS)
    (tmp_path / "b.pcd").write_bytes(pcd(POINTS[:1], data="ascii"))
    np.testing.assert_array_equal(points_of(tmp_path / "b.pcd"), POINTS[:1])


def test_pcd_compressed(tmp_path: Path) -> None:
    from pypcd4 import Encoding, PointCloud

    PointCloud.from_xyz_points(POINTS).save(tmp_path / "a.pcd", encoding=Encoding.BINARY_COMPRESSED)
    np.testing.assert_array_equal(points_of(tmp_path / "a.pcd"), POINTS)


@pytest.mark.parametrize("ascii_", [False, True])
def test_ply_points_come_back(tmp_path: Path, ascii_: bool) -> None:
    (tmp_path / "a.ply").write_bytes(ply(POINTS, ascii_=ascii_))
    np.testing.assert_array_equal(points_of(tmp_path / "a.ply"), POINTS)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.pcd", b"", "not a readable PCD"),
        ("a.pcd", b"nonsense\n" * 20, "not a readable PCD"),
        ("a.pcd", pcd(POINTS)[:-16], "truncated, 3 of 4"),
        ("a.pcd", pcd(POINTS)[:-3], "not a readable PCD"),
        ("a.pcd", pcd(POINTS).replace(b"FIELDS x y z", b"FIELDS u v w"), "need x y z"),
        ("a.ply", b"", "not a readable PLY"),
        ("a.ply", ply(POINTS)[:-3], "not a readable PLY"),
        ("a.ply", ply(POINTS).replace(b"vertex", b"corner"), "not a readable PLY"),
    ],
)
def test_damaged_clouds_are_named(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=message) as caught:
        points_of(tmp_path / name)
    assert name in str(caught.value)
    with pytest.raises(DatasetError, match="cannot be read"):
        points_of(tmp_path / ("absent" + name[1:]))


def test_a_folder_is_read_in_natural_order_with_its_poses(tmp_path: Path) -> None:
    poses = [yaw_pose(i, -i, 0.1 * i) for i in range(11)]
    for i in range(11):
        (tmp_path / f"full{i + 1}.pcd").write_bytes(pcd(POINTS + i))
    write_poses(tmp_path / "poses.txt", poses)
    (tmp_path / "times.txt").write_text("\n".join(f"{100 + i / 10:.1f}" for i in range(11)))
    recording = open_dataset(tmp_path)
    assert recording.format == "clouds"
    assert [s.name for s in recording] == [f"full{i + 1}.pcd" for i in range(11)]
    for i, scan in enumerate(recording):
        np.testing.assert_array_equal(scan.points, POINTS + i)
        np.testing.assert_allclose(scan.T_map_sensor, poses[i], atol=1e-7)
        assert scan.stamp_ns == pytest.approx((100 + i / 10) * 1e9, abs=100)
        assert scan.is_return.all()
        assert not scan.is_planar


def test_points_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    dirty = np.concatenate([POINTS, [[math.nan, 0, 0], [0, math.inf, 0], [0, 0, 0]]]).astype(np.float32)
    (tmp_path / "a.pcd").write_bytes(pcd(dirty))
    write_poses(tmp_path / "poses.txt", [np.eye(4)])
    np.testing.assert_array_equal(open_dataset(tmp_path)[0].points, POINTS)


def test_clouds_in_the_world_frame_come_back_to_their_sensor(tmp_path: Path) -> None:
    for i in (1, 2):
        (tmp_path / f"w_{i}.pcd").write_bytes(pcd(POINTS, viewpoint=f"{i} 2 0.5 1 0 0 0"))
    scans = list(open_dataset(tmp_path))
    for i, scan in enumerate(scans, start=1):
        np.testing.assert_allclose(scan.T_map_sensor[:3, 3], [i, 2, 0.5])
        np.testing.assert_allclose(scan.points, POINTS - np.array([i, 2, 0.5], np.float32), atol=1e-6)
        np.testing.assert_allclose(scan.in_map, POINTS, atol=1e-6)
    sensor = open_dataset(tmp_path, frame="sensor")[0]
    np.testing.assert_array_equal(sensor.points, POINTS)
    np.testing.assert_allclose(sensor.T_map_sensor[:3, 3], [1, 2, 0.5])


@pytest.mark.parametrize("data", ["binary", "ascii"])
def test_world_coordinates_in_doubles_keep_their_millimetres(tmp_path: Path, data: str) -> None:
    at = np.array([691_000.0, 5_334_000.0, 520.0])  # UTM
    world = at + np.random.default_rng(0).uniform(-20, 20, (200, 3))
    head = pcd(np.zeros((200, 3), np.float32), data=data, viewpoint=" ".join(map(str, at)) + " 1 0 0 0")
    head = head[: head.index(b"DATA")].replace(b"x y z intensity", b"x y z").replace(b"4 4 4 4", b"8 8 8")
    head = head.replace(b"F F F F", b"F F F").replace(b"1 1 1 1", b"1 1 1") + f"DATA {data}\n".encode()
    rows = world.astype("<f8").tobytes() if data == "binary" else "\n".join(
        " ".join(f"{v:.6f}" for v in row) for row in world
    ).encode()  # fmt: skip
    (tmp_path / "utm.pcd").write_bytes(head + rows)
    scan = open_dataset(tmp_path / "utm.pcd")[0]
    assert scan.points.dtype == np.float32
    np.testing.assert_allclose(scan.in_map, world, rtol=0, atol=1e-5)


def test_a_viewpoint_with_a_rotation(tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    (tmp_path / "a.pcd").write_bytes(pcd(POINTS, viewpoint=f"1 0 0 {half} 0 0 {half}"))
    np.testing.assert_allclose(read_viewpoint(tmp_path / "a.pcd"), yaw_pose(1, 0, math.pi / 2), atol=1e-7)
    scan = open_dataset(tmp_path / "a.pcd")[0]
    np.testing.assert_allclose(scan.in_map, POINTS, atol=1e-6)


def test_beams_beyond_the_largest_range_are_free_up_to_there(tmp_path: Path) -> None:
    points = np.array([[3, 0, 0], [0, 10, 0], [0.2, 0, 0]], np.float32)
    (tmp_path / "a.pcd").write_bytes(pcd(points))
    write_poses(tmp_path / "poses.txt", [np.eye(4)])
    scan = open_dataset(tmp_path, min_range_m=0.5, max_range_m=8.0)[0]
    np.testing.assert_allclose(scan.points, [[3, 0, 0], [0, 8, 0]])
    assert scan.is_return.tolist() == [True, False]


@given(seed=st.integers(0, 2**31), max_range_m=st.floats(0.5, 50))
def test_cutting_beams_keeps_directions(seed: int, max_range_m: float) -> None:
    points = (np.random.default_rng(seed).normal(size=(30, 3)) * 20).astype(np.float32)
    cut, is_return = limit_range(points, np.ones(30, np.bool_), min_range_m=0.0, max_range_m=max_range_m)
    range_m, before = np.linalg.norm(cut, axis=1), np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(range_m, np.minimum(before, max_range_m), rtol=1e-5)
    np.testing.assert_array_equal(is_return, before <= max_range_m)
    np.testing.assert_allclose(cut / range_m[:, None], points / before[:, None], atol=1e-5)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "1 lines for 2 scans"),
        ("1 0 0\n1 0 0\n", "3 numbers a line"),
        ("a b\n", "rows of equally many numbers"),
        ("2 0 0 0 0 1 0 0 0 0 1 0\n" * 2, "line 1 is not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\nnan 0 0 0 0 1 0 0 0 0 1 0\n", "line 2 is not a rotation"),
        ("", "is empty"),
    ],
)
def test_pose_files_that_do_not_fit(tmp_path: Path, lines: str, message: str) -> None:
    for i in range(2):
        (tmp_path / f"{i}.ply").write_bytes(ply(POINTS))
    (tmp_path / "poses.txt").write_text(lines)
    with pytest.raises(DatasetError, match=message):
        open_dataset(tmp_path)


def test_what_a_cloud_folder_lacks_is_said(tmp_path: Path) -> None:
    for i in range(2):
        (tmp_path / f"{i}.ply").write_bytes(ply(POINTS))
    with pytest.raises(DatasetError, match=r"no poses: none of poses\.txt"):
        open_dataset(tmp_path)
    with pytest.raises(DatasetError, match="no file other"):
        open_dataset(tmp_path, poses="other.txt")
    (tmp_path / "2.pcd").write_bytes(pcd(POINTS))
    with pytest.raises(DatasetError, match="keep one kind"):
        open_dataset(tmp_path)


# --- KITTI ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    folder = tmp_path / "sequences" / "00"
    (folder / "velodyne").mkdir(parents=True)
    for i in range(3):
        np.concatenate([POINTS + i, np.ones((4, 1), np.float32)], axis=1).astype("<f4").tofile(
            folder / "velodyne" / f"{i:06d}.bin"
        )
    # camera axes: x right, y down, z forward; the velodyne's x is the camera's z
    (folder / "calib.txt").write_text("P0: 1 2 3\nTr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n")
    camera = [np.eye(4) for _ in range(3)]
    for i in range(3):
        camera[i][2, 3] = 2.0 * i  # forward
    write_poses(folder / "poses.txt", camera)
    return folder


def test_kitti_poses_are_moved_from_the_camera_to_the_velodyne(kitti: Path) -> None:
    recording = open_dataset(kitti)
    assert recording.format == "kitti"
    assert len(recording) == 3
    np.testing.assert_array_equal(recording[1].points, POINTS + 1)
    for i, scan in enumerate(recording):
        np.testing.assert_allclose(scan.T_map_sensor[:3, :3], np.eye(3), atol=1e-9)
        np.testing.assert_allclose(scan.T_map_sensor[:3, 3], [2.0 * i, 0, 0], atol=1e-9)
    assert open_dataset(kitti / "velodyne").path == kitti


def test_kitti_poses_of_the_velodyne_are_taken_as_they_are(kitti: Path) -> None:
    write_poses(kitti / "poses_velo_icp.txt", [yaw_pose(i, 1, 0) for i in range(3)])
    assert open_dataset(kitti, poses="poses_velo_icp.txt")[2].T_map_sensor[:2, 3].tolist() == [2, 1]
    (kitti / "poses.txt").unlink()
    (kitti / "calib.txt").unlink()
    assert open_dataset(kitti)[2].T_map_sensor[:2, 3].tolist() == [2, 1]


def test_kitti_poses_in_the_official_place(kitti: Path) -> None:
    (kitti.parents[1] / "poses").mkdir()
    (kitti / "poses.txt").rename(kitti.parents[1] / "poses" / "00.txt")
    assert open_dataset(kitti)[1].T_map_sensor[0, 3] == pytest.approx(2.0)


def test_what_a_kitti_folder_lacks_is_said(kitti: Path) -> None:
    (kitti / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(DatasetError, match="no line `Tr"):
        open_dataset(kitti)
    (kitti / "calib.txt").unlink()
    with pytest.raises(DatasetError, match="move camera poses"):
        open_dataset(kitti)
    (kitti / "poses.txt").unlink()
    with pytest.raises(DatasetError, match=r"no poses\.txt"):
        open_dataset(kitti)


@pytest.mark.parametrize("said", [{"frame": "world"}, {"origin": (0, 0, 1)}, {"layout": "xyz"}])
def test_what_a_recording_brings_itself_is_not_said_twice(kitti: Path, said: dict[str, Any]) -> None:
    with pytest.raises(DatasetError, match=f"what {next(iter(said))} would say"):
        open_dataset(kitti, **said)


def test_a_truncated_bin_is_named(kitti: Path) -> None:
    (kitti / "velodyne" / "000001.bin").write_bytes(b"1234567")
    recording = open_dataset(kitti)
    with pytest.raises(DatasetError, match=r"000001\.bin: 7 bytes"):
        recording[1]


def test_sweeps_of_nuscenes_have_five_numbers_a_point(kitti: Path) -> None:
    points = np.column_stack([np.full((8, 3), 5.0), np.full(8, 77.0), np.arange(8.0)]).astype("<f4")
    (kitti / "velodyne" / "000001.bin").rename(kitti / "velodyne" / "000001.pcd.bin")
    points.tofile(kitti / "velodyne" / "000001.pcd.bin")  # 160 bytes: whole points of four numbers too
    np.testing.assert_array_equal(open_dataset(kitti)[1].points, points[:, :3])
    (kitti / "velodyne" / "000001.pcd.bin").write_bytes(points.tobytes()[:-4])
    with pytest.raises(DatasetError, match=r"5 float32 \(x y z intensity ring\)"):
        open_dataset(kitti)[1]


@pytest.mark.parametrize("value", ["nan", "inf", "1e30"])
def test_times_and_places_that_are_none_are_named(kitti: Path, value: str) -> None:
    n = len(open_dataset(kitti))
    (kitti / "times.txt").write_text(f"{value}\n" * n)
    with pytest.raises(DatasetError, match=r"times.*is not a time in seconds"):
        open_dataset(kitti)
    (kitti / "times.txt").unlink()
    if value != "1e30":
        (kitti / "poses.txt").write_text(f"1 0 0 {value} 0 1 0 0 0 0 1 0\n" * n)
        with pytest.raises(DatasetError, match=r"poses.*line 1 .*not finite"):
            open_dataset(kitti)


# --- CARMEN --------------------------------------------------------------------------------------------------------


def flaser(ranges: list[float], x: float, y: float, yaw: float, stamp: float) -> str:
    words = ["FLASER", len(ranges), *ranges, x, y, yaw, 9, 9, 9, stamp, "host", stamp]
    return " ".join(str(w) for w in words)


def test_a_carmen_log(tmp_path: Path) -> None:
    ranges = [2.0] * 180
    ranges[0], ranges[90], ranges[1], ranges[2] = 81.83, 5.0, 40.0, 0.0
    text = "# comment\nPARAM a b\nODOM 0 0 0 0 0 0 1 h 1\n" + flaser(ranges, 1, 2, math.pi / 2, 7.5) + "\n"
    (tmp_path / "a.log").write_text(text)
    recording = open_dataset(tmp_path)
    assert recording.format == "carmen"
    scan = recording[0]
    assert scan.is_planar
    assert scan.stamp_ns == 7_500_000_000
    assert len(scan) == 179, "the reading of zero says nothing"
    np.testing.assert_allclose(
        scan.points[0], [0, -30, 0], atol=1e-5, err_msg="no echo: free up to the largest range"
    )
    assert scan.is_return[:3].tolist() == [False, False, True], (
        "81.83 is a marker; 40 m is beyond what is believed"
    )
    ahead = np.flatnonzero(np.isclose(scan.points[:, 0], 5.0))
    np.testing.assert_allclose(scan.points[ahead[0]], [5, 0, 0], atol=1e-5, err_msg="beam 90 looks ahead")
    np.testing.assert_allclose(scan.in_map[ahead[0]], [1, 7, 0], atol=1e-5)
    nearer = open_dataset(tmp_path / "a.log", no_return_m=4.0, max_range_m=10.0)[0]
    assert nearer.is_return.sum() == 176
    np.testing.assert_allclose(nearer.points[ahead[0]], [5, 0, 0], atol=1e-5)
    assert not nearer.is_return[ahead[0]]


@pytest.mark.parametrize(("n", "first", "last"), [(180, -90, 89), (181, -90, 90), (361, -90, 90)])
def test_beam_angles_of_the_usual_scanners(tmp_path: Path, n: int, first: float, last: float) -> None:
    (tmp_path / "a.log").write_text(flaser([1.0] * n, 0, 0, 0, 1))
    points = open_dataset(tmp_path / "a.log")[0].points
    angles = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    assert (angles[0], angles[-1]) == (pytest.approx(first), pytest.approx(last))


def test_robotlaser_lines(tmp_path: Path) -> None:
    words = [
        "ROBOTLASER1",
        0,
        -0.5,
        1.0,
        0.5,
        80,
        0.01,
        0,
        3,
        1.0,
        2.0,
        3.0,
        0,
        4,
        5,
        0,
        4,
        5,
        0,
        *[0] * 5,
        12.0,
        "h",
        1,
    ]
    (tmp_path / "a.log").write_text(" ".join(str(w) for w in words))
    scan = open_dataset(tmp_path)[0]
    np.testing.assert_allclose(scan.points[1], [2, 0, 0], atol=1e-6)
    np.testing.assert_allclose(scan.T_map_sensor, yaw_pose(4, 5, 0))
    assert scan.stamp_ns == 12_000_000_000


@pytest.mark.parametrize(("suffix", "compress"), [(".clf.bz2", bz2.compress), (".log.gz", gzip.compress)])
def test_compressed_logs_and_other_poses(
    tmp_path: Path, suffix: str, compress: Callable[[bytes], bytes]
) -> None:
    text = "\n".join(flaser([1.0] * 180, 0, 0, 0, 3.0) for _ in range(3))
    (tmp_path / f"a{suffix}").write_bytes(compress(text.encode()))
    (tmp_path / "fixed.txt").write_text("# index time x y yaw\n0 1 5 6 0\n1 2 7 8 0\n2 3 9 9 1\n")
    recording = open_dataset(tmp_path, poses="fixed.txt")
    np.testing.assert_allclose(recording[1].T_map_sensor, yaw_pose(7, 8, 0))
    assert [s.stamp_ns for s in recording] == [3_000_000_000, 3_000_000_001, 3_000_000_002], (
        "stamps always grow"
    )
    (tmp_path / "short.txt").write_text("1 2 3\n")
    with pytest.raises(DatasetError, match="1 lines of 3 numbers, need 3"):
        open_dataset(tmp_path, poses="short.txt")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no FLASER"),
        (b"FLASER 180 1 2 3\n", "line 1 is not a whole laser line"),
        (b"# ok\nFLASER two 1 2\n", "line 2 is not a whole laser line"),
        (flaser([], 0, 0, 0, 1.0).encode(), "line 1 .*0 readings"),
        (flaser([1.0], 0, 0, 0, 1.0).encode(), "line 1 .*1 readings"),
        (b"FLASER -4 1 2 3 4 5 6 7 8 9 10 11\n", "line 1 .*-4 readings"),
        (flaser([1.0, 1.0], 0, 0, 0, math.nan).encode(), "line 1 .*nan is not a time"),
        (flaser([1.0, 1.0], 0, 0, 0, -math.inf).encode(), "line 1 .*inf is not a time"),
        (flaser([1.0, 1.0], 0, 0, 0, 1e30).encode(), "line 1 .*is not a time"),
        (flaser([1.0, 1.0], 0, math.nan, 0, 1.0).encode(), "line 1 .*pose is not finite"),
        (b"ROBOTLASER1 0 nan 3.1 0.01 30 0.1 0 2 1.0 1.0 0 0 0 0 0 0 0 0 0 0 0 0 1.0", "line 1 .*angles"),
        (
            b"ROBOTLASER1 0 -1.5 3.1 0.01 30 0.1 0 2 1.0 1.0 -9 0 0 0 0 0 0 0 0 0 0 0 1.0",
            "line 1 .*remissions",
        ),
        (b"BZh9 damaged", "a.log"),
        (b"\x1f\x8b damaged", "a.log"),
    ],
)
def test_damaged_logs_are_named(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "a.log").write_bytes(content)
    with pytest.raises(DatasetError, match=message):
        open_dataset(tmp_path / "a.log")


# --- finding out ---------------------------------------------------------------------------------------------------


def test_paths_that_hold_no_recording(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no such file"):
        open_dataset(tmp_path / "absent")
    with pytest.raises(DatasetError, match="no recording recognised"):
        open_dataset(tmp_path)
    (tmp_path / "x.txt").write_text("hello")
    with pytest.raises(DatasetError, match="name the format"):
        open_dataset(tmp_path / "x.txt")
    for name in ("a.log", "b.clf"):
        (tmp_path / name).write_text("")
    with pytest.raises(DatasetError, match=r"found a\.log, b\.clf"):
        open_dataset(tmp_path)
    with pytest.raises(DatasetError, match="need one of"):
        open_dataset(tmp_path, format="rosbag")
    with pytest.raises(DatasetError, match="no velodyne"):
        open_dataset(tmp_path, format="kitti")
    with pytest.raises(DatasetError, match="neither 2d"):
        open_dataset("generated:4d")
    with pytest.raises(DatasetError, match="ranges"):
        open_dataset("generated", min_range_m=5, max_range_m=4)


def test_slices_of_a_recording() -> None:
    recording = open_dataset("generated:2d:3", n_generated=10)
    some = recording[2::3]
    assert isinstance(some, Recording)
    assert [s.name for s in some] == ["generated:3:2", "generated:3:5", "generated:3:8"]
    assert recording[-1].name == "generated:3:9"
    assert len(recording[20:]) == 0
    with pytest.raises(IndexError):
        recording[10]


def test_natural_order_and_growing_stamps() -> None:
    names = ["s10.pcd", "s2.pcd", "s1.pcd", "a.pcd"]
    assert sorted(names, key=lambda n: natural_key(Path(n))) == ["a.pcd", "s1.pcd", "s2.pcd", "s10.pcd"]
    assert growing([5, 5, 3, 9, -1]) == [5, 6, 7, 9, 10]
    assert growing([-3]) == [0]


# --- the generated scene -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("planar", [False, True])
def test_generated_scans_agree_with_the_exact_truth(planar: bool) -> None:
    scene = GeneratedScene(1, planar=planar, n_beams=720, noise_m=0.0)
    for k in (0, 37):
        scan = scene.scan(k)
        assert scan.is_planar == planar
        ends = scan.in_map
        origin = scan.T_map_sensor[:3, 3]
        assert 0.3 < scan.is_return.mean() <= 1
        beyond = origin + (ends - origin) * 1.001
        before = origin + (ends - origin) * 0.99
        halfway = origin + (ends - origin) * 0.5
        assert scene.is_occupied(beyond[scan.is_return]).mean() > 0.98, "but for beams that graze an edge"
        assert not scene.is_occupied(before).any()
        assert not scene.is_occupied(halfway).any()


def test_the_same_seed_gives_the_same_scans() -> None:
    first, again, other = (GeneratedScene(s, n_beams=360).scan(4) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)


# --- the shared sample data ----------------------------------------------------------------------------------------


def overlap_m(a: RecordedScan, others: Recording) -> float:
    """Median distance from points of a scan to the nearest of other scans, all put into the map by their poses."""
    pa = a.in_map[a.is_return][:: max(1, len(a) // 400)]
    pb = np.concatenate([b.in_map[:: max(1, len(b) // 6000)] for b in others])
    d2 = (pa**2).sum(1)[:, None] + (pb**2).sum(1) - 2 * pa @ pb.T
    return float(np.median(np.sqrt(np.maximum(d2.min(axis=1), 0))))


@pytest.mark.parametrize(
    ("name", "arguments", "n_scans", "n_points", "planar"),
    [
        ("kitti_odometry_00", {}, 4, 124_668, False),
        ("kitti_odometry_00", {"poses": "poses_velo_icp.txt"}, 4, 124_668, False),
        ("kitti_raw_drive0005", {}, 20, 122_942, False),
        ("kitti_07_keyframes", {}, 5, 21_562, False),
        ("argoverse2_pair", {}, 4, 51_785, False),
        ("ddad_scene02", {"origin": (0, 0, 1.5)}, 3, 47_230, False),
        ("balm_garage", {}, 20, 76_363, False),
        ("carla_town03_houses", {}, 4, 106_809, False),
        ("carla_town04_mountain_road", {}, 4, 119_892, False),
        ("carla_town03_bridge_coarse", {}, 4, 44_026, False),
        ("la3dm_sim_structured", {"max_range_m": 8.0}, 12, 3500, False),
        ("intel_lab_2d", {}, 910, 180, True),
        ("aces_2d", {"poses": "aces_poses_optimised.txt"}, 7374, 180, True),
    ],
)
def test_shared_data_reads_and_lines_up(
    shared_data: Callable[[str], Path],
    name: str,
    arguments: dict[str, Any],
    n_scans: int,
    n_points: int,
    planar: bool,
) -> None:
    recording = open_dataset(shared_data(name), **arguments)
    assert len(recording) == n_scans
    first, second = recording[0], recording[1]
    assert len(first) == n_points
    assert first.is_planar == planar
    assert second.stamp_ns > first.stamp_ns
    # la3dm's sensor looks three ways from each place, so that neighbours do not overlap
    others = recording[1:] if name == "la3dm_sim_structured" else recording[1:2]
    assert overlap_m(first, others) < 1.0
    assert (0.5 < first.is_return.mean() < 1.0) == (
        name in ("la3dm_sim_structured", "intel_lab_2d", "aces_2d")
    )


def test_every_shared_cloud_file_can_be_read(shared_data: Callable[[str], Path]) -> None:
    for folder in ("small_gicp_pair", "single_scans"):
        for file in sorted(shared_data(folder).glob("*.ply")):
            assert len(points_of(file)) > 10_000
    for folder in ("kitti_raw_drive0005", "la3dm_sim_structured"):
        for file in sorted(shared_data(folder).glob("*.pcd")):
            assert np.isfinite(points_of(file)).all()


def test_every_shared_single_scan_plays_alone(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("single_scans")
    n_points = {file.name[:4]: len(open_dataset(file)[0]) for file in folder.iterdir()}
    assert n_points == {"argo": 91_083, "kitt": 126_596, "nclt": 23_546, "nusc": 34_688, "rell": 37_334}
    with pytest.raises(DatasetError, match=r"1 PLY .*3 binary .*1 nuScenes .*potclient publish"):
        open_dataset(folder)


def test_both_lidars_of_argoverse_see_from_their_own_places(shared_data: Callable[[str], Path]) -> None:
    """Each laser has one elevation, seen from where its lidar is: from the other's place it has several."""
    up = open_dataset(shared_data("argoverse2_pair"))[0]
    height = up.T_map_sensor[2, 3] - open_dataset(shared_data("argoverse2_pair"))[1].T_map_sensor[2, 3]
    assert height == pytest.approx(0.115, abs=0.01)

    def spread(points: Points) -> float:
        elevation = np.sort(np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))))
        return float(np.median(np.diff(elevation[:: len(elevation) // 2000])))

    assert spread(up.points) < spread(up.points + np.array([0, 0, height], np.float32))


def test_folders_that_cannot_play_say_what_would(shared_data: Callable[[str], Path]) -> None:
    with pytest.raises(DatasetError, match=r"2 clouds .*--odometry kiss-icp"):
        open_dataset(shared_data("small_gicp_pair"))
    with pytest.raises(DatasetError, match=r"OctoMap.*potserver map import .*geb079\.bt"):
        open_dataset(shared_data("octomap_fr079_bt"))
    with pytest.raises(DatasetError, match=r"qhinge_mean \(92372, 2\)"):
        open_dataset(shared_data("rss2020_pot"))
