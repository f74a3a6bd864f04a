"""One atom carried to one sector."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from potserver.domain.types import yaw_pose
from potserver.mapping.matching import Match
from potserver.mapping.paper import PAPER
from potserver.mapping.transport import CouplingOptions, transport
from potserver.numerics.displacement import OutOfSample
from tests.conformance import reference

RNG = np.random.default_rng(0)
HITS = reference.spaced(RNG, 25, (6, -4, -1), (14, 4, 3), 1.5)
FREE = HITS * np.float32(0.6)
NONE = np.zeros((0, 3), np.float32)
ATOM = reference.atom("a", HITS, FREE, reference.kernels_at(np.concatenate([HITS, FREE]), RNG))


def _transport(sector, options=PAPER.coupling, atom=ATOM, rotation=0.0):
    return transport(Match(atom, rotation, 0.0), sector, options, seed=0)


def _wide(hits, free):
    return reference.sector(hits, free, half_width_deg=180.0, radius_m=1e3)


@pytest.mark.parametrize("method", [OutOfSample.NEAREST, OutOfSample.LINEAR])
def test_a_sector_that_is_the_atom_elsewhere_gets_its_kernels_there(method: OutOfSample) -> None:
    shift = np.float32([3.0, -2.0, 0.5])
    options = PAPER.coupling._replace(out_of_sample=method)
    carried = _transport(_wide(HITS + shift, FREE + shift), options)
    assert carried.converged
    assert carried.marginal_error <= options.tolerance
    np.testing.assert_allclose(carried.kernels.hinge_mean, ATOM.kernels.hinge_mean + shift, atol=0.05)


def test_the_pose_of_the_sector_is_applied_last() -> None:
    plain = _transport(_wide(HITS, FREE))
    pose = yaw_pose(500_000.0, 4_000_000.0, 1.2, 30.0)
    posed = _transport(dataclasses.replace(_wide(HITS, FREE), T_map_sector=pose))
    np.testing.assert_allclose(
        posed.kernels.hinge_mean, plain.kernels.hinge_mean @ pose[:3, :3].T + pose[:3, 3], atol=1e-6
    )
    np.testing.assert_allclose(
        posed.kernels.hinge_var.sum(axis=1), plain.kernels.hinge_var.sum(axis=1), rtol=1e-5
    )


def test_label_aware_moves_free_space_with_the_free_points() -> None:
    """The free points move up, the hits do not: only kernels of negative weight follow."""
    up = np.float32([0, 0, 2.0])
    sector = _wide(HITS, FREE + up)
    occupied = ATOM.kernels.weight_mean > 0
    aware = (
        _transport(sector, PAPER.coupling._replace(is_label_aware=True)).kernels.hinge_mean
        - ATOM.kernels.hinge_mean
    )
    blind = _transport(sector).kernels.hinge_mean - ATOM.kernels.hinge_mean
    np.testing.assert_allclose(blind, 0.0, atol=0.05)
    np.testing.assert_allclose(aware[occupied], 0.0, atol=0.05)
    np.testing.assert_allclose(aware[~occupied], np.broadcast_to(up, (int((~occupied).sum()), 3)), atol=0.05)


@pytest.mark.parametrize("label_aware", [False, True])
def test_with_one_label_missing_the_other_carries(label_aware: bool) -> None:
    options = PAPER.coupling._replace(is_label_aware=label_aware)
    without_free = _transport(_wide(HITS, NONE), options)
    assert without_free.converged
    assert len(without_free.kernels) == len(ATOM.kernels)
    without_hits = _transport(_wide(NONE, FREE), options)
    assert without_hits.converged
    if label_aware:  # nothing was hit there: the atom's obstacles have no place to go
        free_space = ATOM.kernels.weight_mean[ATOM.kernels.weight_mean <= 0]
        np.testing.assert_array_equal(without_hits.kernels.weight_mean, free_space)
    else:
        assert len(without_hits.kernels) == len(ATOM.kernels)
    no_hits = reference.atom("n", NONE, FREE, ATOM.kernels)
    assert _transport(_wide(HITS, FREE), options, no_hits).converged


def test_nothing_in_common_carries_nothing() -> None:
    carried = _transport(_wide(NONE, FREE), atom=reference.atom("n", HITS, NONE, ATOM.kernels))
    assert not carried.converged
    assert len(carried.kernels) == 0
    assert math.isnan(carried.marginal_error)


def test_a_coupling_that_failed_carries_nothing() -> None:
    options = PAPER.coupling._replace(max_iterations=1, tolerance=1e-9, reg=1e-6)
    carried = _transport(_wide(HITS * 1.5, FREE), options)
    assert not carried.converged
    assert carried.marginal_error > 1e-9
    assert len(carried.kernels) == 0


def test_an_atom_without_kernels_carries_none() -> None:
    assert len(_transport(_wide(HITS, FREE), atom=reference.atom("e", HITS, FREE)).kernels) == 0


def test_the_default_profile_carries_too() -> None:
    carried = _transport(reference.sector(HITS, FREE), CouplingOptions())
    assert carried.converged
    assert 0 < len(carried.kernels) <= len(ATOM.kernels)


def test_the_atom_is_not_touched() -> None:
    before = ATOM.kernels.hinge_mean.copy()
    _transport(_wide(HITS + 5, FREE), rotation=1.0)
    np.testing.assert_array_equal(ATOM.kernels.hinge_mean, before)
