"""Atoms from scans."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import numpy as np
import pytest

from potserver.atoms import learning
from potserver.atoms.learning import (
    LearningSettings,
    SectorEpoch,
    beam_weights,
    cut_sectors,
    lattice,
    learn_atoms,
    learn_kernels,
)
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Scan, yaw_pose
from potserver.errors import EmptyError, SettingsError, SolverError
from potserver.numerics.abhm import AbhmOptions, AbhmPosterior
from potserver.numerics.beams import label_beams

SETTINGS = LearningSettings(
    n_sectors=4,
    max_labelled=400,
    min_hits=20,
    max_kernels=40,
    max_epochs=4,
    steps=15,
    batch=200,
    dispersion_epochs=1,
)


@functools.cache
def _learned(planar: bool = False, yaw: float = 0.0) -> tuple:
    return tuple(learn_atoms(_scan(planar, yaw), "room", SETTINGS, {"source": "test"}))


def _scan(planar: bool = False, yaw: float = 0.0, seed: int = 0, n: int = 400, x_m: float = 0.0) -> Scan:
    """An ellipse of walls about (30, -8), seen from `x_m` beside it; nothing behind it."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-0.6 * np.pi, 0.6 * np.pi, n)
    z = np.zeros(n) if planar else rng.uniform(-1, 2, n)
    wall = np.stack([7.0 * np.cos(angle) - x_m, 5.0 * np.sin(angle), z], axis=1)
    pose = yaw_pose(30.0 + x_m, -8.0, yaw)
    return Scan(
        robot_id="r", seq=0, stamp_ns=0, points=(wall @ pose[:3, :3]).astype(np.float32), is_return=np.ones(n, bool),
        T_map_sensor=pose, is_planar=planar,
    )  # fmt: skip


@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
def test_an_atom_for_every_sector_with_enough_hits(planar: bool) -> None:
    atoms = _learned(planar)
    assert [a.atom_id for a in atoms] == ["room-s0", "room-s1", "room-s3"], "nothing was seen behind"
    for atom in atoms:
        assert atom.dims == (2 if planar else 3)
        assert atom.azimuth_width_rad == pytest.approx(math.pi / 2)
        assert atom.radius_m == SETTINGS.max_range_m
        for points in (atom.hit_points, atom.free_points):
            bearing = np.arctan2(points[:, 1], points[:, 0])
            assert (np.abs(bearing) <= math.pi / 4 + 1e-6).all(), "x runs along the bisector"
            assert 0 < len(points) <= SETTINGS.max_points
        kernels = atom.kernels
        assert 10 <= len(kernels) <= SETTINGS.max_kernels
        assert (kernels.weight_var > 0).all()
        assert (kernels.gamma > 0).all()
        for z in (atom.hit_points[:, 2], kernels.hinge_mean[:, 2], kernels.hinge_var[:, 2]):
            assert z.any() != planar


def test_an_atom_says_where_it_comes_from_and_how_learning_ended() -> None:
    atom = _learned()[-1]
    assert atom.provenance["source"] == "test"
    assert atom.provenance["sector"] == "3"
    assert atom.provenance["scans"] == "1"
    assert "ABHM" in atom.provenance["learner"]
    assert 1 <= int(atom.provenance["learner_epochs"]) <= SETTINGS.max_epochs
    assert atom.provenance["learner_converged"] in ("true", "false")
    assert 0.0 < float(atom.provenance["nats_per_point"]) < 0.3


def test_an_atoms_kernels_know_its_own_walls() -> None:
    for atom in _learned():
        kernels = KernelMap(atom.kernels)
        hits, free = kernels.occupancy(atom.hit_points).mean, kernels.occupancy(atom.free_points).mean
        assert hits.mean() > 0.75
        assert free.mean() < 0.3


def test_the_heading_of_the_sensor_turns_nothing_inside_an_atom() -> None:
    straight = _learned()[0]
    headed = learn_atoms(
        dataclasses.replace(_scan(), T_map_sensor=yaw_pose(30.0, -8.0, 1.1)), "room", SETTINGS, {}
    )[0]
    assert straight.hit_points.shape == pytest.approx(headed.hit_points.shape, rel=0.1)
    np.testing.assert_allclose(straight.hit_points.mean(axis=0), headed.hit_points.mean(axis=0), atol=0.3)


def test_sectors_are_cut_about_the_heading() -> None:
    straight, turned = _learned(), _learned(yaw=math.pi / 2)
    assert [a.atom_id for a in turned] == ["room-s0", "room-s2", "room-s3"]
    np.testing.assert_allclose(
        straight[0].hit_points.mean(axis=0), turned[2].hit_points.mean(axis=0), atol=0.3
    )


def test_the_same_seed_learns_the_same_atoms_with_any_number_of_threads() -> None:
    one, other = _learned(), learn_atoms(_scan(), "room", SETTINGS, {}, threads=3)
    for a, b in zip(one, other, strict=True):
        for field in dataclasses.fields(a.kernels):
            np.testing.assert_array_equal(getattr(a.kernels, field.name), getattr(b.kernels, field.name))
        np.testing.assert_array_equal(a.free_points, b.free_points)
    another = learn_atoms(_scan(), "room", SETTINGS, {}, seed=1)
    assert not np.array_equal(one[0].free_points, another[0].free_points)


def test_too_few_hits_make_no_atom() -> None:
    assert learn_atoms(_scan(n=30), "a", SETTINGS, {}) == []


def test_several_scans_are_learned_together_about_the_first() -> None:
    window = [_scan(n=100), _scan(n=100, seed=1, x_m=1.5), _scan(n=100, seed=2, x_m=-1.5, yaw=0.7)]
    alone, together = (learn_atoms(scans, "room", SETTINGS, {}) for scans in (window[0], window))
    assert [a.atom_id for a in together] == ["room-s0", "room-s1", "room-s3"]
    assert len(together[0].hit_points) > 1.5 * len(alone[0].hit_points)
    for atom in together:
        assert atom.provenance["scans"] == "3"
    x, y = together[0].hit_points[:, 0], together[0].hit_points[:, 1]
    np.testing.assert_allclose((x / 7.0) ** 2 + (y / 5.0) ** 2, 1.0, atol=1e-4, err_msg="one wall, not three")


def test_sectors_share_out_all_labelled_points() -> None:
    scan = _scan()
    sectors = cut_sectors([scan], SETTINGS, np.random.default_rng(0))
    assert [s.number for s in sectors] == [0, 1, 2, 3]
    assert sum(s.width_rad for s in sectors) == pytest.approx(2 * math.pi)
    assert sum(int(s.occupied.sum()) for s in sectors) == 400
    free = label_beams(
        scan.beams, free_per_beam=SETTINGS.free_per_beam, gap_m=SETTINGS.gap_m, rng=np.random.default_rng(0)
    )
    assert sum(len(s.points) for s in sectors) == len(free.points)
    for sector in sectors:
        bearing = np.arctan2(sector.points[:, 1], sector.points[:, 0])
        assert (np.abs(bearing) <= sector.width_rad / 2 + 1e-6).all()


def test_a_negative_seed_is_refused() -> None:
    points, occupied = np.eye(3), np.array([True, False, True])
    with pytest.raises(SettingsError, match="seed"):
        learn_kernels(points, occupied, LearningSettings(), seed=-1)
    with pytest.raises(SettingsError, match="seed"):
        learn_atoms(_scan(), "a", LearningSettings(), {}, seed=-1)


def test_no_scans_are_refused() -> None:
    with pytest.raises(EmptyError, match="no scans"):
        learn_atoms([], "a", SETTINGS, {})


def test_every_epoch_of_every_sector_is_told() -> None:
    told: list[SectorEpoch] = []
    atoms = learn_atoms(_scan(), "room", SETTINGS, {}, on_epoch=told.append)
    assert [at.sector for at in told] == sorted(at.sector for at in told)
    assert {at.sector for at in told} == {0, 1, 3}
    for atom in atoms:
        own = [at.epoch for at in told if at.sector == int(atom.provenance["sector"])]
        assert [epoch.epoch for epoch in own] == list(range(int(atom.provenance["learner_epochs"]) + 1))
        np.testing.assert_array_equal(own[-1].hinge, atom.kernels.hinge_mean)
        assert f"{own[-1].objective:.4f}" == atom.provenance["nats_per_point"]


def _failing_in_sector(number: int) -> Callable[..., AbhmPosterior]:
    def learn(*args, seed: int, **options) -> AbhmPosterior:
        if seed % SETTINGS.n_sectors == number:
            raise SolverError("diverged")
        return learn_kernels(*args, seed=seed, **options)

    return learn


def test_a_sector_that_diverges_makes_no_atom_and_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning, "learn_kernels", _failing_in_sector(1))
    failed: list[tuple[int, SolverError]] = []
    atoms = learn_atoms(
        _scan(), "room", SETTINGS, {}, seed=2, on_failure=lambda number, error: failed.append((number, error))
    )
    assert [a.atom_id for a in atoms] == ["room-s0", "room-s3"]
    assert [number for number, _ in failed] == [1]
    assert "diverged" in str(failed[0][1])
    with pytest.raises(SolverError, match="diverged"):
        learn_atoms(_scan(), "room", SETTINGS, {})


def test_no_more_points_and_kernels_than_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    given = {}

    def fit(points, occupied, start, options, **more) -> None:
        given.update(points=points, occupied=occupied, hinge=start.hinge, options=options, **more)

    monkeypatch.setattr(learning, "fit_abhm", fit)
    rng = np.random.default_rng(0)
    points, occupied = rng.uniform(-5, 5, (1_000, 3)), rng.random(1_000) < 0.3
    learn_kernels(points, occupied, SETTINGS, seed=5)
    assert given["points"].shape == (400, 3)
    assert len(given["hinge"]) <= 40
    order = {tuple(p): o for p, o in zip(points.tolist(), occupied.tolist(), strict=True)}
    assert [order[tuple(p)] for p in given["points"].tolist()] == given["occupied"].tolist(), (
        "labels stay with points"
    )
    np.testing.assert_array_equal(given["sample_weight"], beam_weights(given["occupied"], 3))
    first = given["points"]
    learn_kernels(points, occupied, SETTINGS, seed=6)
    assert not np.array_equal(first, given["points"])
    learn_kernels(points[:120], occupied[:120], SETTINGS)
    assert given["points"].shape == (120, 3)
    assert len(given["hinge"]) <= 15, "eight points a kernel"


def test_the_learners_settings_are_passed_on() -> None:
    changed = {
        "weight_var": 7.0,
        "hinge_reach": 0.3,
        "gamma_shape": 9.0,
        "max_epochs": 3,
        "dispersion_epochs": 2,
        "steps": 5,
        "batch": 11,
        "learning_rate": 0.02,
    }
    assert LearningSettings(**changed).abhm == AbhmOptions(**changed)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"n_sectors": 0}, "n_sectors"),
        ({"free_per_beam": 0}, "free_per_beam"),
        ({"max_labelled": 0}, "max_labelled"),
        ({"max_points": 0}, "max_points"),
        ({"max_kernels": 0}, "max_kernels"),
        ({"points_per_kernel": 0}, "points_per_kernel"),
        ({"min_range_m": -1.0}, "min_range_m"),
        ({"min_range_m": 5.0, "max_range_m": 5.0}, "max_range_m"),
        ({"max_range_m": float("nan")}, "max_range_m"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change: dict, text: str) -> None:
    with pytest.raises(SettingsError, match=text):
        LearningSettings(**change)


@pytest.mark.parametrize("free_per_beam", [1, 3, 10])
def test_a_beams_free_samples_count_as_much_as_its_hit(free_per_beam: int) -> None:
    occupied = np.arange(20 * (1 + free_per_beam)) < 20
    weight = beam_weights(occupied, free_per_beam)
    assert weight.dtype == np.float32
    assert weight.mean() == pytest.approx(1.0, rel=1e-6)
    assert weight[occupied].sum() == pytest.approx(weight[~occupied].sum(), rel=1e-5)
    assert len(np.unique(weight)) == (1 if free_per_beam == 1 else 2)
    only = beam_weights(np.zeros(5, bool), free_per_beam)
    np.testing.assert_allclose(only, 1.0, rtol=1e-6)


@pytest.mark.parametrize("n_kernels", [10, 40, 300])
@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
@pytest.mark.parametrize("centre", [0.0, 5e6], ids=["at the origin", "far off"])
def test_a_lattice_is_as_fine_as_its_kernels_allow(n_kernels: int, planar: bool, centre: float) -> None:
    rng = np.random.default_rng(n_kernels)
    points = rng.uniform([0.0, -6.0, -1.0], [12.0, 6.0, 3.0], (2_000, 3)) + centre
    if planar:
        points[:, 2] = 1.3
    hinge, gamma = lattice(points, n_kernels)
    assert hinge.shape == (len(gamma), 3)
    assert 0.5 * n_kernels <= len(hinge) <= n_kernels
    assert len(np.unique(hinge, axis=0)) == len(hinge)
    assert len(np.unique(gamma)) == 1
    length = 1.0 / math.sqrt(2.0 * gamma[0])
    away = np.abs(points[:, None] - hinge).max(axis=2)
    assert (away.min(axis=1) <= 0.5 * length + 1e-6).all(), "every point lies in a kernel's cell"
    assert (away.min(axis=0) <= 0.5 * length + 1e-6).all(), "every cell holds a point"
    if planar:
        np.testing.assert_array_equal(hinge[:, 2], 1.3)


@pytest.mark.parametrize("points", [np.full((1, 3), 2.5), np.full((9, 3), -0.3)], ids=["one", "nine alike"])
def test_a_lattice_over_one_place_is_one_kernel_there(points: np.ndarray) -> None:
    hinge, gamma = lattice(points, 5)
    np.testing.assert_array_equal(hinge, points[:1])
    assert np.isfinite(gamma).all()
    assert (gamma > 0).all()


@pytest.mark.parametrize("n_kernels", [1, 2, 3, 7])
def test_a_lattice_never_has_more_kernels_than_wanted(n_kernels: int) -> None:
    """However they lie about the origin, which is where eight cells meet."""
    points = np.random.default_rng(0).normal(0.0, 1.0, (200, 3))
    assert 1 <= len(lattice(points, n_kernels)[0]) <= n_kernels


def test_a_line_of_points_gives_kernels_on_the_line() -> None:
    points = np.zeros((50, 3))
    points[:, 0] = np.linspace(1.0, 9.0, 50)
    hinge, _ = lattice(points, 8)
    assert 4 <= len(hinge) <= 8
    np.testing.assert_array_equal(hinge[:, 1:], 0.0)
