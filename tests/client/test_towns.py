"""Made-up towns: the truth and the rays agree, drives stay on the road, and the same seed gives the same everything."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potclient.cli import main
from potclient.datasets import DatasetError, open_dataset
from potclient.errors import UsageError
from potclient.towns import PERIOD_S, SENSORS, STYLES, Lidar, Town, TownName, TownRecording, open_town
from potclient.towns.blocks import build_block
from potclient.towns.export import write_drive
from potclient.towns.pictures import draw_plan, draw_styles
from potclient.towns.solids import Kind, SolidSet, blob, box, placed, post, roof, slab
from potclient.towns.streets import StreetGrid

OUTDOORS = ("terraces", "suburb", "downtown")
SMALL = Lidar(
    name="small", elevations_rad=tuple(np.radians(np.linspace(-24, 3, 24))), n_azimuth=180, max_range_m=40.0
)


def drive(
    name: str, n_scans: int = 30, *, noise_m: float = 0.0, dropout: float = 0.0, planar: bool = False
) -> TownRecording:
    """A recording with a small, by default perfect, sensor."""
    recording = open_town(name, n_scans=n_scans)
    lidar = recording.lidar if planar else SMALL
    lidar = dataclasses.replace(lidar, noise_m=noise_m, dropout=dropout)
    return TownRecording(recording.town, lidar, recording.indices, str(recording.path))


def sample(town: Town, n: int, z_m: float, reach_m: float = 110.0) -> np.ndarray:
    """(n,) truth at random places of one height."""
    xy = np.random.default_rng(5).uniform(-reach_m, reach_m, (n, 2))
    return town.occupied(np.column_stack([xy, np.full(n, z_m)]))


# --- solids ----------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**31))
@settings(max_examples=30)
def test_solids_contain_the_mixtures_of_their_vertices_and_nothing_beyond_a_face(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, size = rng.uniform(-20, 20, 3), rng.uniform(0.3, 12, 3)
    parts = [
        box(low, low + size, Kind.WALL, taper=0.1 * size[:2].min()),
        roof(low + 3, low + 3 + size, hip_m=0.3 * size[0]),
        post(*low[:2], 0.0, size[2], 0.4, Kind.POLE, top_radius_m=0.1),
        blob(low, size, rng, Kind.TREE),
        slab(low, low + size, 0.2 * size[:2].min(), Kind.PAVEMENT),
    ]
    parts = placed(parts, *rng.uniform(-5, 5, 2), rng.uniform(-4, 4))
    together = SolidSet(parts)
    for part in parts:
        vertices = part[1]
        mixtures = rng.dirichlet(np.ones(len(vertices)), 40) @ vertices
        assert SolidSet([part]).contains(mixtures).all()
        assert together.contains(mixtures).all()
        middle = vertices.mean(axis=0)
        assert not SolidSet([part]).contains(middle + 1.01 * (vertices - middle)).any()
    beyond = rng.uniform(-60, 60, (300, 3))
    alone = np.any([SolidSet([part]).contains(beyond) for part in parts], axis=0)
    np.testing.assert_array_equal(together.contains(beyond), alone)


def test_no_solids_contain_nothing() -> None:
    assert not SolidSet([]).contains(np.zeros((3, 3))).any()
    assert SolidSet([box((0, 0, 0), (1, 1, 1), Kind.WALL)]).contains(np.zeros((0, 3))).shape == (0,)


@pytest.mark.parametrize("style", STYLES)
def test_blocks_stay_in_their_cells(style: str) -> None:
    grid = StreetGrid(STYLES[style], 3)
    for cell in itertools.product((-1, 0, 1), (0, 1)):
        lower, upper = grid.bounds(cell)
        block = build_block(grid, cell)
        solids = SolidSet([*block.parts, *(part for car in block.parked for part in car.parts())])
        assert len(solids) > 10
        assert (solids.lower[:, :2] >= lower).all()
        assert (solids.upper[:, :2] <= upper).all()


# --- the same town again ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["terraces:dynamic:5", "suburb:5", "downtown:2d:dynamic:5", "offices:2d:dynamic:5"]
)
def test_the_same_seed_gives_the_same_town_and_scans_in_any_order(name: str) -> None:
    first, again = (drive(f"town:{name}", planar="2d" in name, noise_m=0.02, dropout=0.1) for _ in range(2))
    again.town.occupied(np.random.default_rng(0).uniform(-40, 40, (500, 3)))  # builds other blocks first
    late = again[25]
    for k in (25, 3):
        mine, other = first[k], late if k == 25 else again[k]
        np.testing.assert_array_equal(mine.points, other.points)
        np.testing.assert_array_equal(mine.is_return, other.is_return)
        np.testing.assert_array_equal(mine.T_map_sensor, other.T_map_sensor)
    different = drive(f"town:{name[:-1]}6", planar="2d" in name)
    assert not np.array_equal(first[3].points, different[3].points)


# Published scores name towns by style and seed: blocks to the micrometre, and what a scan 2 s into the drive sees.
GOLDEN = {
    "terraces": ("9635920394f53837", 12652, 11.95400),
    "suburb": ("0f5add96ae9e6561", 10141, 15.73860),
    "downtown": ("0d317e17a388a835", 11811, 19.32301),
    "offices": ("5c822cf57fdd26e2", 14116, 3.62773),
}


@pytest.mark.parametrize("style", STYLES)
def test_towns_are_what_they_were(style: str) -> None:
    digest = hashlib.sha256()
    for cell in itertools.product(range(-2, 2), range(-2, 2)):
        block = build_block(StreetGrid(STYLES[style], 7), cell)
        for shape, vertices, kind in [*block.parts, *(part for car in block.parked for part in car.parts())]:
            digest.update(shape.corners.astype("<i8").tobytes())
            digest.update((np.rint(vertices * 1e6) + 0.0).astype("<i8").tobytes())
            digest.update(bytes([kind]))
    scan = open_town(f"town:{style}:dynamic:vlp16:7", n_scans=40)[20]
    ranges = np.linalg.norm(scan.points[scan.is_return], axis=1)
    blocks, n_echoes, mean_m = GOLDEN[style]
    assert (digest.hexdigest()[:16], len(ranges)) == (blocks, n_echoes)
    assert ranges.mean() == pytest.approx(mean_m, abs=1e-4)


def test_the_length_of_the_drive_does_not_change_the_town() -> None:
    short, long = Town("terraces", 2, length_m=50), Town("terraces", 2, length_m=900)
    np.testing.assert_array_equal(sample(short, 3000, 0.6), sample(long, 3000, 0.6))
    np.testing.assert_array_equal(short.pose(5.0), long.pose(5.0))


# --- styles ----------------------------------------------------------------------------------------------------------


def test_styles_differ_in_ways_that_can_be_measured() -> None:
    towns = {style: Town(style, 1) for style in OUTDOORS}
    built = {s: sample(t, 6000, 3.5).mean() for s, t in towns.items()}  # above cars and hedges
    high = {s: sample(t, 6000, 15.0).mean() for s, t in towns.items()}
    low = {s: sample(t, 6000, 0.6).mean() for s, t in towns.items()}
    assert built["downtown"] > 1.3 * built["terraces"]
    assert built["terraces"] > 1.6 * built["suburb"]
    assert high["downtown"] > 0.2
    assert max(high["terraces"], high["suburb"]) < 0.02
    assert 1 - low["suburb"] > 0.75 > 1 - low["terraces"] > 1 - low["downtown"]
    width = {s: np.mean([t.grid.street(0, k).width_m for k in range(20)]) for s, t in towns.items()}
    assert width["downtown"] > 1.5 * max(width["terraces"], width["suburb"])
    cells = list(itertools.product(range(3), range(3)))
    parked = {
        s: sum(len(t.block(c).parked) for c in cells)
        / sum(np.ptp(t.grid.bounds(c), axis=0).sum() for c in cells)
        for s, t in towns.items()
    }
    assert parked["terraces"] > 1.5 * parked["downtown"] > 1.5 * 1.5 * parked["suburb"]


def test_every_style_has_what_its_summary_says() -> None:
    def kinds(style: str) -> set[Kind]:
        town = Town(style, 0)
        solids = [town.solids(cell) for cell in itertools.product(range(3), range(3))]
        return {Kind(int(k)) for s in solids for k in s.kind}

    outdoors = {Kind.PAVEMENT, Kind.BUILDING, Kind.TREE, Kind.POLE, Kind.CAR}
    assert kinds("terraces") >= outdoors | {Kind.ROOF, Kind.WALL}
    assert kinds("suburb") >= outdoors | {Kind.ROOF, Kind.HEDGE}
    assert kinds("downtown") >= outdoors | {Kind.FURNITURE}
    assert kinds("offices") >= {Kind.WALL, Kind.FURNITURE}


# --- drives ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("seed", [0, 11])
def test_a_drive_is_smooth_has_its_length_and_touches_nothing(style: str, seed: int) -> None:
    length = 150.0 if style == "offices" else 1200.0
    town = Town(style, seed, length_m=length)
    step = 0.05
    way = town.drive.at(np.arange(0.0, length + step / 2, step))
    moves = np.diff(way, axis=0)
    assert np.hypot(moves[:, 0], moves[:, 1]).sum() == pytest.approx(length, rel=1e-3)
    assert np.hypot(moves[:, 0], moves[:, 1]).max() <= step * (1 + 1e-9)
    bend = np.abs(np.remainder(moves[:, 2] + math.pi, 2 * math.pi) - math.pi) / step
    assert bend.max() <= 1.001 / (0.45 if style == "offices" else 5.0)
    along = np.arctan2(moves[:, 1], moves[:, 0]) - way[:-1, 2]
    assert np.abs(np.remainder(along + math.pi, 2 * math.pi) - math.pi).max() < 0.06
    turned = np.abs(moves[:, 2]).sum()
    assert turned > math.pi, "it does not only go straight on"
    half = 0.45 * np.array(town.style.body_m)  # the whole vehicle is free, at some heights
    c, s = np.cos(way[::10, 2]), np.sin(way[::10, 2])
    for a, b in itertools.product((-1, 0, 1), (-1, 0, 1)):
        for z in (0.3, town.style.slice_m, town.style.sensor_m):
            x = way[::10, 0] + a * half[0] * c - b * half[1] * s
            y = way[::10, 1] + a * half[0] * s + b * half[1] * c
            assert not town.occupied(np.column_stack([x, y, np.full(len(x), z)])).any()


def test_long_drives_keep_finding_new_streets() -> None:
    town = Town("suburb", 4, length_m=3000.0)
    way = town.drive.at(np.arange(0.0, 3000.0, 5.0))
    visited, counts = np.unique(np.round(way[:, :2] / 10.0), axis=0, return_counts=True)
    assert len(visited) > 200
    assert np.median(counts) <= 3


def test_scans_lie_on_the_drive_at_the_speed_and_rate_promised() -> None:
    recording = open_town("town:suburb:40m")
    assert len(recording) == 41
    scans = [recording[k] for k in (0, 1, 40)]
    assert [s.stamp_ns for s in scans] == [0, 100_000_000, 4_000_000_000]
    step = scans[1].T_map_sensor[:3, 3] - scans[0].T_map_sensor[:3, 3]
    assert np.linalg.norm(step) == pytest.approx(recording.town.style.speed_m_s * PERIOD_S)
    for scan in scans:
        assert scan.T_map_sensor[2, 3] == 1.73
        R = scan.T_map_sensor[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert 0 < math.acos(R[2, 2]) < 0.01, "it sways, and only a little"
    planar = open_town("town:offices:2d:planar180", n_scans=4)[3]
    assert planar.is_planar
    assert (planar.points[:, 2] == 0).all()
    assert (planar.points[:, 0] > -1e-6).all(), "half a turn looks ahead"
    np.testing.assert_array_equal(planar.T_map_sensor[2], [0, 0, 1, 0])


# --- rays and truth --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        "terraces:dynamic",
        "suburb:dynamic",
        "downtown:dynamic",
        "offices",
        "terraces:2d:dynamic",
        "offices:2d:dynamic",
    ],
)
def test_rays_end_where_the_truth_begins(name: str) -> None:
    recording = drive(f"town:{name}:8", n_scans=120, planar="2d" in name)
    town = recording.town
    for k in (0, 57, 119):
        scan = recording[k]
        time_s = scan.stamp_ns / 1e9
        origin, ends = scan.T_map_sensor[:3, 3], scan.in_map
        range_m = np.linalg.norm(ends - origin, axis=1)
        unit = (ends - origin) / range_m[:, None]

        def share(at: np.ndarray, chosen: np.ndarray, *, origin=origin, unit=unit, time_s=time_s) -> float:
            points = origin + at[chosen, None] * unit[chosen]
            return float(town.occupied(points, time_s).mean())

        hit = scan.is_return
        assert hit.mean() > 0.5
        everywhere = np.ones(len(hit), np.bool_)
        assert share(range_m - 1e-3, everywhere) == 0.0, "free up to the hit"
        assert share(range_m + 1e-3, hit) > 0.99, "solid behind it, but for beams that graze an edge"
        assert share(range_m + 0.05, hit) > 0.95, "and not thin, mostly"
        for fraction in np.linspace(0.02, 0.98, 13):
            assert share(fraction * (range_m - 1e-3), everywhere) == 0.0


def test_the_road_is_seen_and_the_kerb_stands_above_it() -> None:
    scan = drive("town:terraces:1")[20]
    z = scan.in_map[scan.is_return][:, 2]
    assert (np.abs(z) < 1e-4).mean() > 0.2
    assert (np.abs(z - 0.12) < 1e-4).mean() > 0.004
    town = open_town("town:terraces:1").town
    assert town.occupied([[0, 0, -0.01]])[0]
    offices = Town("offices", 1)
    assert offices.occupied([[0, 0, 2.71]])[0]
    assert offices.occupied(np.array([[0.0, 0.0, -1.0]]))[0]


def test_a_planar_town_is_the_slice_of_the_town() -> None:
    for style in STYLES:
        solid, flat = Town(style, 3), Town(style, 3, slice_m=STYLES[style].slice_m)
        reach_m = 20.0 if style == "offices" else 60.0
        xy = np.random.default_rng(1).uniform(-reach_m, reach_m, (4000, 2))
        height = np.full(len(xy), STYLES[style].slice_m)
        truth = solid.occupied(np.column_stack([xy, height]))
        assert 0.02 < truth.mean() < 0.98
        np.testing.assert_array_equal(flat.occupied(xy), truth)
        np.testing.assert_array_equal(flat.occupied(np.column_stack([xy, 0 * height])), truth)
        with pytest.raises(DatasetError, match=r"\(N, 3\)"):
            solid.occupied(xy)


# --- the sensor ------------------------------------------------------------------------------------------------------


def test_beams_without_an_echo_come_at_the_largest_range() -> None:
    recording = open_town("town:suburb:2", n_scans=3, max_range_m=15.0)
    scan = recording[1]
    range_m = np.linalg.norm(scan.points, axis=1)
    assert 0.1 < scan.is_return.mean() < 0.9
    np.testing.assert_allclose(range_m[~scan.is_return], 15.0, rtol=1e-6)
    assert range_m[scan.is_return].max() <= 15.0 + 1e-5
    assert not recording.town.occupied(scan.in_map[~scan.is_return]).any()


def test_noise_and_drop_outs_are_as_large_as_asked() -> None:
    exact = drive("town:suburb:2")[7]
    noisy = drive("town:suburb:2", noise_m=0.05)[7]
    np.testing.assert_array_equal(exact.is_return, noisy.is_return)
    error = (np.linalg.norm(noisy.points, axis=1) - np.linalg.norm(exact.points, axis=1))[exact.is_return]
    assert error.std() == pytest.approx(0.05, rel=0.1)
    assert abs(error.mean()) < 0.005
    beams = len(SMALL.directions())
    assert len(exact) == beams
    thinned = drive("town:suburb:2", dropout=0.3)
    kept = [len(thinned[k]) / beams for k in (7, 8)]
    np.testing.assert_allclose(kept, 0.7, atol=0.04)
    assert kept[0] != kept[1], "each scan has random numbers of its own"


def test_what_is_too_near_is_not_delivered() -> None:
    recording = drive("town:offices:3")
    near = dataclasses.replace(SMALL, noise_m=0.0, dropout=0.0, min_range_m=2.0)
    scan = TownRecording(recording.town, near, range(4))[2]
    assert np.linalg.norm(scan.points, axis=1).min() >= 2.0
    assert len(scan) < len(recording[2])


@pytest.mark.parametrize("name", SENSORS)
def test_sensors_have_their_beams(name: str) -> None:
    lidar = SENSORS[name]
    beams = lidar.directions()
    assert len(beams) == len(lidar.elevations_rad) * lidar.n_azimuth
    np.testing.assert_allclose(np.linalg.norm(beams, axis=1), 1.0)
    assert len(np.unique(np.round(beams, 9), axis=0)) == len(beams)
    assert lidar.is_planar == bool((beams[:, 2] == 0).all())


# --- what moves ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("style", OUTDOORS)
def test_cars_move_parked_ones_leave_and_none_touches_the_sensors_car(style: str) -> None:
    town = Town(style, 1, length_m=500.0, dynamic=True)
    traffic = town.traffic
    always = np.isneginf(traffic.start_s)
    assert always.sum() > 20
    times = np.arange(0.0, town.duration_s, 1.0)
    moves = np.diff(traffic.poses(times)[:, :, :2], axis=0)
    speed = np.linalg.norm(moves, axis=2)
    np.testing.assert_allclose(speed[:, always], np.tile(traffic.speed_m_s[always], (len(speed), 1)))
    place = np.array([0.0, 0.0, 0.5])
    for k in np.flatnonzero(always)[:5]:
        for t in (0.0, 10.0):
            x, y, _ = traffic.poses(np.array([t]))[0, k]
            assert town.occupied(place + np.array([[x, y, 0.0]]), t)[0]
    leaving = np.flatnonzero(~always)
    assert len(leaving) > 0
    quiet = Town(style, 1, length_m=500.0)
    for k in leaving:
        start = traffic.start_s[k]
        parked = place + np.append(traffic.base[k], 0.0)[None]
        assert quiet.occupied(parked)[0], "a car of the static town"
        assert town.occupied(parked, start - 0.1)[0]
        assert not town.occupied(parked, start + 12.0)[0], "it has left"
    for time_s in np.arange(0.0, town.duration_s, 0.5):
        x, y, yaw = town.drive.at(np.array([town.style.speed_m_s * time_s]))[0]
        c, s = math.cos(yaw), math.sin(yaw)
        body = np.array(list(itertools.product((-2.0, -1.0, 0.0, 1.0, 2.0), (-0.8, 0.0, 0.8), (0.5, 1.2))))
        points = np.column_stack(
            [x + body[:, 0] * c - body[:, 1] * s, y + body[:, 0] * s + body[:, 1] * c, body[:, 2]]
        )
        assert not town.occupied(points, time_s).any()


def test_moving_cars_do_not_run_through_each_other_where_the_sensor_sees_them() -> None:
    traffic = Town("downtown", 2, length_m=300.0, dynamic=True).traffic
    sizes = traffic.sizes_m
    reach = (sizes[:, None] / 2 + sizes / 2).min(axis=2)  # nearer centres than this would overlap
    np.fill_diagonal(reach, 0.0)
    for poses in traffic.poses(np.arange(0.0, 25.0, 0.25)):
        apart = np.linalg.norm(poses[:, None, :2] - poses[:, :2], axis=2)
        assert (apart >= reach).all()


def test_scans_see_what_moves() -> None:
    still, moving = drive("town:downtown:4", n_scans=100), drive("town:downtown:dynamic:4", n_scans=100)
    changed = [
        np.mean(np.linalg.norm(still[k].points - moving[k].points, axis=1) > 0.5) for k in range(0, 100, 20)
    ]
    assert max(changed) > 0.005
    people = Town("offices", 1, length_m=30.0, dynamic=True)
    assert len(people.traffic) > 3
    assert {Kind(part[2]) for part in people.moving(0.0, np.full(2, -99.0), np.full(2, 99.0))} == {
        Kind.PERSON
    }


# --- names, files and the command ------------------------------------------------------------------------------------


@given(
    style=st.sampled_from(list(STYLES)),
    seed=st.integers(0, 2**40),
    planar=st.booleans(),
    dynamic=st.booleans(),
    length=st.none() | st.integers(1, 5000).map(float),
)
def test_names_are_read_back(
    style: str, seed: int, planar: bool, dynamic: bool, length: float | None
) -> None:
    name = TownName(style=style, seed=seed, planar=planar, dynamic=dynamic, length_m=length)
    assert TownName.parse(str(name)) == name


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("town", "need town:STYLE"),
        ("town:paris", "terraces, suburb, downtown, offices"),
        ("town:suburb:4d", "'4d' is none of"),
        ("town:suburb:-3", "'-3' is none of"),
        ("town:suburb:0m", "more than 0"),
        ("town:suburb:2d:vlp16", "planar"),
        ("town:suburb:planar360:3d", "planar"),
    ],
)
def test_names_that_mean_nothing(name: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        open_dataset(name)


def test_a_dataset_is_a_town_and_so_are_its_slices() -> None:
    recording = open_dataset("town:suburb:2d:3", n_generated=12, max_range_m=10.0)
    assert isinstance(recording, TownRecording)
    assert (len(recording), recording.format, recording.lidar.max_range_m) == (12, "town", 10.0)
    some = recording[2::3]
    assert isinstance(some, TownRecording)
    assert some.town is recording.town
    assert [s.name for s in some] == [recording[k].name for k in (2, 5, 8, 11)]
    with pytest.raises(IndexError):
        recording[12]
    with pytest.raises(DatasetError, match="min < max"):
        open_dataset("town:suburb", min_range_m=90.0)


@pytest.mark.parametrize("name", ["town:terraces:dynamic:vlp16:3", "town:offices:2d:3"])
def test_a_written_drive_is_read_back(name: str, tmp_path: Path) -> None:
    recording = open_town(name, n_scans=9, max_range_m=20.0)[1::3]
    seen = []
    write_drive(recording, tmp_path / "drive", on_scan=lambda: seen.append(1), picture=False)
    assert len(seen) == 3
    again = open_dataset(tmp_path / "drive")
    assert again.format == "clouds"
    assert len(again) == 3
    for mine, read in zip(recording, again, strict=True):
        np.testing.assert_array_equal(mine.points, read.points)
        np.testing.assert_array_equal(mine.is_return, read.is_return)
        np.testing.assert_array_equal(mine.T_map_sensor, read.T_map_sensor)
        assert (mine.stamp_ns, mine.is_planar) == (read.stamp_ns, read.is_planar)
    about = json.loads((tmp_path / "drive" / "recording.json").read_text())
    assert about["dataset"] == str(recording.path)
    assert about["n_beams"] == sum(len(s) for s in recording)
    line = next(x for x in (tmp_path / "drive" / "README.txt").read_text().splitlines() if "open_town(" in x)
    made_again = eval(line.split("=", 1)[1], {"open_town": open_town})
    np.testing.assert_array_equal(made_again[2].points, recording[2].points)
    with pytest.raises(UsageError, match="exists already"):
        write_drive(recording, tmp_path / "drive")


def test_a_drive_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_drive(open_town("town:offices:2d", n_scans=3), tmp_path / "drive", on_scan=stop)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("content", "message"),
    [("[1]", "JSON object"), ("{", "JSON object"), ('{"is_planar": 1}', "true or false")],
)
def test_a_damaged_recording_file_is_named(tmp_path: Path, content: str, message: str) -> None:
    write_drive(open_town("town:offices:2d", n_scans=1), tmp_path / "drive", picture=False)
    (tmp_path / "drive" / "recording.json").write_text(content)
    with pytest.raises(DatasetError, match=message):
        open_dataset(tmp_path / "drive")


def test_the_command_writes_a_drive_with_a_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "drive"
    words = ["--2d", "--dynamic", "--seed", "4", "--length", "4", "--every", "1", "--max-range", "9"]
    assert main(["town", "offices", *words, "-o", str(target)]) == 0
    assert "5 scans over 4 m" in capsys.readouterr().out.replace("offices:", "")
    assert len(open_dataset(target)) == 5
    assert (target / "plan.png").read_bytes().startswith(b"\x89PNG")
    assert main(["town", "offices", "-o", str(target)]) == 2
    assert main(["town", "atlantis", "-o", str(tmp_path / "x")]) == 2
    assert main(["town", "suburb", "--seed", "-1", "-o", str(tmp_path / "x")]) == 2
    assert main(["town", "suburb", "--sensor", "sonar", "-o", str(tmp_path / "x")]) == 2
    assert "sonar" in capsys.readouterr().err


def test_the_commands_help_names_every_style_and_sensor(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["town", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    for style in STYLES.values():
        assert style.name in text
        assert style.summary in text
    for sensor in SENSORS:
        assert sensor in text


def test_pictures_of_towns_can_be_drawn(tmp_path: Path) -> None:
    draw_plan(open_town("town:suburb:dynamic:40m"), tmp_path / "plan.png", margin_m=20.0)
    draw_styles(tmp_path / "styles.png", ("town:offices:2d:6m",))
    assert all(f.stat().st_size > 10_000 for f in tmp_path.iterdir())


# --- without open3d --------------------------------------------------------------------------------------------------


def test_without_open3d_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    for name in ("town:terraces", "town:offices:2d"):
        with pytest.raises(DatasetError, match=r"pip install 'potserver\[towns\]'"):
            open_dataset(name)
    assert Town("terraces").occupied([[0.0, 0.0, -1.0]])[0], "the truth needs no open3d"


def test_towns_load_open3d_only_to_cast_rays() -> None:
    code = """
import sys
from potclient.towns import open_town
recording = open_town("town:suburb:dynamic", n_scans=20)
recording.town.occupied([[0.0, 0.0, 1.0]])
assert not {"open3d", "matplotlib", "plyfile", "torch"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)
