"""A scene as it might have been elsewhere: made-up towns are level, solid and all of one size, and real places are not.

What is drawn once for a scene holds for all of its beams, whichever scan they belong to: the scene is stretched, things that
beams may or may not pass (leaves, fences, nets) stand in it, and its ground rises, falls and has steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.domain.types import Float64
from potserver.numerics.beams import Beams

_PLAIN = 0.1  # of all scenes are left as they are
_STRETCH = (0.15, 0.15)  # standard deviation of the logarithm of what is across, and upwards
_NOISE_M = 0.04  # of a range, at most
_PLANTS, _WITHIN_M = 20, 25.0  # of them in a scene, about; how far away
_RADIUS_M, _HEIGHT_M = (0.3, 2.0), (-1.5, 2.5)  # of a plant; of its middle, above the sensor
_FREE_PATH = (-0.3, 1.5)  # mean and standard deviation of the logarithm of the m that a beam goes in it
_CLEAR_M = 0.5  # about the sensor
_WAVES, _LENGTH_M = 6, (4.0, 60.0)  # of a ground
_SLOPE, _STEP_M = 0.08, 0.08  # of a ground: at most; standard deviation


class Variation(NamedTuple):
    """What is other about a scene. Frame: the map's axes, about the place of a scan."""

    stretch: Float64  # (3,)
    centers: Float64  # (P, 3) m, of plants
    radii: Float64  # (P,) m
    free_path: Float64  # (P,) m, mean
    waves: Float64  # (W, 2) rad/m
    phases: Float64  # (W,) rad
    swell: Float64  # (W,) m, height of a wave
    steps: Float64  # (W,) m, half the height of its steps
    noise_m: float  # standard deviation of a range

    def seen(self, beams: Beams, eye: Float64, rng: np.random.Generator) -> tuple[Beams, Float64]:
        """What beams from an eye, (3,) m, meet, and the eye where it is now; `lifted` is still to come."""
        eye = eye * self.stretch
        along = beams.ends * self.stretch - eye
        length = np.linalg.norm(along, axis=1)
        unit = along / np.maximum(length, 1e-9)[:, None]
        stop = length.copy()
        for center, radius, path in zip(self.centers - eye, self.radii, self.free_path, strict=True):
            middle = unit @ center
            reach = middle**2 - center @ center + radius**2
            through = np.flatnonzero((reach > 0) & (middle > 0))
            half = np.sqrt(reach[through])
            at = np.maximum(middle[through] - half, 0.0) + rng.exponential(path, len(through))
            met = at < middle[through] + half
            stop[through[met]] = np.minimum(stop[through[met]], at[met])
        is_return = beams.is_return | (stop < length)
        stop = np.maximum(stop + is_return * rng.normal(0.0, self.noise_m, len(stop)), 0.0)
        return Beams(eye + unit * stop[:, None], is_return), eye

    def lifted(self, points: Float64) -> Float64:
        """(N, 3) points with the ground below them."""
        out = points.copy()
        out[:, 2] += self._height(points[:, :2]) - self._height(np.zeros((1, 2)))
        return out

    def _height(self, places: Float64) -> Float64:
        wave = np.sin(places @ self.waves.T + self.phases)
        return np.asarray(wave @ self.swell + np.sign(wave) @ self.steps)


AS_IT_IS = Variation(
    np.ones(3), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0), 0.0
)  # fmt: skip


def draw_variation(rng: np.random.Generator) -> Variation:
    """Another scene; some are as they were."""
    if rng.random() < _PLAIN:
        return AS_IT_IS
    across, up = np.exp(rng.normal(0.0, _STRETCH))
    n = rng.poisson(_PLANTS * rng.uniform(0.0, 2.0))
    away, turn = _WITHIN_M * np.sqrt(rng.random(n)), rng.uniform(0.0, 2 * np.pi, n)
    centers = np.column_stack([away * np.cos(turn), away * np.sin(turn), rng.uniform(*_HEIGHT_M, n)])
    radii, free_path = rng.uniform(*_RADIUS_M, n), np.exp(rng.normal(*_FREE_PATH, n))
    kept = away > radii + _CLEAR_M
    shortest, longest = (float(np.log(length)) for length in _LENGTH_M)
    number = 2 * np.pi / np.exp(rng.uniform(shortest, longest, _WAVES))
    turn = rng.uniform(0.0, 2 * np.pi, _WAVES)
    slope = rng.uniform(0.0, _SLOPE)  # of all waves together, root mean square
    swell = rng.normal(0.0, slope * np.sqrt(2.0 / _WAVES), _WAVES) / number
    steps = rng.normal(0.0, _STEP_M / np.sqrt(_WAVES), _WAVES) * (rng.random(_WAVES) < 0.5)
    return Variation(
        stretch=np.array([across, across, up]),
        centers=centers[kept],
        radii=radii[kept],
        free_path=free_path[kept],
        waves=number[:, None] * np.column_stack([np.cos(turn), np.sin(turn)]),
        phases=rng.uniform(0.0, 2 * np.pi, _WAVES),
        swell=swell,
        steps=steps,
        noise_m=float(rng.uniform(0.0, _NOISE_M)),
    )
