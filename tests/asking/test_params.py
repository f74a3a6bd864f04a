"""Kernels of a map, whole or inside a box."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potschemas.answers import AnswerRule
from potserver.asking.params import Params, ParamsPlan
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError
from potserver.limits import Limits

LIMITS = Limits(max_coordinate_m=1e4)


def _kernels(k: int = 300, seed: int = 0) -> KernelSet:
    rng = np.random.default_rng(seed)
    return KernelSet(
        hinge_mean=rng.uniform(-5, 5, (k, 3)),
        hinge_var=rng.random((k, 3)).astype(np.float32),
        gamma_shape=np.full(k, 10.0, np.float32),
        gamma_rate=np.full(k, 10.0, np.float32),
        weight_mean=rng.normal(size=k).astype(np.float32),
        weight_var=np.ones(k, np.float32),
    )


SNAPSHOT = KernelMap(_kernels(), map_revision=7, rule=AnswerRule(mean_moderation=0.3), threads=1)


def plan_of(lower: list | None = None, upper: list | None = None, part_kernels: int = 20_000) -> ParamsPlan:
    return Params(lower, upper).plan(SNAPSHOT, LIMITS, part_kernels=part_kernels)


@pytest.mark.parametrize("part_kernels", [1, 7, 150, 10_000])
def test_params_come_in_parts_that_add_up(part_kernels: int) -> None:
    plan = plan_of(part_kernels=part_kernels)
    parts = list(plan.parts())
    assert (plan.map_revision, plan.rule) == (7, SNAPSHOT.rule)
    assert all(len(p) <= part_kernels for p in parts)
    joined = KernelSet.concatenate(parts)
    for field in dataclasses.fields(KernelSet):
        np.testing.assert_array_equal(getattr(joined, field.name), getattr(_kernels(), field.name))


def test_params_in_a_box() -> None:
    hinge = _kernels().hinge_mean
    inside = ((hinge >= -1) & (hinge <= 2)).all(axis=1)
    parts = list(plan_of([-1, -1, -1], [2, 2, 2]).parts())
    np.testing.assert_array_equal(KernelSet.concatenate(parts).hinge_mean, hinge[inside])
    assert 0 < inside.sum() < 300
    nothing = plan_of([8, 8, 8], [9, 9, 9]).parts()
    assert [len(p) for p in nothing] == [0], "one empty part, not silence"


@pytest.mark.parametrize("corner", [[np.nan, 0, 0], [0, 0], [1e9, 0, 0]])
def test_params_with_a_bad_corner(corner: list) -> None:
    with pytest.raises((BadPointsError, ShapeError, OutOfRangeError)):
        plan_of(corner)


def test_an_empty_map_answers() -> None:
    plan = Params().plan(KernelMap(KernelSet.empty(), map_revision=1), LIMITS)
    assert ([len(p) for p in plan.parts()], plan.map_revision) == ([0], 1)
