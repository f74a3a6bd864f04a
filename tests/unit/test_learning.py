"""Atoms from scans."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Scan, yaw_pose
from potserver.errors import EmptyError, SettingsError
from potserver.numerics.geometry import rotation_z
from potserver.services.learning import LearningSettings, choose_diverse, learn_atoms
from tests.conformance import reference

SETTINGS = LearningSettings(
    n_sectors=4, max_labelled=400, min_hits=20, fine_m=1.0, coarse_m=3.0, prior_vars=(10.0, 100.0)
)


@functools.cache
def _learned(planar: bool = False, yaw: float = 0.0) -> tuple:
    return tuple(learn_atoms(_scan(planar, yaw), "room", SETTINGS, {"source": "test"}))


def _scan(planar: bool = False, yaw: float = 0.0, seed: int = 0, n: int = 400) -> Scan:
    """An ellipse of walls about the sensor; nothing behind it."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-0.6 * np.pi, 0.6 * np.pi, n)
    z = np.zeros(n) if planar else rng.uniform(-1, 2, n)
    points = np.stack([7.0 * np.cos(angle), 5.0 * np.sin(angle), z], axis=1).astype(np.float32)
    return Scan(
        robot_id="r", seq=0, stamp_ns=0, points=points, is_return=np.ones(n, bool),
        T_map_sensor=yaw_pose(30.0, -8.0, yaw), is_planar=planar,
    )  # fmt: skip


@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
def test_an_atom_for_every_sector_with_enough_hits(planar: bool) -> None:
    atoms = _learned(planar)
    assert [a.atom_id for a in atoms] == ["room-s0", "room-s1", "room-s3"], "nothing was seen behind"
    for atom in atoms:
        assert atom.dims == (2 if planar else 3)
        assert atom.azimuth_width_rad == pytest.approx(math.pi / 2)
        assert atom.radius_m == SETTINGS.max_range_m
        assert atom.provenance["source"] == "test"
        for points in (atom.hit_points, atom.free_points):
            bearing = np.arctan2(points[:, 1], points[:, 0])
            assert (np.abs(bearing) <= math.pi / 4 + 1e-6).all(), "x runs along the bisector"
            assert 0 < len(points) <= SETTINGS.max_points
            if planar:
                np.testing.assert_array_equal(points[:, 2], 0.0)
        kernels = atom.kernels
        assert (kernels.weight_var > 0).all()
        assert (kernels.gamma > 0).all()


def test_an_atoms_kernels_know_its_own_walls() -> None:
    for atom in _learned():
        kernels = KernelMap(atom.kernels)
        hits, free = kernels.occupancy(atom.hit_points).mean, kernels.occupancy(atom.free_points).mean
        assert hits.mean() > 0.75
        assert free.mean() < 0.3
        # row C12: weights are high where hits are
        at_wall = np.linalg.norm(atom.kernels.hinge_mean[:, None] - atom.hit_points, axis=2).min(axis=1) < 0.5
        weight = atom.kernels.weight_mean
        assert weight[at_wall].mean() > weight[~at_wall].mean()


def test_row_c12_variance_is_high_where_little_was_seen() -> None:
    atom = _learned()[0]
    points = np.concatenate([atom.hit_points, atom.free_points])
    d2 = np.square(atom.kernels.hinge_mean[:, None] - points).sum(axis=2)
    seen = np.exp(-atom.kernels.gamma.astype(np.float64)[:, None] * d2).sum(axis=1)
    order = np.argsort(seen)
    third = len(order) // 3
    assert np.median(atom.kernels.weight_var[order[:third]]) > 2 * np.median(
        atom.kernels.weight_var[order[-third:]]
    )


def test_the_heading_of_the_sensor_turns_nothing_inside_an_atom() -> None:
    straight, turned = _learned(), _learned(yaw=1.1)
    for one, other in zip(straight, turned, strict=True):
        assert one.hit_points.shape == pytest.approx(other.hit_points.shape, rel=0.1)
        np.testing.assert_allclose(one.hit_points.mean(axis=0), other.hit_points.mean(axis=0), atol=0.3)


def test_the_same_seed_learns_the_same_atoms() -> None:
    one, other = _learned(), learn_atoms(_scan(), "room", SETTINGS, {})
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.kernels.weight_mean, b.kernels.weight_mean)
        np.testing.assert_array_equal(a.free_points, b.free_points)


def test_the_evidence_chooses_the_prior() -> None:
    choices = (0.01, 30.0)
    each = [
        learn_atoms(_scan(), "a", dataclasses.replace(SETTINGS, prior_vars=(v,)), {})[0].provenance
        for v in choices
    ]
    together = learn_atoms(_scan(), "a", dataclasses.replace(SETTINGS, prior_vars=choices), {})[0].provenance
    evidence = [float(p["log_evidence_per_point"]) for p in each]
    assert float(together["prior_var"]) == choices[int(np.argmax(evidence))]
    assert float(together["log_evidence_per_point"]) == max(evidence)
    assert max(evidence) > min(evidence) + 0.01


def test_too_few_hits_make_no_atom() -> None:
    assert learn_atoms(_scan(n=30), "a", SETTINGS, {}) == []


def _shapes():
    rng = np.random.default_rng(0)
    base = reference.spaced(rng, 40, (2, -5, -1), (10, 5, 2), 0.8)
    turned = (base @ rotation_z(math.pi / 2).T).astype(np.float32)
    return [
        reference.atom(name, hits, hits * 0.5)
        for name, hits in (
            ("a0", base),
            ("a1", base + np.float32(0.01)),
            ("a2", base * [1.7, 0.3, 1.0]),
            ("a3", turned * 2),
        )
    ]


def test_diverse_choice_takes_the_unlike_and_leaves_the_double() -> None:
    chosen = [a.atom_id for a in choose_diverse(_shapes(), 3)]
    assert chosen == sorted(chosen)
    assert {"a2", "a3"} < set(chosen)
    assert len({"a0", "a1"} & set(chosen)) == 1
    assert isinstance(choose_diverse(_shapes(), 1), AtomDictionary)


def test_diverse_choice_of_more_than_there_are() -> None:
    assert len(choose_diverse(_shapes(), 99, threads=2)) == 4


def test_diverse_choice_of_nothing() -> None:
    with pytest.raises(EmptyError):
        choose_diverse([], 3)
    with pytest.raises(SettingsError):
        choose_diverse(_shapes(), 0)
