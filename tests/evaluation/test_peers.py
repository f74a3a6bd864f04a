"""Other maps on cases that are small enough to work out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from potclient.datasets import RecordedScan
from potserver.errors import SettingsError
from potserver.evaluation.peers import peer_named
from potserver.evaluation.peers.bgk import BgkMap
from potserver.evaluation.peers.grid import GridMap
from potserver.evaluation.peers.octomap import OctoMap

HIT, MISS = 0.7, 0.4
LEAST, MOST = 0.1192, 0.971


def scan(
    points: list[list[float]],
    is_return: list[bool] | None = None,
    origin: float = 0.05,
    planar: bool = False,
) -> RecordedScan:
    """Ends of beams in the map frame, from a sensor in the middle of a 0.1 m voxel."""
    pose = np.eye(4)
    pose[:3, 3] = [origin, origin, 0.0 if planar else origin]
    ends = np.asarray(points, np.float64) - pose[:3, 3]
    return RecordedScan(
        points=ends.astype(np.float32),
        is_return=np.ones(len(points), bool) if is_return is None else np.asarray(is_return),
        T_map_sensor=pose,
        stamp_ns=0,
        name="by hand",
        is_planar=planar,
    )


def logit(p: float) -> float:
    return math.log(p / (1 - p))


def sigmoid(f: float) -> float:
    return 1 / (1 + math.exp(-f))


@pytest.fixture
def octomap() -> OctoMap:
    pytest.importorskip("pyoctomap")
    return OctoMap(0.1)


def at(a_map: OctoMap | BgkMap, *point: float) -> float:
    mean, known, _ = a_map.occupancy(np.array([point]))
    return float(mean[0]) if known[0] else math.nan


def test_octomap_adds_log_odds_along_a_beam(octomap: OctoMap) -> None:
    for looks in (1, 2):
        octomap.integrate(scan([[1.05, 0.05, 0.05]]))
        assert at(octomap, 1.05, 0.05, 0.05) == pytest.approx(sigmoid(looks * logit(HIT)), abs=1e-6)
        assert at(octomap, 0.55, 0.05, 0.05) == pytest.approx(sigmoid(looks * logit(MISS)), abs=1e-6)
    assert math.isnan(at(octomap, 1.15, 0.05, 0.05))
    assert math.isnan(at(octomap, 0.55, 0.15, 0.05))


def test_octomap_is_clamped(octomap: OctoMap) -> None:
    for _ in range(20):
        octomap.integrate(scan([[1.05, 0.05, 0.05]]))
    assert at(octomap, 1.05, 0.05, 0.05) == pytest.approx(MOST, abs=1e-4)
    assert at(octomap, 0.55, 0.05, 0.05) == pytest.approx(LEAST, abs=1e-4)


def test_octomap_counts_a_voxel_once_a_scan_and_hits_win_over_misses(octomap: OctoMap) -> None:
    octomap.integrate(scan([[0.52, 0.05, 0.05], [0.58, 0.05, 0.05], [1.05, 0.05, 0.05]]))
    assert at(octomap, 0.55, 0.05, 0.05) == pytest.approx(HIT, abs=1e-6)
    assert at(octomap, 0.25, 0.05, 0.05) == pytest.approx(MISS, abs=1e-6)


def test_octomap_takes_beams_without_an_echo_as_free(octomap: OctoMap) -> None:
    octomap.integrate(scan([[2.04, 0.05, 0.05], [0.05, 2.04, 0.05]], [True, False]))
    assert at(octomap, 2.04, 0.05, 0.05) == pytest.approx(HIT, abs=1e-6)
    assert at(octomap, 0.05, 1.85, 0.05) == pytest.approx(MISS, abs=1e-6)
    assert at(octomap, 0.05, 2.25, 0.05) != pytest.approx(HIT, abs=0.1)
    assert math.isnan(at(octomap, 0.05, 2.25, 0.05))


def test_octomap_refuses_what_its_library_cannot_say(octomap: OctoMap) -> None:
    with pytest.raises(SettingsError, match="of one length"):
        octomap.integrate(scan([[2.0, 0.05, 0.05], [0.05, 1.0, 0.05]], [False, False]))


def test_octomap_is_what_its_library_makes_of_the_same_points() -> None:
    library = pytest.importorskip("pyoctomap")
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(400, 3))
    ends = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(1.0, 4.0, (400, 1))
    ours, theirs = OctoMap(0.2), library.OcTree(0.2)
    whole = scan(ends.tolist())
    for _ in range(3):
        ours.integrate(whole)
        theirs.insertPointCloud(whole.in_map, whole.T_map_sensor[:3, 3].copy(), -1.0, False, True)
    points = rng.uniform(-4, 4, (500, 3))
    mean, known, _ = ours.occupancy(points)
    assert known.any()
    assert not known.all()
    for point, p, is_known in zip(points, mean, known, strict=True):
        node = theirs.search(point)
        assert is_known == (node is not None)
        assert node is None or p == node.getOccupancy()


def test_asking_octomap_for_its_size_changes_nothing(octomap: OctoMap) -> None:
    octomap.integrate(scan([[1.05, 0.05, 0.05]]))
    size = octomap.size()
    assert size.cells == 11
    assert 0 < size.n_bytes_binary < size.n_bytes
    assert at(octomap, 1.05, 0.05, 0.05) == pytest.approx(HIT, abs=1e-6)
    assert octomap.size() == size


def test_bgk_counts_by_the_sparse_kernel() -> None:
    a_map = BgkMap(0.1)  # kernel length 0.2 m
    a_map.integrate(
        scan([[0.45, 0.05, 0.05]])
    )  # shorter than 0.5 m: the end, and the free point at the sensor
    assert at(a_map, 0.45, 0.05, 0.05) == pytest.approx(1.001 / 1.002, abs=1e-6)
    # a voxel further: d = 0.5 of the kernel's length from the end alone, too far from the sensor
    weight = (2 + math.cos(math.pi)) * 0.5 / 3 + math.sin(math.pi) / (2 * math.pi)
    assert at(a_map, 0.55, 0.05, 0.05) == pytest.approx((weight + 0.001) / (weight + 0.002), abs=1e-6)
    assert at(a_map, 0.05, 0.05, 0.05) == pytest.approx(0.001 / 1.002, abs=1e-6)
    assert math.isnan(at(a_map, 0.75, 0.05, 0.05))  # farther than the kernel is long
    assert math.isnan(at(a_map, 0.45, 0.35, 0.05))


def test_bgk_puts_free_points_along_beams_with_or_without_an_echo() -> None:
    a_map = BgkMap(0.1)
    a_map.integrate(scan([[1.25, 0.05, 0.05], [0.05, 1.25, 0.05]], [True, False]))
    for along in (0.55, 1.05, 0.75):  # every 0.5 m, and 0.5 m before the end
        assert at(a_map, along, 0.05, 0.05) < 0.5
        assert at(a_map, 0.05, along, 0.05) < 0.5
    assert at(a_map, 1.25, 0.05, 0.05) > 0.9
    assert math.isnan(at(a_map, 0.05, 1.25, 0.05))


def test_bgk_with_a_gap_has_no_free_points_there() -> None:
    close, gap = BgkMap(0.1), BgkMap(0.1, gap_m=0.5)
    for a_map in (close, gap):
        a_map.integrate(scan([[1.15, 0.05, 0.05]]))
    assert at(close, 1.05, 0.05, 0.05) < 0.5  # the point 1 m along the beam of 1.1 m
    assert at(gap, 1.05, 0.05, 0.05) > 0.5
    assert at(gap, 0.55, 0.05, 0.05) < 0.5


def test_bgk_keeps_its_counts_as_it_grows() -> None:
    ends = np.random.default_rng(0).uniform(-20, 20, (3000, 3)).round(1) + 0.05
    a_map = BgkMap(0.1)
    for part in np.array_split(ends, 3):
        a_map.integrate(scan(part.tolist()))
    mean, known, _ = a_map.occupancy(ends)
    assert a_map.size().cells > 1 << 15
    assert known.all()
    assert np.median(mean) > 0.9


def test_planar_bgk_stays_in_its_plane() -> None:
    flat, solid = BgkMap(0.1), BgkMap(0.1)
    flat.integrate(scan([[0.45, 0.05, 0.0]], planar=True))
    solid.integrate(scan([[0.45, 0.05, 0.0]], planar=False))
    assert at(flat, 0.45, 0.05, 0.0) == pytest.approx(1.001 / 1.002, abs=1e-6)
    assert flat.size().cells < solid.size().cells


def test_the_grid_has_as_many_kernels_as_asked_for_and_knows_what_it_saw() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.full(600, 3.0), rng.uniform(-2, 2, (600, 2))])
    grid = GridMap(threads=1)
    grid.integrate(scan(wall.tolist()))
    grid.finish(300)
    assert 200 < grid.size().cells <= 300
    mean, known, _ = grid.occupancy(np.array([[3.0, 0.5, 0.5], [1.5, 0.0, 0.0], [50.0, 0.0, 0.0]]))
    assert mean[0] > 0.8
    assert mean[1] < 0.2
    assert known.tolist() == [True, True, False]


def test_the_grid_samples_all_scans_alike() -> None:
    grid = GridMap(threads=1, samples=300)
    for side in (-3.0, 3.0):
        ends = np.column_stack([np.full(500, side), np.zeros((500, 2))])
        grid.integrate(scan(ends.tolist()))
    grid.finish(20)
    mean, _, _ = grid.occupancy(np.array([[-3.0, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    assert (mean > 0.6).all()


def test_peers_are_named_with_their_resolution() -> None:
    assert peer_named("bgk", threads=1).name == "BGK 0.1 m"
    assert peer_named("bgk:0.25", threads=1).name == "BGK 0.25 m"
    assert peer_named("bgk-gap:0.2", threads=1).name == "BGK 0.2 m, 0.5 m gap"
    assert peer_named("grid", threads=1).is_batch


def test_a_library_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyoctomap", None)
    with pytest.raises(SettingsError, match=r"pip install 'potserver\[peers\]'"):
        peer_named("octomap:0.2", threads=1)
