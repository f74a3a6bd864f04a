"""The overall map: it stays bounded, forgets what has left, keeps its resolution, and changes only around a scan."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potschemas.answers import PRIOR_VAR
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.tiles import COARSE, FINE, TiledMap
from potserver.domain.types import Scan, yaw_pose
from potserver.errors import SettingsError, SolverError
from potserver.mapping import fusion
from potserver.mapping.fusion import grid_for
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.numerics.beams import Beams
from potserver.numerics.warm_fit import WarmFit

from .kernels import assert_same

NO_ATOMS = AtomDictionary(())
ROOM = np.array([6.0, 4.0, 2.5])  # m, half the length, width and height
BOX = np.array([[2.0, -0.6, -2.5], [3.2, 0.6, 0.5]])  # m, corners of something that stands in the room

POLE = np.array([3.0, 0.5])  # m


def _scan(
    seed: int = 0,
    *,
    at: tuple[float, float] = (0.0, 0.0),
    box: bool = False,
    n: int = 1500,
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scan:
    """A look around in a room, with or without a box in it."""
    rng = np.random.default_rng(seed)
    azimuth, height = rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.6, 0.4, n)
    direction = np.stack([np.cos(azimuth), np.sin(azimuth), height], axis=1) / np.hypot(1.0, height)[:, None]
    start = np.array([*at, 0.0])
    with np.errstate(divide="ignore"):
        length = ((np.sign(direction) * ROOM - start) / direction).min(axis=1)
        if box:
            near, far = np.sort((BOX[:, None] - start) / direction, axis=0)
            hit = (near.max(axis=1) < far.min(axis=1)) & (near.max(axis=1) > 0)
            length = np.where(hit, np.minimum(near.max(axis=1), length), length)
    pose = yaw_pose(at[0] + shift[0], at[1] + shift[1], 0.0, shift[2])
    return Scan(points=(direction * length[:, None]).astype(np.float32), T_map_sensor=pose, seq=seed)


def _service(dictionary: AtomDictionary | None = NO_ATOMS, *, threads: int = 2, **changes) -> MappingService:
    return MappingService(dictionary, dataclasses.replace(MappingSettings(), **changes), threads=threads)


def _tiled(service: MappingService) -> TiledMap:
    assert service.state.tiled is not None
    return service.state.tiled


@pytest.mark.parametrize(
    ("median_m", "fine_m"), [(0.5, 0.2), (2.0, 0.2), (6.0, 0.3), (8.7, 0.4), (50.0, 0.4)]
)
def test_the_resolution_follows_the_first_scans_range(median_m: float, fine_m: float) -> None:
    ends = np.array([[median_m, 0, 0], [0, median_m, 0], [0, 0.31, 0], [90.0, 0, 0], [95.0, 0, 0]])
    beams = Beams(ends, np.array([True, True, True, True, False]))
    assert grid_for(beams, 10.0).fine_m == pytest.approx(fine_m, rel=0.12)
    free = Beams(ends, np.zeros(5, bool))
    assert grid_for(free, 10.0).fine_m > 0
    assert grid_for(beams, 10.0, 1.0).fine_m == 1.0


def test_the_resolution_stays_until_the_map_is_cleared() -> None:
    service = _service()
    service.integrate(_scan())
    grid = _tiled(service).grid
    near = Scan(points=_scan(1).points * np.float32(0.2), T_map_sensor=np.eye(4))
    far = Scan(points=_scan(1).points * np.float32(3.0), T_map_sensor=np.eye(4))
    for scan in (near, far):
        service.integrate(scan)
        assert _tiled(service).grid == grid
    service.clear()
    service.integrate(far)
    assert _tiled(service).grid.fine_m > grid.fine_m


def test_laps_over_the_same_ground_stop_adding() -> None:
    service = _service()
    lap = [(x, y) for x in (-2.0, 0.0, 2.0) for y in (-1.0, 1.0)]
    kernels, rows = [], []
    for number in range(6):
        for i, at in enumerate(lap):
            service.integrate(_scan(100 * number + i, at=at))
        kernels.append(len(service.snapshot))
        rows.append(sum(len(tile.rows.occupied) for tile in _tiled(service).tiles.values()))
    assert kernels[-1] - kernels[-2] < 0.3 * (kernels[1] - kernels[0])
    assert kernels[-1] < 1.3 * kernels[0]
    fine = _tiled(service).grid.fine_m
    voxels = np.prod(2 * ROOM + fine) / fine**3 + 8 * np.prod(2 * ROOM + 2 * fine) / fine**3
    assert rows[-1] < voxels


def test_a_tile_takes_no_more_kernels_than_its_budget() -> None:
    service = _service(max_kernels_per_tile=50)
    for k in range(3):
        service.integrate(_scan(k))
    sizes = [len(tile.kernels) for tile in _tiled(service).tiles.values()]
    assert max(sizes) == 50
    assert len(service.snapshot) == sum(sizes)


def _box_points(n: int = 300) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.stack([np.full(n, BOX[0, 0]), rng.uniform(-0.5, 0.5, n), rng.uniform(-1.5, 0.3, n)], axis=1)


@pytest.mark.parametrize("looks", [1, 12])
def test_what_has_left_is_gone_after_a_few_scans_that_see_through(looks: int) -> None:
    gone = {}
    for gone_odds in (0.0, 100_000.0):
        service = _service(gone_odds=gone_odds)
        for k in range(looks):
            service.integrate(_scan(k, box=True, n=6000))
        assert service.snapshot.occupancy(_box_points()).mean.mean() > 0.8
        for k in range(6):
            service.integrate(_scan(50 + k, n=6000))
        gone[gone_odds] = service.snapshot.occupancy(_box_points()).mean.mean()
    assert gone[100_000.0] < 0.4
    assert gone[100_000.0] < 0.7 * gone[0.0], "hits and free points alone argue for long"


def _with_pole(seed: int, radius_m: float) -> Scan:
    """A look around in the room with a thin pole in it, from a place of its own."""
    rng = np.random.default_rng(seed)
    start = np.array([rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5)])
    scan = _scan(seed, at=(start[0], start[1]), n=6000)
    points = scan.points.astype(float)
    flat = np.linalg.norm(points[:, :2], axis=1)
    along = points[:, :2] / flat[:, None]
    to_pole = POLE - start
    near = along @ to_pole
    off = np.abs(along[:, 0] * to_pole[1] - along[:, 1] * to_pole[0])
    hit = (off < radius_m) & (near > 0)
    points[hit] *= (near / flat)[hit, None]
    return dataclasses.replace(scan, points=points.astype(np.float32))


def test_a_thin_pole_that_beams_pass_on_both_sides_stays() -> None:
    service = _service()
    for k in range(20):
        service.integrate(_with_pole(k, 0.03))
    height = np.linspace(-0.8, 0.6, 40)
    pole = np.column_stack([np.tile(POLE, (40, 1)), height])
    assert service.snapshot.occupancy(pole).mean.mean() > 0.7


def test_what_stays_does_not_fade() -> None:
    service = _service()
    for k in range(15):
        service.integrate(_scan(k, at=(0.3 * (k % 5), 0.0), box=True, n=6000))
    assert service.snapshot.occupancy(_box_points()).mean.mean() > 0.8


def test_far_from_the_origin_the_map_is_the_same() -> None:
    """5,000 km by whole tiles: only the rounding of the points themselves, a nanometre, is different."""
    shift = (5_000_000.0, -5_000_000.0, 120.0)
    here, there = _service(), _service()
    for k in range(3):
        here.integrate(_scan(k, at=(0.25 * k, 0.5)))
        there.integrate(_scan(k, at=(0.25 * k, 0.5), shift=shift))
    points = np.random.default_rng(0).uniform(-ROOM, ROOM, (2000, 3))
    one, other = here.snapshot.occupancy(points), there.snapshot.occupancy(points + shift)
    np.testing.assert_allclose(one.mean, other.mean, atol=5e-3)
    assert abs(len(here.snapshot) - len(there.snapshot)) <= 2


def test_the_map_is_the_same_to_the_bit_on_any_number_of_threads() -> None:
    kernels = []
    for threads in (1, 2, 5):
        service = _service(threads=threads)
        for k in range(3):
            service.integrate(_scan(k, at=(0.5 * k, 0.0)))
        kernels.append(service.snapshot.kernels)
    assert_same(kernels[0], kernels[1])
    assert_same(kernels[0], kernels[2])


def test_a_scan_changes_only_the_tiles_around_it() -> None:
    service = _service()
    service.integrate(_scan(0))
    before = _tiled(service)
    service.integrate(_scan(1, shift=(200.0, 0.0, 0.0)))
    after = _tiled(service)
    assert all(after.tiles[index] is tile for index, tile in before.tiles.items())
    assert all(after.parts[index] is part for index, part in before.parts.items())
    assert len(after.tiles) == 2 * len(before.tiles)


@pytest.mark.parametrize("fails", ["numbers", "raise"])
def test_a_solve_that_fails_leaves_no_trace(fails: str, monkeypatch: pytest.MonkeyPatch) -> None:
    service, twin = _service(), _service()
    for s in (service, twin):
        s.integrate(_scan(0))
    tiled, snapshot = _tiled(service), service.snapshot
    sums = {index: tile.rows.sums.copy() for index, tile in tiled.tiles.items()}

    def fail(blocks, labels, counts, prior_mean, *_args, **_kwargs) -> WarmFit:
        if fails == "raise":
            raise MemoryError
        nan = np.full(len(prior_mean), np.nan, np.float32)
        return WarmFit(nan, nan, nan, 0.0, 0.0, 1, True)

    with monkeypatch.context() as patched:
        patched.setattr(fusion, "warm_fit", fail)
        with pytest.raises(MemoryError if fails == "raise" else SolverError):
            service.integrate(_scan(1))
    assert service.state.tiled is tiled
    assert service.snapshot is snapshot
    for index, tile in tiled.tiles.items():
        np.testing.assert_array_equal(tile.rows.sums, sums[index])
    for s in (service, twin):
        s.integrate(_scan(2))
    assert_same(service.snapshot.kernels, twin.snapshot.kernels)


def test_a_solve_that_got_stuck_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    service = _service()
    real = fusion.warm_fit
    monkeypatch.setattr(fusion, "warm_fit", lambda *a, **k: real(*a, **k)._replace(converged=False))
    assert not service.integrate(_scan(0)).converged


def test_a_range_beyond_the_voxels_is_refused() -> None:
    service = _service(max_range_m=200_000.0, resolution_m=0.02, tile_size_m=1.0)
    points = np.array([[100_000.0, 0, 0], [1.0, 0, 0]], np.float32)
    with pytest.raises(SettingsError, match="max_range_m"):
        service.integrate(Scan(points=points, T_map_sensor=np.eye(4)))
    assert service.n_scans == 0


def test_no_transported_kernel_joins_the_map() -> None:
    service = _service(None)
    update = service.integrate(_scan(0))
    assert len(update.kernels)
    assert update.n_kernels_transported == 0
    levels = np.concatenate([tile.kernels.level for tile in _tiled(service).tiles.values()])
    assert set(levels.tolist()) == {COARSE, FINE}


def test_priors_are_never_what_a_fit_returned() -> None:
    service = _service()
    for k in range(4):
        service.integrate(_scan(k))
    for tile in _tiled(service).tiles.values():
        np.testing.assert_array_equal(tile.kernels.prior_mean, 0.0)
        np.testing.assert_array_equal(tile.kernels.prior_var, np.float32(PRIOR_VAR))
        if len(tile.kernels):
            assert (tile.kernels.kernels.weight_var < PRIOR_VAR).all()
