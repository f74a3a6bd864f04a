"""MappingService by what it does: small rooms, both profiles, in 2D and 3D."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import MapUpdate, ParamsKind, Scan, yaw_pose
from potserver.errors import EmptyError
from potserver.mapping.carrying import Carrier
from potserver.mapping.refinement import borrowed_prior, flat_prior
from potserver.mapping.service import MappingService, method_of
from potserver.mapping.settings import PROFILES, MappingSettings

from .kernels import assert_same

TRANSPORTED = ParamsKind.TRANSPORTED
ROOM = np.array(
    [6.0, 4.0, 2.5]
)  # m, half the length, width and height; the room is centred on the map's origin
NO_ATOMS = AtomDictionary(())
FAST = {"beams_per_scan": 1200}


def _directions(n: int, seed: int, planar: bool) -> np.ndarray:
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(-np.pi, np.pi, n)
    height = np.zeros(n) if planar else rng.uniform(-0.5, 0.5, n)
    return np.stack([np.cos(azimuth), np.sin(azimuth), height], axis=1) / np.hypot(1.0, height)[:, None]


def _room_scan(
    *, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, n: int = 1200, seed: int = 0, planar: bool = False,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0), **changes,
) -> Scan:  # fmt: skip
    """A scan from inside the box, exact to float32."""
    pose = yaw_pose(x + centre[0], y + centre[1], yaw, centre[2])
    direction = _directions(n, seed, planar)
    in_map = direction @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        to_wall = (np.sign(in_map) * ROOM - [x, y, 0.0]) / in_map
    length = np.where(in_map == 0.0, np.inf, to_wall).min(axis=1)
    fields = {
        "robot_id": "r", "seq": seed, "stamp_ns": seed, "points": (direction * length[:, None]).astype(np.float32),
        "is_return": np.ones(n, bool), "T_map_sensor": pose, "is_planar": planar,
    }  # fmt: skip
    return Scan(**(fields | changes))


def _service(profile: str = "default", dictionary: AtomDictionary | None = None, **changes) -> MappingService:
    settings = dataclasses.replace(MappingSettings.of_profile(profile), **(FAST | changes))
    return MappingService(dictionary, settings, threads=2)


def test_a_new_dictionary_counts_from_the_next_scan_on(monkeypatch: pytest.MonkeyPatch) -> None:
    builtin = AtomDictionary.builtin()
    deep = builtin.of_dims(3).atoms
    one, other = AtomDictionary(deep[:1]), AtomDictionary(deep[-1:])
    service = _service(dictionary=one)
    scan = _room_scan()

    match = Carrier.match

    def swap_and_match(carrier, sectors, *, planar):
        """In the middle of a scan."""
        service.use_dictionary(other)
        return match(carrier, sectors, planar=planar)

    with monkeypatch.context() as patched:
        patched.setattr(Carrier, "match", swap_and_match)
        first = service.integrate(scan, params=TRANSPORTED)
    second = service.integrate(_room_scan(x=0.3), params=TRANSPORTED)
    assert service.dictionary is other
    assert {match.atom_id for match in first.sectors} - {None} == {deep[0].atom_id}
    assert {match.atom_id for match in second.sectors} - {None} == {deep[-1].atom_id}
    assert service.snapshot.map_revision == 2


def _test_points(scan: Scan, seed: int = 9) -> tuple[np.ndarray, np.ndarray]:
    """Held-out beams of a scan: each end, and one uniform point at least 0.5 m before it (DESIGN section 6)."""
    rng = np.random.default_rng(seed)
    ends = scan.points.astype(np.float64) @ scan.T_map_sensor[:3, :3].T
    length = np.linalg.norm(ends, axis=1)
    free = ends * (rng.random(len(ends)) * (length - 0.5) / length)[:, None]
    return np.concatenate([ends, free]) + scan.origin, np.arange(2 * len(ends)) < len(ends)


def _nll(kernels: KernelMap, points: np.ndarray, occupied: np.ndarray) -> float:
    p = np.clip(kernels.occupancy(points).mean, 1e-6, 1 - 1e-6)
    return float(-np.where(occupied, np.log(p), np.log(1 - p)).mean())


def _check_update(update: MapUpdate, service: MappingService) -> None:
    assert update.map_revision == service.snapshot.map_revision
    assert update.map_kernels == len(service.snapshot)
    assert len(update.sectors) == method_of(service.settings.profile).sectors.n_sectors
    assert np.isfinite(update.kernels.hinge_mean).all()
    for name in ("gamma_shape", "gamma_rate", "weight_var"):
        assert (getattr(update.kernels, name) > 0).all()
    assert all(ms >= 0 for ms in update.timings_ms.values())


@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
@pytest.mark.parametrize("profile", PROFILES)
def test_both_profiles_map_a_room(profile: str, planar: bool) -> None:
    service = _service(profile)
    for k in range(3):
        scan = _room_scan(x=0.5 * k, yaw=0.3 * k, seed=k, planar=planar)
        update = service.integrate(scan, params=TRANSPORTED)
        _check_update(update, service)
        assert update.map_revision == k + 1
        assert len(update.kernels), "atoms are carried to every cloud that asks for them"
        assert any(s.atom_id and s.converged for s in update.sectors)
    assert service.n_scans == 3
    assert sum(service.atom_usage.values()) >= 3
    points, occupied = _test_points(_room_scan(x=0.7, seed=77, planar=planar, n=200))
    # pure transport moves the atoms of streets into this room, and covers a part of it
    assert service.snapshot.occupancy(points).observed.mean() > (0.8 if profile == "default" else 0.15)
    if profile == "default":
        assert ((service.snapshot.occupancy(points).mean > 0.5) == occupied).mean() > 0.9
        assert _nll(service.snapshot, points, occupied) < 0.4


@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
def test_default_beats_paper_on_held_out_beams(planar: bool) -> None:
    scores = {}
    held_out = [_room_scan(x=0.4 * k, seed=100 + k, n=300, planar=planar) for k in range(3)]
    points, occupied = (np.concatenate(parts) for parts in zip(*map(_test_points, held_out), strict=True))
    for profile in PROFILES:
        service = _service(profile)
        for k in range(3):
            service.integrate(_room_scan(x=0.4 * k, seed=k, planar=planar))
        scores[profile] = _nll(service.snapshot, points, occupied)
    assert scores["default"] < 0.5 * scores["paper"], scores
    assert scores["default"] < np.log(2) / 2, scores


def test_the_same_scans_give_the_same_map_on_any_number_of_threads() -> None:
    maps = []
    for threads in (1, 3):
        service = MappingService(
            settings=dataclasses.replace(MappingSettings(), **FAST), threads=threads, seed=5
        )
        for k in range(2):
            update = service.integrate(_room_scan(x=0.4 * k, seed=k, n=2000), params=TRANSPORTED)
        maps.append((service.snapshot.kernels, update.kernels, [s[:7] for s in update.sectors]))
    points, _ = _test_points(_room_scan(seed=50, n=200))
    one, other = (KernelMap(kernels).occupancy(points).mean for kernels, _, _ in maps)
    # sums over threads may round differently; nothing else may
    np.testing.assert_allclose(one, other, atol=2e-3)
    assert maps[0][2] == maps[1][2]


def test_the_same_service_twice_is_the_same_to_the_bit() -> None:
    kernels = []
    for _ in range(2):
        service = MappingService(settings=dataclasses.replace(MappingSettings(), **FAST), threads=2, seed=5)
        for k in range(2):
            service.integrate(_room_scan(x=0.4 * k, seed=k, n=2000))
        kernels.append(service.snapshot.kernels)
    assert_same(*kernels)


def test_another_seed_draws_other_free_points() -> None:
    maps = [
        MappingService(settings=dataclasses.replace(MappingSettings(), **FAST), threads=1, seed=s)
        for s in (1, 2)
    ]
    for service in maps:
        service.integrate(_room_scan())
    assert len(maps[0].snapshot) != len(maps[1].snapshot) or not np.array_equal(
        maps[0].snapshot.kernels.weight_mean, maps[1].snapshot.kernels.weight_mean
    )


@pytest.mark.parametrize("profile", PROFILES)
def test_a_scan_that_fails_leaves_no_trace(profile: str, monkeypatch: pytest.MonkeyPatch) -> None:
    service, twin = _service(profile), _service(profile)
    for s in (service, twin):
        s.integrate(_room_scan(seed=1))
    before, usage = service.snapshot, dict(service.atom_usage)
    with pytest.raises(EmptyError):
        service.integrate(_room_scan(points=np.full((1200, 3), 0.01, np.float32)))

    def fail(*_args, **_kwargs):
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(KernelMap, "__init__", fail)  # the last thing that can fail
        with pytest.raises(MemoryError):
            service.integrate(_room_scan(seed=2))
    assert service.snapshot is before
    assert service.n_scans == 1
    assert dict(service.atom_usage) == usage
    for s in (service, twin):
        s.integrate(_room_scan(seed=3))
    assert_same(service.snapshot.kernels, twin.snapshot.kernels)


@pytest.mark.parametrize("profile", PROFILES)
def test_an_old_snapshot_goes_on_answering_the_same(profile: str) -> None:
    service = _service(profile)
    service.integrate(_room_scan(seed=0))
    points, _ = _test_points(_room_scan(seed=50, n=200))
    old = service.snapshot
    before = old.occupancy(points)
    for k in (1, 2):
        service.integrate(_room_scan(x=0.3 * k, seed=k))
    after = old.occupancy(points)
    for name in ("mean", "var", "latent_mean", "latent_var", "observed", "map_revision"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    assert not np.array_equal(service.snapshot.occupancy(points).mean, before.mean)


def test_clear_forgets_and_goes_on_counting() -> None:
    service = _service()
    service.integrate(_room_scan())
    service.clear()
    assert len(service.snapshot) == 0
    assert service.snapshot.map_revision == 2
    assert service.n_scans == 0
    assert service.integrate(_room_scan()).map_revision == 3
    fresh = _service()
    fresh.integrate(_room_scan())
    assert_same(service.snapshot.kernels, fresh.snapshot.kernels)


@pytest.mark.parametrize("height", [0.0, 0.35])
@pytest.mark.parametrize("profile", PROFILES)
def test_planar_scans_keep_their_kernels_in_their_plane(profile: str, height: float) -> None:
    service = _service(profile)
    for k in range(2):
        update = service.integrate(_room_scan(x=0.5 * k, yaw=0.5, seed=k, planar=True, centre=(0, 0, height)))
        np.testing.assert_allclose(update.kernels.hinge_mean[:, 2], height, atol=1e-6)
    np.testing.assert_allclose(service.snapshot.kernels.hinge_mean[:, 2], height, atol=1e-6)


def test_a_map_in_a_plane_knows_that_lattices_sum_to_less_there() -> None:
    service = _service()
    rule = service.snapshot.rule
    service.integrate(_room_scan(planar=True))
    flat = service.snapshot.rule
    assert flat.full_activation < rule.full_activation
    assert flat.observed_activation / flat.full_activation == pytest.approx(
        rule.observed_activation / rule.full_activation
    )
    assert service.snapshot.latent(np.zeros((1, 3))).activation[0] == pytest.approx(
        flat.full_activation, abs=0.3
    )
    service.integrate(_room_scan(seed=1))
    assert service.snapshot.rule.full_activation == rule.full_activation
    assert _service("paper").snapshot.rule.full_activation == 0.0


@pytest.mark.parametrize("profile", PROFILES)
def test_maps_at_utm_coordinates_are_the_same_maps(profile: str) -> None:
    """A shift by whole tiles, which every grid of kernels divides."""
    shift = (500_010.0, 4_100_010.0, 120.0)
    here, there = _service(profile), _service(profile)
    for k in range(2):
        here.integrate(_room_scan(x=0.5 * k, seed=k))
        update = there.integrate(_room_scan(x=0.5 * k, seed=k, centre=shift))
    points, occupied = _test_points(_room_scan(seed=60, n=200))
    one, other = here.snapshot.occupancy(points), there.snapshot.occupancy(points + shift)
    assert np.abs(one.mean - other.mean).mean() < 0.02
    if profile == "default":
        assert _nll(there.snapshot, points + shift, occupied) < 0.4
    assert update.changed.tiles
    for tile in update.changed.tiles:
        low = np.array(tile) * update.changed.tile_size_m - shift
        assert (low < ROOM + 0.1).all()
        assert (low + update.changed.tile_size_m > -ROOM - 0.1).all()


def test_sectors_without_anything_say_so() -> None:
    scan = _room_scan(n=2000)
    ahead = np.abs(np.arctan2(scan.points[:, 1], scan.points[:, 0])) < 0.4
    service = _service(check_share=0.0)
    update = service.integrate(
        _room_scan(points=scan.points[ahead], is_return=np.ones(int(ahead.sum()), bool)), params=TRANSPORTED
    )
    empty = [s for s in update.sectors if s.n_hits + s.n_free == 0]
    assert len(empty) >= 3
    for sector in empty:
        assert sector.atom_id is None
        assert sector.reason
        assert sector.n_kernels == 0
    assert sum(s.n_hits for s in update.sectors) == int(ahead.sum())
    _check_update(update, service)


@pytest.mark.parametrize("profile", PROFILES)
def test_sectors_without_hits(profile: str) -> None:
    scan = _room_scan()
    service = _service(profile)
    update = service.integrate(_room_scan(is_return=scan.points[:, 0] > 0), params=TRANSPORTED)
    assert any(s.n_hits == 0 and s.n_free > 0 for s in update.sectors)
    _check_update(update, service)


@pytest.mark.parametrize("profile", PROFILES)
def test_scans_of_beams_without_return_are_free_space(profile: str) -> None:
    service = _service(profile)
    update = service.integrate(_room_scan(is_return=np.zeros(1200, bool)), params=TRANSPORTED)
    assert all(s.n_hits == 0 for s in update.sectors)
    _check_update(update, service)
    if profile == "default":
        points, occupied = _test_points(_room_scan(seed=5, n=200))
        answer = service.snapshot.occupancy(points[~occupied])
        assert answer.mean[answer.observed].mean() < 0.2


@pytest.mark.parametrize("planar", [False, True])
def test_without_atoms_the_default_profile_still_maps(planar: bool) -> None:
    service = _service("default", NO_ATOMS)
    update = service.integrate(_room_scan(planar=planar), params=TRANSPORTED)
    assert len(update.kernels) == 0
    assert update.n_kernels_added == len(service.snapshot) > 0
    assert all(s.atom_id is None and s.reason for s in update.sectors)
    points, occupied = _test_points(_room_scan(seed=5, n=200, planar=planar))
    assert _nll(service.snapshot, points, occupied) < 0.4


def test_without_atoms_the_paper_profile_has_an_empty_map() -> None:
    service = _service("paper", NO_ATOMS)
    update = service.integrate(_room_scan())
    assert len(update.kernels) == len(service.snapshot) == 0
    assert service.snapshot.map_revision == 1
    assert not service.snapshot.occupancy([[0.0, 0, 0]]).observed.any()


def test_every_labelled_point_is_in_one_sector() -> None:
    """Beams at whole degrees fall exactly on the edges of sectors."""
    angle = np.deg2rad(np.arange(0, 360, 5.0))
    points = np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0 * angle], axis=1).astype(np.float32)
    for yaw_deg in (0.0, 30.0, 45.0, -120.0):
        service = _service(dictionary=NO_ATOMS, check_share=0.0)
        update = service.integrate(
            _room_scan(
                points=points, is_return=np.ones(72, bool), T_map_sensor=yaw_pose(0, 0, np.deg2rad(yaw_deg))
            ),
            params=TRANSPORTED,
        )
        assert sum(s.n_hits for s in update.sectors) == 72


def test_dense_scans_are_thinned_to_the_limit() -> None:
    assert _service().integrate(_room_scan(n=5000)).n_points == 1200


def test_far_and_near_beams_are_cut_as_the_settings_say() -> None:
    service = _service(max_range_m=5.0, min_range_m=1.0)
    points = np.array([[0.5, 0, 0], [3.0, 0, 0], [0, 50.0, 0]], np.float32)
    update = service.integrate(_room_scan(points=points, is_return=np.ones(3, bool)), params=TRANSPORTED)
    assert update.n_points == 2
    assert sum(s.n_hits for s in update.sectors) == 1


def test_transported_weights_can_be_left_out_of_the_prior() -> None:
    kernels = AtomDictionary.builtin().atoms[0].kernels
    flat = flat_prior(kernels, 7.0)
    np.testing.assert_array_equal(flat.hinge_mean, kernels.hinge_mean)
    np.testing.assert_array_equal(flat.weight_mean, 0.0)
    np.testing.assert_array_equal(flat.weight_var, 7.0)


def test_standing_still_does_not_grow_the_default_map() -> None:
    service = _service()
    sizes = [service.integrate(_room_scan(seed=k)).map_kernels for k in range(6)]
    assert sizes[-1] - sizes[-2] < 0.1 * sizes[0], sizes


def test_queries_during_integration_see_exactly_one_revision_each() -> None:
    scans = [_room_scan(x=0.3 * k, seed=k) for k in range(3)]
    points, _ = _test_points(_room_scan(seed=50, n=40))
    rehearsal = _service()
    truth = {0: rehearsal.snapshot.occupancy(points).mean}
    for scan in scans:
        rehearsal.integrate(scan)
        truth[rehearsal.snapshot.map_revision] = rehearsal.snapshot.occupancy(points).mean
    service = _service()
    done = threading.Event()
    wrong: list[str] = []
    seen: set[int] = set()

    def ask() -> None:
        newest = 0
        while True:
            last = done.wait(0.002)  # not in a closed loop: that would starve the writer of the GIL
            answer = service.snapshot.occupancy(points)
            if not np.array_equal(answer.mean, truth[answer.map_revision]):
                wrong.append(f"revision {answer.map_revision} answered something else")
            if answer.map_revision < newest:
                wrong.append("revisions went backwards")
            newest = answer.map_revision
            seen.add(newest)
            if last:
                return

    askers = [threading.Thread(target=ask) for _ in range(4)]
    for asker in askers:
        asker.start()
    try:
        for scan in scans:
            service.integrate(scan)
    finally:
        done.set()
        for asker in askers:
            asker.join()
    assert not wrong, wrong[:3]
    assert len(scans) in seen


def test_warming_up_leaves_the_map_alone() -> None:
    service = _service(
        dictionary=AtomDictionary(
            AtomDictionary.builtin().atoms[:1] + AtomDictionary.builtin().of_dims(2).atoms[:1]
        )
    )
    before = service.snapshot
    service.warm_up()
    assert service.snapshot is before
    assert service.n_scans == 0


def test_what_was_carried_farther_is_trusted_less() -> None:
    kernels = AtomDictionary.builtin().atoms[0].kernels
    near, far = borrowed_prior(kernels, 1.0), borrowed_prior(kernels, 30.0)
    added = near.weight_var - kernels.weight_var
    assert (added > 1.0).all()
    np.testing.assert_allclose(far.weight_var - kernels.weight_var, 30.0 * added, rtol=1e-3)
    np.testing.assert_array_equal(borrowed_prior(kernels, -0.1).weight_var, kernels.weight_var)
