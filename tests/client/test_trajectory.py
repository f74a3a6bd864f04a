"""Pose files of other programs, and which pose belongs to which scan."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potclient.datasets import DatasetError, open_dataset
from potclient.datasets.scans import stamps_of_names
from potclient.datasets.trajectory import place_scans, read_trajectory, tum_line
from potclient.poses import interpolate, quaternion_of, quaternion_rotation, yaw_pose

POINTS = np.array([[1, 2, 3], [4, 5, 6.5]], np.float32)


def write_tum(path: Path, stamps_s: list[float], yaws: list[float]) -> None:
    poses = [yaw_pose(10 * s, 0, yaw) for s, yaw in zip(stamps_s, yaws, strict=True)]
    lines = [tum_line(pose, round(s * 1e9)) for pose, s in zip(poses, stamps_s, strict=True)]
    path.write_text("# a comment\n" + "\n".join(lines) + "\n")


@given(q=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1), share=st.floats(0, 1))
def test_quaternions_and_rotations_say_the_same(q: tuple[float, ...], share: float) -> None:
    rotation = quaternion_rotation(*(np.array(q) / np.linalg.norm(q)))
    again = quaternion_rotation(*quaternion_of(rotation))
    np.testing.assert_allclose(again, rotation, atol=1e-9)
    start, end = np.eye(4), np.eye(4)
    end[:3, :3] = rotation
    partly = interpolate(start, end, share)[:3, :3]

    def angle(R: np.ndarray) -> float:
        return math.acos(min(1.0, max(-1.0, (np.trace(R) - 1) / 2)))

    assert angle(partly) == pytest.approx(share * angle(rotation), abs=1e-5)
    assert angle(partly.T @ rotation) == pytest.approx((1 - share) * angle(rotation), abs=1e-5)


def test_a_tum_file_places_scans_at_their_stamps(tmp_path: Path) -> None:
    write_tum(tmp_path / "poses.tum", [100.0, 100.5, 101.0, 105.0], [0.0, 0.0, 1.0, 1.0])
    for i in range(5):
        np.save(tmp_path / f"{i}.npy", POINTS)
    (tmp_path / "times.txt").write_text("99.9\n100.25\n100.75\n101.0\n103.0\n")
    recording = open_dataset(tmp_path)
    assert [scan.name for scan in recording] == ["1.npy", "2.npy", "3.npy"]
    assert "2 of 5 scans have none within 1 s and are left out" in " ".join(recording.notes)
    np.testing.assert_allclose(recording[0].T_map_sensor, yaw_pose(1002.5, 0, 0), atol=1e-6)
    np.testing.assert_allclose(recording[1].T_map_sensor, yaw_pose(1007.5, 0, 0.5), atol=1e-6)
    assert [scan.stamp_ns for scan in recording] == [100_250_000_000, 100_750_000_000, 101_000_000_000]


def test_a_tum_file_of_as_many_lines_goes_line_by_line(tmp_path: Path) -> None:
    write_tum(tmp_path / "trajectory.tum", [7.0, 8.0], [0.0, 1.0])
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, POINTS)
    recording = open_dataset(tmp_path)
    assert "line by line" in recording.notes[0]
    assert [scan.stamp_ns for scan in recording] == [7_000_000_000, 8_000_000_000]
    np.testing.assert_allclose(recording[1].T_map_sensor, yaw_pose(80, 0, 1.0), atol=1e-8)
    np.save(tmp_path / "c.npy", POINTS)
    with pytest.raises(DatasetError, match="2 lines for 3 scans and their stamps do not meet"):
        place_scans(tmp_path / "trajectory.tum", 3, [1, 2, 3])


def test_vertices_of_graphs(tmp_path: Path) -> None:
    half = math.sqrt(0.5)
    (tmp_path / "graph.txt").write_text(f"v1 4 5 6 0 0 {half} {half}\nv0 1 2 3 0 0 0 1\nedge 0 1\n")
    (tmp_path / "a.g2o").write_text(
        f"VERTEX_SE3:QUAT 0 1 2 3 0 0 0 1\nVERTEX_SE3:QUAT 1 4 5 6 0 0 {half} {half}\nEDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1\n"
    )
    for name in ("graph.txt", "a.g2o"):
        found = read_trajectory(tmp_path / name)
        np.testing.assert_allclose(found.poses[1], yaw_pose(4, 5, math.pi / 2, 6), atol=1e-9)
        assert found.poses[0, :3, 3].tolist() == [1, 2, 3]


def test_nclts_ground_truth_is_turned_to_z_up(tmp_path: Path) -> None:
    """As the dataset has it: microseconds, north, east, down, and the turns of the body; the first lines are nan."""
    at = 1_326_652_795_280_148
    rows = ["nan, nan, nan, nan, nan, nan, nan", f"{at - 9000}, nan, nan, nan, nan, nan, nan"]
    for i in range(3):
        rows.append(f"{at + i * 1_000_000 - 500_000}, {10 + i}, 5, -0.5, 0.0, 0.1, {math.pi / 2}")
    (tmp_path / "groundtruth.csv").write_text("\n".join([rows[1], rows[0], *rows[2:]]) + "\n")
    points = np.array([[2.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 3.0, 0.0]])
    records = np.zeros(3, [("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
    records["xyz"] = np.round((points + 100) / 0.005)
    scans = tmp_path / "velodyne_sync"
    scans.mkdir()
    for name in (at, at + 100_000):
        (scans / f"{name}.bin").write_bytes(records.tobytes())
    recording = open_dataset(scans, poses=tmp_path / "groundtruth.csv", layout="nclt", origin=(0, 0, -1.0))
    assert "(NCLT, 2 of 5 lines have no numbers), at the stamps of the scans" in recording.notes[0]
    first, second = recording
    assert (first.stamp_ns, second.stamp_ns) == (at * 1000, at * 1000 + 10**8)
    # it heads east with its nose .1 rad up: 2 m ahead is 2 cos .1 to the east and 2 sin .1 up; the scan is half way
    north, west, up = 10.5, -5.0, 0.5
    ahead = [north, west - 2 * math.cos(0.1), up + 2 * math.sin(0.1)]
    below = [north, west - math.sin(0.1), up - math.cos(0.1)]
    right = [north - 3, west, up]
    np.testing.assert_allclose(first.in_map, [ahead, below, right], atol=0.003)
    above = [north, west + math.sin(0.1), up + math.cos(0.1)]
    np.testing.assert_allclose(first.T_map_sensor[:3, 3], above, atol=1e-9)
    assert second.T_map_sensor[0, 3] == pytest.approx(10.6)
    (tmp_path / "back.csv").write_text(f"{at}, 0, 0, 0, 0, 0, 0\n{at - 1}, 0, 0, 0, 0, 0, 0\n")
    with pytest.raises(DatasetError, match="whose stamps grow"):
        read_trajectory(tmp_path / "back.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0 0 0 0 0\n", "are no pose"),
        ("nan 0 0 0 0 0 0 1\n", "not a time"),
        ("1 0 0 nan 0 0 0 1\n", "are no pose"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "do not grow"),
        ("v0 1 2 3\n", "seven numbers"),
        ("1 2 3 4\n", "4 numbers a line"),
        ("-1 0 0 0 0 1 0 0 0 0 1 0\n", "line 1 is not a rotation"),
    ],
)
def test_files_that_hold_no_poses_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(DatasetError, match=message):
        read_trajectory(tmp_path / "p.txt")


def test_names_that_are_times() -> None:
    def stamps(*names: str) -> list[int] | None:
        return stamps_of_names([Path(name) for name in names])

    assert stamps("1403636579.763555.pcd", "1403636579.8.pcd") is None, "one of them is none"
    assert stamps("1403636579.763555.pcd", "1403636580.013.pcd") == [1403636579763555000, 1403636580013000000]
    assert stamps("1326652795280148.bin") == [1326652795280148000]
    assert stamps("PC_315971347819783000.ply") == [315971347819783000]
    assert stamps("000001.bin", "000002.bin") is None
    assert stamps("1326652795280148.bin", "1326652795280147.bin") is None, "they do not grow"


# --- what a folder says of itself -------------------------------------------------------------------------------------


def test_clouds_without_poses_say_what_would_place_them(tmp_path: Path) -> None:
    for i in range(3):
        np.save(tmp_path / f"{i}.npy", POINTS)
    write_tum(tmp_path / "odometry.txt", [1.0, 2.0, 3.0], [0, 0, 0])
    with pytest.raises(DatasetError) as caught:
        open_dataset(tmp_path)
    for words in (
        "3 clouds",
        "odometry.txt holds 3 poses (TUM) and fits",
        "--poses FILE",
        f"potclient publish {tmp_path} --odometry kiss-icp",
        f"potclient publish {tmp_path / '0.npy'}",
    ):
        assert words in str(caught.value)
    assert len(open_dataset(tmp_path, poses="odometry.txt")) == 3
    assert len(open_dataset(tmp_path / "1.npy")) == 1


def test_other_poses_and_files_that_nobody_reads_are_said(tmp_path: Path) -> None:
    (tmp_path / "0").mkdir()
    np.save(tmp_path / "0" / "points.npy", POINTS)
    write_tum(tmp_path / "poses.txt", [1.0], [0])
    write_tum(tmp_path / "better.txt", [1.0], [0])
    for i in range(6):
        (tmp_path / f"photo{i}.jpg").write_bytes(b"")
    notes = " | ".join(open_dataset(tmp_path).notes)
    assert "poses from poses.txt (TUM)" in notes
    assert "better.txt also holds 1 pose (TUM): --poses better.txt" in notes
    assert "not read: better.txt, photo0.jpg, photo1.jpg, photo2.jpg and 3 more" in notes


def test_kinds_are_not_mixed_and_maps_are_no_recordings(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", POINTS)
    (tmp_path / "b.pcd.bin").write_bytes(np.zeros((4, 5), "<f4").tobytes())
    with pytest.raises(DatasetError, match=r"1 npy \(a.npy\), 1 nuScenes \(b.pcd.bin\); keep one kind"):
        open_dataset(tmp_path)
    maps = tmp_path / "maps"
    maps.mkdir()
    (maps / "hall.bt").write_bytes(b"# Octomap OcTree binary file")
    np.savez(maps / "weights.npz", a=np.zeros(3), b=np.zeros((2, 2)))
    with pytest.raises(DatasetError) as caught:
        open_dataset(maps)
    for words in ("1 .bt, 1 .npz", "potserver map import", r"holds a (3,), b (2, 2)"):
        assert words in str(caught.value)


def test_a_log_says_where_better_poses_are(tmp_path: Path) -> None:
    words = ["FLASER", 2, 1.0, 1.0, 0, 0, 0, 0, 0, 0, 1.0, "h", 1.0]
    (tmp_path / "a.log").write_text(" ".join(map(str, words)))
    (tmp_path / "optimised.txt").write_text("0 1.0 2 3 0.5\n")
    assert "optimised.txt also holds a pose" in " ".join(open_dataset(tmp_path).notes)
    assert "also holds" not in " ".join(open_dataset(tmp_path, poses="optimised.txt").notes)


def test_points_in_a_vehicles_frame(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", POINTS)
    scan = open_dataset(tmp_path / "a.npy", origin=(1.0, 0.0, 1.5))[0]
    np.testing.assert_allclose(scan.points, POINTS - np.array([1.0, 0.0, 1.5], np.float32))
    np.testing.assert_allclose(scan.in_map, POINTS, atol=1e-6)
    with pytest.raises(DatasetError, match="need x y z"):
        open_dataset(tmp_path / "a.npy", origin=(1.0, float("nan"), 0.0))
