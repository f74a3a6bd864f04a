"""What a scan says next to the faces that it hit: free space just before them, and shadow behind them.

Labels along beams stop `free_gap_m` before a hit, so between there and the face nothing says where free space ends. And
nothing at all is said behind a face, where wide kernels would go on with what they know of the front.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potschemas.answers import AnswerRule
from potserver.numerics import evidence, surface
from potserver.numerics.arrays import Float32, Float64, UInt8
from potserver.numerics.beams import Beams

# A full lattice of kernels sums to an activation of 3.4 (in 2D 2.3), half of it to about half. With less than this a point lies
# beyond the data: wide kernels reach it, and no evidence does.
_OBSERVED_ACTIVATION = 0.8
SHARP_RULE = AnswerRule(observed_activation=_OBSERVED_ACTIVATION, residual_var=50.0, mean_moderation=0.05)


class SharpFaces(NamedTuple):
    """How the overall map is made to end free space at faces, and knowledge behind them (profile `sharp`)."""

    # Clearance of near samples along the face's normal, m. Lower ones sharpen faces and cost held-out ends, which lie on them.
    near_m: tuple[float, float] = (0.03, 0.10)
    near_sigmas: float = 2.0  # of the noise about the face, added to the clearance
    near_weight: float = 0.3  # looks of a near sample
    shadow_m: tuple[float, float] = (0.2, 1.2)  # depth of shadow samples behind the face, along its normal
    coarse_reach: float = 0.7  # spacings: nearer coarse nodes than this get a kernel
    fine_reach: float = 0.9  # the same for fine nodes about hits, so that faces have nodes on both sides


class Samples(NamedTuple):
    """Weighted samples of all kinds, in a region's frame."""

    points: Float64  # (N, 3) m
    kind: UInt8  # (N,) see `evidence`
    weight: Float64 | Float32  # (N,) looks

    @staticmethod
    def concatenate(sets: list[Samples]) -> Samples:
        """All samples, in order."""
        return Samples(*(np.concatenate(parts) for parts in zip(*sets, strict=True)))


def surface_samples(
    beams: Beams,
    origin: Float64,
    known: Float64,
    voxel_m: float,
    sharp: SharpFaces,
    rng: np.random.Generator,
    *,
    planar: bool,
) -> Samples:
    """Near samples and shadows of a scan's hits.

    Args:
        beams: Relative to `origin`.
        origin: (3,) m, in the region's frame.
        known: (R, 3) m, hit rows of the map there: the scan alone may be too sparse to show how a face lies.
        voxel_m: Edge of the voxels whose hits share a normal.
        sharp: Clearances, depths and weights.
        rng: Of the draws.
        planar: Faces are upright, as seen by a planar sensor.
    """
    ends = beams.ends[beams.is_return]
    if len(ends) == 0:
        return Samples(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0))
    rays = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    faces = surface.normals(ends, rays, known - origin, voxel_m, planar=planar)
    low, high = sharp.near_m
    near, _ = surface.near_free(
        ends, np.zeros(3), faces, low_m=low, high_m=high, sigmas=sharp.near_sigmas, rng=rng
    )
    low, high = sharp.shadow_m
    shadow = surface.behind(ends, faces, low_m=low, high_m=high, rng=rng)
    return Samples(
        np.concatenate([near, shadow]) + origin,
        np.repeat(np.array([evidence.NEAR, evidence.SHADOW], np.uint8), [len(near), len(shadow)]),
        np.repeat([sharp.near_weight, 1.0], [len(near), len(shadow)]),
    )
