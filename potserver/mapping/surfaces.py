"""What a scan says next to the faces that it hit: free space just before them, and shadow behind them.

Labels along beams stop `free_gap_m` before a hit, so between there and the face nothing says where free space ends. And
nothing at all is said behind a face, where wide kernels would go on with what they know of the front.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.numerics import surface
from potserver.numerics.arrays import Bool, Float32, Float64, UInt8
from potserver.numerics.beams import Beams
from potserver.numerics.detail import angles_between, scales_of
from potserver.numerics.evidence import NEAR, SHADOW, kind_of

_NORMAL_VOXELS = 0.5  # resolutions: hits that lie so near to each other share a normal
_LEAST_COSINE = 0.1  # of incidence: below it beams lie as far apart as there
# Voxels of hits are no finer than the beams and the noise: two beams end on each, and its edge is so many standard deviations.
_VOXEL_OF_BEAMS, _VOXEL_OF_NOISE = 1.4, 8.0


class FaceSamples(NamedTuple):
    """How the overall map is made to end free space at faces, and knowledge behind them."""

    # Clearance of near samples along the face's normal, m. Lower ones sharpen faces and cost held-out ends, which lie on them.
    near_m: tuple[float, float] = (0.04, 0.08)
    near_sigmas: float = 1.0  # of the noise about the face, added to the clearance where a plane is known
    near_weight: float = 0.3  # looks of a near sample
    beside_weight: float = 0.5  # looks of free space beside the hits of a voxel, of all beams that pass them
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


class Hits(NamedTuple):
    """The H hits of a scan."""

    ends: Float64  # (H, 3) m, relative to the beams' start
    faces: surface.Normals  # that they lie on
    scale: UInt8  # (H,) how often the map's resolution is halved for them


def hits_of(
    beams: Beams, origin: Float64, known: Float64, fine_m: float, n_scales: int, *, planar: bool
) -> Hits:
    """The hits of a scan, the faces that they lie on, and the detail that they show.

    Args:
        beams: Relative to `origin`.
        origin: (3,) m, in the region's frame.
        known: (R, 3) m, hit rows of the map there: the scan alone may be too sparse to show how a face lies.
        fine_m: The map's resolution.
        n_scales: That the map has.
        planar: Faces are upright, as seen by a planar sensor.
    """
    ends = beams.ends[beams.is_return]
    length = np.linalg.norm(ends, axis=1)
    faces = surface.normals(
        ends, ends / length[:, None], known - origin, _NORMAL_VOXELS * fine_m, planar=planar
    )
    if n_scales == 1:
        return Hits(ends, faces, np.zeros(len(ends), np.uint8))
    apart_m = angles_between(beams.ends, planar=planar)[beams.is_return] * length
    shown_m = np.maximum(
        _VOXEL_OF_BEAMS * apart_m / np.maximum(faces.cosine, _LEAST_COSINE), _VOXEL_OF_NOISE * faces.sigma_m
    )
    return Hits(ends, faces, scales_of(shown_m, fine_m, n_scales))


def surface_samples(hits: Hits, origin: Float64, how: FaceSamples, rng: np.random.Generator) -> Samples:
    """Near samples and shadows of a scan's hits, as fine as these.

    Args:
        hits: Relative to `origin`.
        origin: (3,) m, in the region's frame.
        how: Clearances, depths and weights.
        rng: Of the draws.
    """
    ends, faces, scale = hits
    if len(ends) == 0:
        return Samples(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0))
    low, high = how.near_m
    near, of_hit = surface.near_free(
        ends, np.zeros(3), faces, low_m=low, high_m=high, sigmas=how.near_sigmas, rng=rng
    )
    low, high = how.shadow_m
    shadow = surface.behind(ends, faces, low_m=low, high_m=high, rng=rng)
    return Samples(
        np.concatenate([near, shadow]) + origin,
        np.concatenate([kind_of(NEAR, scale[of_hit]), kind_of(SHADOW, scale)]),
        np.repeat([how.near_weight, 1.0], [len(near), len(shadow)]),
    )
