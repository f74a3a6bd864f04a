"""What a scan says next to the faces that it hit: free space just before them, and shadow behind them.

Labels along beams stop `free_gap_m` before a hit, so between there and the face nothing says where free space ends. And
nothing at all is said behind a face, where wide kernels would go on with what they know of the front.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.numerics import evidence, surface
from potserver.numerics.arrays import Bool, Float32, Float64, UInt8
from potserver.numerics.beams import Beams


class FaceSamples(NamedTuple):
    """How the overall map is made to end free space at faces, and knowledge behind them."""

    # Clearance of near samples along the face's normal, m. Lower ones sharpen faces and cost held-out ends, which lie on them.
    near_m: tuple[float, float] = (0.03, 0.10)
    near_sigmas: float = 2.0  # of the noise about the face, added to the clearance
    near_weight: float = 0.3  # looks of a near sample
    shadow_m: tuple[float, float] = (0.1, 1.2)  # depth of shadow samples behind the face, along its normal


FACE_SAMPLES = FaceSamples()


class Samples(NamedTuple):
    """Weighted samples of all kinds, in a region's frame."""

    points: Float64  # (N, 3) m
    kind: UInt8  # (N,) see `evidence`
    weight: Float64 | Float32  # (N,) looks

    def take(self, index: Bool) -> Samples:
        """The samples that a mask picks."""
        return Samples(self.points[index], self.kind[index], self.weight[index])

    @staticmethod
    def concatenate(sets: list[Samples]) -> Samples:
        """All samples, in order."""
        return Samples(*(np.concatenate(parts) for parts in zip(*sets, strict=True)))


def faces_of(
    beams: Beams, origin: Float64, known: Float64, voxel_m: float, *, planar: bool
) -> surface.Normals:
    """The faces that a scan's H hits lie on.

    Args:
        beams: Relative to `origin`.
        origin: (3,) m, in the region's frame.
        known: (R, 3) m, hit rows of the map there: the scan alone may be too sparse to show how a face lies.
        voxel_m: Edge of the voxels whose hits share a normal.
        planar: Faces are upright, as seen by a planar sensor.
    """
    ends = beams.ends[beams.is_return]
    rays = ends / np.linalg.norm(ends, axis=1, keepdims=True)
    return surface.normals(ends, rays, known - origin, voxel_m, planar=planar)


def surface_samples(
    beams: Beams, origin: Float64, faces: surface.Normals, how: FaceSamples, rng: np.random.Generator
) -> Samples:
    """Near samples and shadows of a scan's hits.

    Args:
        beams: Relative to `origin`.
        origin: (3,) m, in the region's frame.
        faces: Of the hits.
        how: Clearances, depths and weights.
        rng: Of the draws.
    """
    ends = beams.ends[beams.is_return]
    if len(ends) == 0:
        return Samples(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0))
    low, high = how.near_m
    near, _ = surface.near_free(
        ends, np.zeros(3), faces, low_m=low, high_m=high, sigmas=how.near_sigmas, rng=rng
    )
    low, high = how.shadow_m
    shadow = surface.behind(ends, faces, low_m=low, high_m=high, rng=rng)
    return Samples(
        np.concatenate([near, shadow]) + origin,
        np.repeat(np.array([evidence.NEAR, evidence.SHADOW], np.uint8), [len(near), len(shadow)]),
        np.repeat([how.near_weight, 1.0], [len(near), len(shadow)]),
    )
