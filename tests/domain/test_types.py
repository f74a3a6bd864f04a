"""The nouns refuse what they cannot be."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potserver.domain.types import KernelSet, Scan, check_rigid, yaw_pose
from potserver.errors import BadPointsError, BadPoseError, EmptyError, ShapeError


def _scan(**changes) -> Scan:
    fields = {
        "robot_id": "r", "seq": 1, "stamp_ns": 2, "points": np.ones((4, 3), np.float32), "is_return": np.ones(4, bool),
        "T_map_sensor": yaw_pose(1.0, 2.0, 0.3, 4.0),
    }  # fmt: skip
    return Scan(**(fields | changes))


def _kernels(k: int = 5) -> KernelSet:
    rng = np.random.default_rng(0)
    return KernelSet(
        hinge_mean=rng.normal(size=(k, 3)),
        hinge_var=rng.random((k, 3)).astype(np.float32),
        gamma_shape=np.full(k, 6.0, np.float32),
        gamma_rate=np.full(k, 3.0, np.float32),
        weight_mean=np.arange(k, dtype=np.float32),
        weight_var=np.ones(k, np.float32),
    )


def test_a_scan_knows_where_its_beams_start() -> None:
    np.testing.assert_array_equal(_scan().origin, [1, 2, 4])
    assert not _scan().is_planar


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"points": np.ones((4, 2), np.float32)}, ShapeError),
        ({"points": np.ones(12, np.float32)}, ShapeError),
        ({"is_return": np.ones(3, bool)}, ShapeError),
        ({"T_map_sensor": np.eye(3)}, ShapeError),
        ({"points": np.zeros((0, 3), np.float32), "is_return": np.zeros(0, bool)}, EmptyError),
        ({"points": np.full((4, 3), np.nan, np.float32)}, BadPointsError),
        ({"points": np.full((4, 3), np.inf, np.float32)}, BadPointsError),
        ({"T_map_sensor": 2.0 * np.eye(4)}, BadPoseError),
    ],
)
def test_bad_scans(changes: dict, error: type[Exception]) -> None:
    with pytest.raises(error):
        _scan(**changes)


def test_the_count_of_bad_points_is_told() -> None:
    points = np.ones((4, 3), np.float32)
    points[1, 2] = points[3, 0] = np.nan
    with pytest.raises(BadPointsError, match="2 of 4"):
        _scan(points=points)


def _pose(index: tuple[int, int], value: float) -> np.ndarray:
    T = np.eye(4)
    T[index] = value
    return T


@pytest.mark.parametrize(
    "pose",
    [
        _pose((0, 0), 1.01),
        _pose((0, 0), -1.0),
        _pose((0, 1), 0.1),
        _pose((3, 0), 1e-3),
        _pose((3, 3), 2.0),
        _pose((0, 3), np.nan),
        _pose((2, 2), np.inf),
        _pose((1, 1), 1e200),
        np.zeros((4, 4)),
    ],
)
def test_poses_that_are_not_rigid(pose: np.ndarray) -> None:
    with pytest.raises(BadPoseError):
        check_rigid(pose)


def test_rigid_poses_and_small_rounding_pass() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = q * np.linalg.det(q), rng.normal(size=3) * 1e6
        check_rigid(T)
        T[:3, :3] = T[:3, :3].astype(np.float32)
        check_rigid(T)


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(KernelSet)])
def test_kernel_arrays_must_agree(name: str) -> None:
    with pytest.raises(ShapeError, match=name if name != "hinge_mean" else "hinge"):
        _kernels().replace(**{name: getattr(_kernels(4), name)})


def test_gamma_is_the_mean_of_its_distribution() -> None:
    np.testing.assert_allclose(_kernels().gamma, 2.0)


def test_taking_and_joining_keep_all_ten_numbers() -> None:
    kernels = _kernels()
    back = KernelSet.concatenate(
        [kernels.take(slice(0, 2)), kernels.take(np.array([2, 3])), kernels.take(np.arange(5) == 4)]
    )
    for field in dataclasses.fields(KernelSet):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(kernels, field.name))
        assert getattr(back, field.name).dtype == getattr(kernels, field.name).dtype
    assert len(KernelSet.concatenate([])) == len(KernelSet.empty()) == 0


def test_nouns_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        _scan().seq = 5
    with pytest.raises(dataclasses.FrozenInstanceError):
        _kernels().weight_mean = np.zeros(5)
