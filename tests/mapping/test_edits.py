"""Maps that are merged, robots that are taken out, places that are forgotten, and a change that is not kept."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.tiles import TiledMap, TileGrid
from potserver.domain.types import Float64, Occupancy, Scan, yaw_pose
from potserver.errors import BadPoseError, MapFullError, SettingsError, UnknownRobotError, UnsupportedError
from potserver.mapping.default import DefaultPipeline
from potserver.mapping.pipeline import Method
from potserver.mapping.service import MappingService, pipeline_of
from potserver.mapping.settings import MappingSettings

HALF = np.array([6.0, 4.0, 1.5])  # m, of a room
HOUR_NS = 3_600_000_000_000
AWAY = np.array([60.0, 0.0, 0.0])  # m, to the room beside


def _service(profile: str = "default", *, uncalibrated: bool = False, **changes) -> MappingService:
    settings = dataclasses.replace(MappingSettings.of_profile(profile), resolution_m=0.4, **changes)
    atoms = AtomDictionary(()) if profile == "default" else None
    return MappingService(
        atoms, settings, threads=1, make_pipeline=_uncalibrated if uncalibrated else pipeline_of
    )


def _uncalibrated(settings: MappingSettings, *, threads: int, seed: int) -> DefaultPipeline:
    """Answers by one rule, whatever the self-check finds."""
    return DefaultPipeline(settings, Method(is_calibrated=False), threads=threads, seed=seed)


def _scan(
    k: int,
    robot: str = "a",
    *,
    room: float = 0.0,
    stamp_ns: int | None = None,
    n: int = 2500,
    planar: bool = False,
) -> Scan:
    """From inside a room; `room` moves it along x by so many metres."""
    rng = np.random.default_rng(k)
    d = rng.normal(size=(n, 3))
    d[:, 2] *= 0.0 if planar else 0.4
    d /= np.linalg.norm(d, axis=1)[:, None]
    at = np.array([rng.uniform(-3, 3), rng.uniform(-2, 2), 0.0])
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = np.nanmin(np.abs((np.sign(d) * HALF - at) / d), axis=1)
    pose = yaw_pose(at[0] + room, at[1], 0.0)
    return Scan(
        points=(d * range_m[:, None]).astype(np.float32), T_map_sensor=pose, robot_id=robot, seq=k,
        stamp_ns=k if stamp_ns is None else stamp_ns, is_planar=planar,
    )  # fmt: skip


def _fed(*scans: Scan, **changes) -> MappingService:
    service = _service(**changes)
    for scan in scans:
        service.integrate(scan)
    return service


def _asked(room: float = 0.0, n: int = 1500) -> tuple[Float64, np.ndarray]:
    rng = np.random.default_rng(99)
    inside = rng.uniform(-0.8, 0.8, (n, 3)) * HALF
    wall = inside.copy()
    wall[:, 0] = np.where(rng.random(n) < 0.5, -HALF[0], HALF[0])
    return np.concatenate([wall, inside]) + np.array([room, 0.0, 0.0]), np.arange(2 * n) < n


def _nll(answer: Occupancy, occupied: np.ndarray) -> float:
    p = np.clip(answer.mean, 1e-6, 1 - 1e-6)
    return float(-np.log(np.where(occupied, p, 1 - p)).mean())


@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
def test_two_robots_maps_merge_into_what_one_server_would_hold(planar: bool) -> None:
    ours = [_scan(k, "a", planar=planar) for k in range(4)]
    theirs = [_scan(10 + k, "b", planar=planar) for k in range(4)]
    # checked beams of two halves may choose another calibration than those of the whole
    settings = {"gone_odds": 0.0, "uncalibrated": True}
    both = _fed(*ours, *theirs, **settings)
    one, other = _fed(*ours, **settings), _fed(*theirs, **settings)
    points, occupied = _asked()
    if planar:
        points[:, 2] = 0.0
    revision = one.snapshot.map_revision
    mine, yours = one.state, other.state
    change = one.merge(yours, np.eye(4))
    other.merge(mine, np.eye(4))
    assert one.snapshot.map_revision == revision + 1
    changed = {i for i, tile in one.state.tiled.tiles.items() if tile.revision == revision + 1}
    assert changed
    assert changed <= set(change.tiles)
    assert one.n_scans == 8
    assert set(one.state.tiled.robots) == {"a", "b"}
    truth = both.snapshot.occupancy(points)
    for merged in (one, other):
        answer = merged.snapshot.occupancy(points)
        # kernels that nothing supports go when their place is solved again
        assert abs(len(merged.snapshot) - len(both.snapshot)) <= 0.05 * len(both.snapshot)
        # normals come of all hits at hand: near samples of the halves lie a little otherwise
        assert np.abs(answer.mean - truth.mean).mean() < 0.015
        assert _nll(answer, occupied) < _nll(truth, occupied) + 0.005
    np.testing.assert_allclose(
        one.snapshot.occupancy(points).mean, other.snapshot.occupancy(points).mean, atol=0.05
    )


def test_a_map_in_another_frame_merges_by_its_transform() -> None:
    here, there = _fed(*(_scan(k) for k in range(3))), _service()
    T = yaw_pose(120.0, -35.0, 0.7)
    for k in range(3):
        scan = _scan(20 + k, "b")
        there.integrate(dataclasses.replace(scan, T_map_sensor=np.linalg.inv(T) @ scan.T_map_sensor))
    here.merge(there.state, T)
    direct = _fed(*(_scan(k) for k in range(3)), *(_scan(20 + k, "b") for k in range(3)))
    points, occupied = _asked()
    assert (
        _nll(here.snapshot.occupancy(points), occupied)
        < _nll(direct.snapshot.occupancy(points), occupied) + 0.02
    )


def test_what_cannot_be_merged_changes_nothing() -> None:
    service, other = _fed(_scan(0)), _fed(_scan(1, "b"))
    before = service.state
    with pytest.raises(BadPoseError):
        service.merge(other.state, 2.0 * np.eye(4))
    assert service.merge(_service().state, np.eye(4)).tiles == []
    assert service.state is before
    empty = _service()
    empty.merge(other.state, np.eye(4))
    assert len(empty.snapshot) == pytest.approx(len(other.snapshot), rel=0.01)


def test_a_robot_is_taken_out_again() -> None:
    ours = [_scan(k, "a") for k in range(4)]
    far = [_scan(10 + k, "b", room=60.0) for k in range(2)]
    near = [_scan(20 + k, "b") for k in range(2)]
    # checked beams are not taken out: a calibration by more of them may choose otherwise
    alone = _fed(*ours, gone_odds=0.0, uncalibrated=True)
    service = _fed(*ours, *far, *near, gone_odds=0.0, uncalibrated=True)
    points, occupied = _asked()
    assert service.snapshot.occupancy(points + AWAY).observed.mean() > 0.95
    service.remove_robot("b")
    assert not service.snapshot.occupancy(points + AWAY).observed.any()
    answer, truth = service.snapshot.occupancy(points), alone.snapshot.occupancy(points)
    assert np.abs(answer.mean - truth.mean).mean() < 0.015
    assert _nll(answer, occupied) == pytest.approx(_nll(truth, occupied), abs=0.015)
    # a kernel that only the other robot asked for stays where our data reach it
    assert len(alone.snapshot) <= len(service.snapshot) < 1.1 * len(alone.snapshot)
    weight = [t.rows.sums[:, 3].astype(float).sum() for t in service.state.tiled.tiles.values()]
    expected = [t.rows.sums[:, 3].astype(float).sum() for t in alone.state.tiled.tiles.values()]
    assert sum(weight) == pytest.approx(sum(expected), rel=1e-6)


def test_the_number_of_a_robot_that_was_taken_out_is_given_again() -> None:
    service = _fed(_scan(0, "a"), _scan(1, "b"), _scan(2, "c"))
    service.remove_robot("b")
    with pytest.raises(UnknownRobotError, match="from a, c"):
        service.remove_robot("b")
    service.integrate(_scan(3, "d"))
    assert service.state.tiled.robots == ("a", "d", "c")
    service.remove_robot("d")
    merged = _fed(_scan(4, "e"))
    merged.merge(service.state, np.eye(4))
    assert merged.state.tiled.robots == ("e", "a", "c"), "nobody's number is nobody's elsewhere"


def test_a_map_has_numbers_for_so_many_robots_and_then_says_so() -> None:
    names = tuple(f"r{n}" for n in range(2**15))
    full = TiledMap.empty(TileGrid(10.0, 0.5))._replace(robots=names)
    assert full.with_robot("r5")[1] == 5
    with pytest.raises(MapFullError, match="forget one"):
        full.with_robot("one-more")
    assert full.without_robot(7).with_robot("one-more")[1] == 7


def test_who_was_never_there_cannot_be_taken_out() -> None:
    with pytest.raises(UnknownRobotError, match="empty"):
        _service().remove_robot("a")
    service = _fed(_scan(0))
    with pytest.raises(UnknownRobotError, match="from a"):
        service.remove_robot("b")
    paper = _service("paper")
    paper.integrate(_scan(0))
    with pytest.raises(UnsupportedError, match="evidence"):
        paper.remove_robot("a")


def test_unvisited_places_drift_back_to_unknown_and_not_to_free() -> None:
    service = _service(half_life_s=3600.0)
    for k in range(3):
        service.integrate(_scan(k, stamp_ns=k))
    points, occupied = _asked()
    first = service.snapshot.occupancy(points)
    assert _nll(first, occupied) < 0.3
    entropy = [_entropy(first)]
    for half_hour in range(1, 40):  # each sees to one part of the map
        service.integrate(_scan(100 + half_hour, room=60.0, stamp_ns=half_hour * HOUR_NS // 2, n=600))
        entropy.append(_entropy(service.snapshot.occupancy(points)))
    assert entropy[0] < 0.3
    assert entropy[10] < entropy[20] < entropy[-1]
    assert entropy[-1] > 0.67, "near ln 2: it knows no more"
    last = service.snapshot.occupancy(points)
    assert np.abs(last.mean - 0.5).mean() < 0.1
    assert last.latent_var.mean() > 1.5 * first.latent_var.mean()
    there, where = _asked(60.0)
    assert _nll(service.snapshot.occupancy(there), where) < 0.3, "what is seen again stays known"


def test_without_a_half_life_nothing_is_forgotten() -> None:
    service = _fed(*(_scan(k) for k in range(2)))
    points, _ = _asked()
    before = service.snapshot.occupancy(points)
    service.integrate(_scan(5, room=60.0, stamp_ns=1000 * HOUR_NS))
    np.testing.assert_array_equal(service.snapshot.occupancy(points).mean > 0.5, before.mean > 0.5)


def _entropy(answer: Occupancy) -> float:
    p = np.clip(answer.mean, 1e-9, 1 - 1e-9)
    return float(-(p * np.log(p) + (1 - p) * np.log(1 - p)).mean())


def test_a_scan_whose_commit_fails_leaves_the_map_as_it_was() -> None:
    service, twin = _fed(_scan(0)), _fed(_scan(0))
    before, usage = service.state, dict(service.atom_usage)

    def fail() -> None:
        raise OSError("the disk is full")

    with pytest.raises(OSError, match="disk"):
        service.integrate(_scan(1), commit=fail)
    assert service.state is before
    assert dict(service.atom_usage) == usage
    seen = []
    service.integrate(_scan(1), commit=lambda: seen.append(service.state))
    twin.integrate(_scan(1))
    assert seen == [before], "committed before it is visible"
    np.testing.assert_array_equal(service.snapshot.kernels.weight_mean, twin.snapshot.kernels.weight_mean)


def test_a_saved_state_is_taken_whole() -> None:
    fed, service = _fed(_scan(0), _scan(1)), _service()
    service.restore(fed.state)
    points, _ = _asked()
    np.testing.assert_array_equal(
        service.snapshot.occupancy(points).mean, fed.snapshot.occupancy(points).mean
    )
    assert (service.state.epoch, service.n_scans) == (fed.state.epoch, 2)
    for s in (fed, service):
        s.integrate(_scan(2))
    np.testing.assert_array_equal(service.snapshot.kernels.weight_mean, fed.snapshot.kernels.weight_mean)
    with pytest.raises(SettingsError, match="tile_size_m"):
        _service(tile_size_m=5.0).restore(fed.state)


def test_clearing_begins_another_epoch_and_names_the_tiles() -> None:
    service = _fed(_scan(0))
    before = service.state
    assert set(service.clear().tiles) == set(before.tiled.tiles)
    assert service.state.tiled is None
    assert service.state.epoch != before.epoch
    assert service.snapshot.map_revision == before.map_revision + 1


def test_tiles_say_when_they_changed() -> None:
    service = _fed(_scan(0, stamp_ns=5))
    first = set(service.state.tiled.tiles)
    update = service.integrate(_scan(1, room=200.0, stamp_ns=9))
    tiles = service.state.tiled.tiles
    assert {tiles[i].revision for i in first} == {1}
    assert {(tiles[i].revision, tiles[i].stamp_ns) for i in set(tiles) - first} == {(2, 9)}
    assert set(tiles) - first <= set(update.changed.tiles)
    assert not first & set(update.changed.tiles)


def test_robots_keep_rows_of_their_own() -> None:
    service = _fed(_scan(0, "a"), _scan(0, "b"))
    assert service.state.tiled.robots == ("a", "b")
    for tile in service.state.tiled.tiles.values():
        key = np.column_stack([tile.rows.voxel, tile.rows.kind, tile.rows.source])
        assert len(np.unique(key, axis=0)) == len(key)
    sources = np.concatenate([t.rows.source for t in service.state.tiled.tiles.values()])
    assert (sources == 0).sum() > 0
    assert (sources == 1).sum() > 0


def test_running_scores_are_of_beams_that_were_not_learned() -> None:
    service = _service(check_share=0.3)
    for k in range(4):
        service.integrate(_scan(k))
    scores = service.state.scores
    assert 600 < scores.n_points < 1000, "some hundred beams a scan, two points each"
    moderation = service.snapshot.rule.mean_moderation
    assert 0.0 < scores.mean_nll(moderation) < 0.4
    assert 0.0 < scores.mean_brier < 0.1
    assert 0.0 < scores.ece < 0.2
    assert _service().state.scores.n_points == 0
    assert math.isnan(_service().state.scores.ece)
