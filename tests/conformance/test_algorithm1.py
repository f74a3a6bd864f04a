"""Algorithm 1 from a scan to its kernels, and what transport carries along (rows C10, C23, A14, A15)."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import KernelSet, Scan, yaw_pose
from potserver.mapping.dispersions import integrated_out
from potserver.mapping.matching import Match
from potserver.mapping.paper import PAPER
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.mapping.transport import CouplingOptions, transport
from potserver.numerics.beams import Beams, label_beams
from potserver.numerics.geometry import rotation_z
from tests.conformance import reference

N_HITS = 45


def _source(seed: int, dims: int) -> np.ndarray:
    """Hits within 30 degrees of the x axis, 1.5 m apart: no filter drops one, and no entropy blurs one into the next."""
    rng = np.random.default_rng(seed)
    height = (0.0, 0.0) if dims == 2 else (-1.0, 3.0)
    shape = rng.uniform(0.4, 1.0, 2)  # so that atoms differ
    low, high = (4.0, -9.0 * shape[0], height[0]), (8.0 + 10.0 * shape[1], 9.0 * shape[0], height[1])
    points = reference.spaced(rng, 4 * N_HITS, low, high, 1.5)
    return points[np.abs(np.arctan2(points[:, 1], points[:, 0])) < math.radians(30)][:N_HITS]


@functools.cache
def _atom(number: int, dims: int):
    hits = _source(number, dims)
    rng = np.random.default_rng(50 + number)
    beams = Beams(hits.astype(np.float64), np.ones(len(hits), bool))
    labelled = label_beams(beams, free_per_beam=2, gap_m=0.3, rng=rng)
    kernels = reference.kernels_at(hits + rng.normal(0.0, 0.2, hits.shape) * [1, 1, dims == 3], rng)
    return reference.atom(f"a{number}", hits, labelled.points[~labelled.occupied], kernels, dims=dims)


@pytest.mark.parametrize("turn_deg", [45.0, -90.0, 0.0])
@pytest.mark.parametrize("dims", [2, 3])
def test_algorithm1_finds_the_atom_that_a_scan_was_made_from(dims: int, turn_deg: float) -> None:
    atoms = [_atom(i, dims) for i in range(5)]
    chosen = atoms[3]
    turn = math.radians(turn_deg)
    pose = yaw_pose(120.0, -40.0, turn, 0.0 if dims == 2 else 1.7)
    scan = Scan(
        robot_id="r", seq=0, stamp_ns=0, points=chosen.hit_points, is_return=np.ones(len(chosen.hit_points), bool),
        T_map_sensor=pose, is_planar=dims == 2,
    )  # fmt: skip
    service = MappingService(AtomDictionary(tuple(atoms)), MappingSettings.of_profile("paper"), threads=2)
    update = service.integrate(scan)
    served = [s for s in update.sectors if s.atom_id is not None]
    assert len(served) == 1, "all hits lie in one sector"
    assert served[0].atom_id == chosen.atom_id
    assert served[0].rotation_rad == pytest.approx(turn)
    assert served[0].converged
    truth = chosen.kernels.hinge_mean @ pose[:3, :3].T + pose[:3, 3]
    assert len(update.kernels) == len(truth)
    distance = np.linalg.norm(update.kernels.hinge_mean[:, None] - truth, axis=2)
    wanted, order = np.arange(len(truth)), distance.argmin(axis=0)
    off = distance.min(axis=0)
    assert off.max() < 0.05, off.max()
    # row C10: ten numbers a kernel go along, the dispersion of the position turns with it, and dispersions enter the answers
    R = rotation_z(turn)
    turned = np.stack([np.diag(R @ np.diag(v) @ R.T) for v in chosen.kernels.hinge_var.astype(np.float64)])
    np.testing.assert_allclose(update.kernels.hinge_var[order], turned[wanted], rtol=1e-4)
    told = integrated_out(chosen.kernels.replace(hinge_var=turned.astype(np.float32)), planar=dims == 2)
    for name in ("gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_allclose(
            getattr(update.kernels, name)[order], getattr(told, name)[wanted], rtol=1e-5
        )
    # the overall map is what was carried, no more and no less
    assert len(service.snapshot) == len(truth)


def test_row_c10_ten_numbers_a_kernel() -> None:
    sizes = {
        f.name: getattr(reference.kernels_at(np.zeros((4, 3)), np.random.default_rng(0)), f.name).size // 4
        for f in dataclasses.fields(KernelSet)
    }
    assert sum(sizes.values()) == 10, sizes


def _ring_atom():
    """Hits in the sector; kernels at every bearing, inside and outside the radius."""
    hits = reference.spaced(np.random.default_rng(0), 30, (6, -5, 0), (14, 5, 2), 1.0)
    angle, radius = np.meshgrid(np.deg2rad(np.arange(0, 360, 15) + 1.0), [5.0, 12.0, 19.0, 23.0])
    ring = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], axis=-1).reshape(-1, 3)
    return reference.atom("ring", hits, hits * 0.5, reference.kernels_at(ring, np.random.default_rng(1)))


def test_row_a14_the_paper_crops_to_a_full_circle_about_the_sensor() -> None:
    atom = _ring_atom()
    sector = reference.sector(atom.hit_points, atom.free_points)
    carried = transport(Match(atom, 0.0, 0.0), sector, PAPER.coupling, seed=0)
    assert carried.converged
    radius = np.hypot(carried.kernels.hinge_mean[:, 0], carried.kernels.hinge_mean[:, 1])
    bearing = np.arctan2(carried.kernels.hinge_mean[:, 1], carried.kernels.hinge_mean[:, 0])
    assert radius.max() <= 20.0
    assert len(carried.kernels) == 72, "three of the four rings, all around"
    assert (np.abs(bearing) > math.pi / 2).sum() > 30


def test_the_default_profile_crops_to_the_sector() -> None:
    atom = _ring_atom()
    sector = reference.sector(atom.hit_points, atom.free_points)
    carried = transport(Match(atom, 0.0, 0.0), sector, CouplingOptions(), seed=0)
    bearing = np.arctan2(carried.kernels.hinge_mean[:, 1], carried.kernels.hinge_mean[:, 0])
    assert 9 <= len(carried.kernels) <= 18
    assert np.abs(bearing).max() <= math.radians(36.0)


def test_row_c10_transport_carries_all_ten_numbers() -> None:
    atom = _atom(1, 3)
    sector = reference.sector(atom.hit_points, atom.free_points)
    carried = transport(Match(atom, 0.0, 0.0), sector, PAPER.coupling, seed=0)
    for name in ("hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(getattr(carried.kernels, name), getattr(atom.kernels, name))
