"""Recordings without poses, placed by LiDAR odometry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from potclient.datasets import DatasetError, RecordedScan, open_dataset
from tests.ros import messages
from tests.ros.bags import writing


@pytest.fixture(scope="module")
def town() -> list[RecordedScan]:
    recording = open_dataset("town:terraces:vlp16:3", n_generated=8)
    return [recording[i] for i in range(8)]


@pytest.fixture
def drive(tmp_path: Path, town: list[RecordedScan]) -> Path:
    """A folder of six clouds without poses."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for k, scan in enumerate(town[:6]):
        np.savez(folder / f"{k}.npz", points=scan.points, is_return=scan.is_return)
    return folder


def test_odometry_places_a_drive_and_its_trajectory_plays_again(
    drive: Path, town: list[RecordedScan], tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match="--odometry kiss-icp"):
        open_dataset(drive)
    placed = open_dataset(drive, odometry="kiss-icp", trajectory=tmp_path / "way.tum")
    assert "no loop is closed" in " ".join(placed.notes)
    found = [scan.T_map_sensor for scan in placed]
    truth = [np.linalg.inv(town[0].T_map_sensor) @ scan.T_map_sensor for scan in town]
    driven_m = np.linalg.norm(truth[5][:3, 3])
    assert driven_m > 3.9
    for ours, exact in zip(found, truth, strict=False):
        assert np.linalg.norm((ours - exact)[:3, 3]) < 0.1 * driven_m
    np.testing.assert_array_equal(placed[2].T_map_sensor, found[2], "a scan keeps its pose")
    again = open_dataset(drive, poses=tmp_path / "way.tum")
    np.testing.assert_allclose([scan.T_map_sensor for scan in again], found, atol=1e-6)


def test_a_bag_without_poses_is_placed_as_the_folder_of_its_scans(
    drive: Path, town: list[RecordedScan], tmp_path: Path
) -> None:
    with writing(tmp_path / "bag") as put:
        for scan in town[:6]:
            cloud = messages.cloud(messages.xyz_rows(scan.points[scan.is_return]), "lidar", scan.stamp_ns)
            put("/points", cloud, scan.stamp_ns)
    with pytest.raises(DatasetError, match="--odometry kiss-icp places 3D scans"):
        open_dataset(tmp_path / "bag")
    placed = open_dataset(tmp_path / "bag", odometry="kiss-icp", trajectory=tmp_path / "way.tum")
    assert placed.notes[0] == "topic /points"
    folder = [scan.T_map_sensor for scan in open_dataset(drive, odometry="kiss-icp")]
    np.testing.assert_allclose([scan.T_map_sensor for scan in placed], folder, atol=1e-6)
    assert len((tmp_path / "way.tum").read_text().splitlines()) == 6


def test_later_scans_are_placed_after_all_before_them(drive: Path) -> None:
    every = [scan.T_map_sensor for scan in open_dataset(drive, odometry="kiss-icp", max_range_m=5.0)]
    some = [scan.T_map_sensor for scan in open_dataset(drive, odometry="kiss-icp")[1::2]]
    np.testing.assert_allclose(some, every[1::2], atol=1e-3, err_msg="odometry sees beyond the range limit")


def test_scans_that_do_not_follow_each_other_are_refused(drive: Path, town: list[RecordedScan]) -> None:
    np.savez(drive / "5.npz", points=town[7].points, is_return=town[7].is_return)
    recording = open_dataset(drive, odometry="kiss-icp")
    assert len(recording[4]) > 0
    with pytest.raises(DatasetError, match=r"5\.npz: kiss-icp puts it .* off the course"):
        recording[5]


def test_what_odometry_is_not_for(drive: Path) -> None:
    with pytest.raises(DatasetError, match="brings its poses"):
        open_dataset("generated", odometry="kiss-icp")
    with pytest.raises(DatasetError, match="not both"):
        open_dataset(drive, odometry="kiss-icp", poses="x.txt")
    with pytest.raises(DatasetError, match="need one of kiss-icp"):
        open_dataset(drive, odometry="magic")
    (drive / "recording.json").write_text('{"is_planar": true}')
    with pytest.raises(DatasetError, match="planar"):
        open_dataset(drive, odometry="kiss-icp")[0]


def test_kitti_by_odometry_is_where_registration_puts_it(shared_data: Callable[[str], Path]) -> None:
    folder = shared_data("kitti_odometry_00")
    placed = [scan.T_map_sensor for scan in open_dataset(folder, odometry="kiss-icp")]
    registered = [scan.T_map_sensor for scan in open_dataset(folder, poses="poses_velo_icp.txt")]
    start = np.linalg.inv(registered[0])
    for ours, theirs in zip(placed, registered, strict=True):
        assert np.linalg.norm((ours - start @ theirs)[:3, 3]) < 0.1, "of 2.1 m"
