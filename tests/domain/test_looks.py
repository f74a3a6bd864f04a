"""Some scans of a way."""

from __future__ import annotations

import numpy as np

from potserver.domain.looks import MOST_BEAMS, MOST_LOOKS, Looks
from potserver.domain.types import Scan, yaw_pose


def scan_at(x_m: float, *, robot: str = "r", n: int = 10, planar: bool = False) -> Scan:
    points = np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32)
    if planar:
        points[:, 2] = 0.0
    return Scan(points=points, T_map_sensor=yaw_pose(x_m, 0.0, 0.0), robot_id=robot, is_planar=planar)


def places(looks: Looks) -> list[float]:
    return [float(scan.origin[0]) for scan in looks.scans]


def test_a_long_way_is_kept_at_even_distances() -> None:
    looks = Looks()
    for step in range(10_000):
        looks.take(scan_at(step * 0.1))
        assert len(looks.scans) <= MOST_LOOKS
    found = places(looks)
    gaps = np.diff(found)
    assert len(found) >= MOST_LOOKS // 2
    assert found[0] == 0.0
    assert found[-1] > 1_000.0 - 2.0 * gaps.max()
    assert gaps.max() < 1.5 * gaps.min()


def test_standing_still_and_driving_a_loop_again_add_nothing() -> None:
    looks = Looks()
    for _ in range(3):
        for x in (0.0, 0.1, 5.0, 10.0):
            looks.take(scan_at(x))
    assert places(looks) == [0.0, 5.0, 10.0]


def test_planar_scans_are_left_out_and_large_ones_thinned() -> None:
    looks = Looks()
    looks.take(scan_at(0.0, planar=True))
    assert not looks.scans
    looks.take(scan_at(0.0, n=MOST_BEAMS + 1000))
    assert len(looks.scans[0].points) == MOST_BEAMS == len(looks.scans[0].is_return)


def test_a_robot_is_forgotten() -> None:
    looks = Looks()
    for x, robot in ((0.0, "b"), (2.0, "a"), (4.0, "b")):
        looks.take(scan_at(x, robot=robot))
    assert places(looks) == [2.0, 0.0, 4.0], "each robot's together"
    looks.forget("b")
    assert places(looks) == [2.0]
