"""Out-of-sample maps on couplings whose answer is plain. Against POT: tests/conformance/test_out_of_sample.py."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.coupling import couple
from potserver.numerics.displacement import OutOfSample, barycentric_images, carry, rigid_map
from potserver.numerics.geometry import rotation_z

RNG = np.random.default_rng(0)
# far apart, so that no entropy blurs one into the next
SOURCE = (
    np.stack(np.meshgrid([0.0, 4.0, 8.0], [0.0, 5.0], [0.0, 3.0]), axis=-1).reshape(-1, 3).astype(np.float32)
)
SHIFT = np.float32([0.5, -0.75, 0.25])
KERNELS = RNG.uniform(-2, 10, (40, 3))


@pytest.mark.parametrize("method", [OutOfSample.NEAREST, OutOfSample.LINEAR, OutOfSample.RIGID])
def test_a_translation_moves_every_kernel_by_it(method: OutOfSample) -> None:
    target = (SOURCE + SHIFT)[::-1].copy()
    moved = carry(KERNELS, SOURCE, target, couple(SOURCE, target, reg=1e-4), method)
    np.testing.assert_allclose(moved, KERNELS + SHIFT, atol=5e-3)


def test_entropic_sends_source_points_to_their_images() -> None:
    target = SOURCE + SHIFT
    coupling = couple(SOURCE, target, reg=0.01, tolerance=1e-5)
    moved = carry(SOURCE.astype(np.float64), SOURCE, target, coupling, OutOfSample.ENTROPIC)
    np.testing.assert_allclose(moved, barycentric_images(coupling, target), atol=1e-3)


def test_entropic_stays_inside_the_target_however_far_the_kernel() -> None:
    coupling = couple(SOURCE, SOURCE, reg=0.01)
    moved = carry(np.array([[1e4, 0, 0], [-1e6, 1e6, 0.0]]), SOURCE, SOURCE, coupling, OutOfSample.ENTROPIC)
    assert np.isfinite(moved).all()
    assert (moved >= SOURCE.min(axis=0) - 1e-6).all()
    assert (moved <= SOURCE.max(axis=0) + 1e-6).all()


def test_nearest_uses_the_nearest_source_point_alone() -> None:
    target = SOURCE.copy()
    target[-1] += np.float32([0, 0, 2])
    coupling = couple(SOURCE, target, reg=1e-4)
    kernels = np.stack([SOURCE[-1] + 0.3, SOURCE[0] + 0.3]).astype(np.float64)
    moved = carry(kernels, SOURCE, target, coupling, OutOfSample.NEAREST) - kernels
    np.testing.assert_allclose(moved, [[0, 0, 2], [0, 0, 0]], atol=2e-2)


def test_a_rigid_map_turns_and_shifts_and_never_stretches_or_mirrors() -> None:
    turn = rotation_z(0.4)
    rotation, shift = rigid_map(SOURCE.astype(np.float64), SOURCE @ turn.T + SHIFT)
    np.testing.assert_allclose(KERNELS @ rotation + shift, KERNELS @ turn.T + SHIFT, atol=1e-5)
    for images in (2.0 * SOURCE, SOURCE * [1, 1, -1]):
        rotation, _ = rigid_map(SOURCE.astype(np.float64), images.astype(np.float64))
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) > 0


@pytest.mark.parametrize("method", list(OutOfSample))
def test_planar_stays_planar_and_inputs_stay_as_they_are(method: OutOfSample) -> None:
    flat = SOURCE * np.float32([1, 1, 0])
    target = flat[:7] + np.float32([1, 2, 0])
    kernels = KERNELS * [1, 1, 0]
    before = kernels.copy()
    moved = carry(kernels, flat, target, couple(flat, target, reg=0.01), method)
    np.testing.assert_array_equal(moved[:, 2], 0.0)
    np.testing.assert_array_equal(kernels, before)


@pytest.mark.parametrize("method", list(OutOfSample))
def test_no_kernels_no_work(method: OutOfSample) -> None:
    assert carry(np.zeros((0, 3)), SOURCE, SOURCE, couple(SOURCE, SOURCE, reg=0.01), method).shape == (0, 3)


@pytest.mark.parametrize("method", list(OutOfSample))
def test_one_source_point(method: OutOfSample) -> None:
    """One point fixes no linear map; the pull towards the identity leaves a translation."""
    one, target = SOURCE[:1], SOURCE[:1] + SHIFT
    moved = carry(KERNELS, one, target, couple(one, target, reg=0.01), method)
    assert np.isfinite(moved).all()
    if method is not OutOfSample.ENTROPIC:
        np.testing.assert_allclose(moved, KERNELS + SHIFT, atol=1e-5)
