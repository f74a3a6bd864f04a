"""Carry kernels with a coupling: the out-of-sample maps (paper, section III-B and figure "Parameter optimal transport").

A coupling says where the source points go: each to the barycentre of its row. Kernels lie elsewhere, so the map is extended to
them. `nearest`: a kernel moves like the source point next to it (what the authors' code does). `linear`: one affine
map fitted to all source points and their images (the paper's words, Perrot et al. 2016). `entropic`: the map that the dual
potentials define everywhere (Pooladian and Niles-Weed 2021). `rigid`: the turn and shift nearest to the images, all that a
registration could do.
"""

from __future__ import annotations

from enum import Enum

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float32, Float64
from potserver.numerics.coupling import Coupling


class OutOfSample(str, Enum):
    """How a coupling of points is extended to kernels."""

    NEAREST = "nearest"
    LINEAR = "linear"
    ENTROPIC = "entropic"
    RIGID = "rigid"


def barycentric_images(coupling: Coupling, target: Float32) -> Float64:
    """(n, 3) m: where the coupling sends each source point, the mean of the targets weighted by its row."""
    plan = coupling.plan.astype(np.float64)
    return (plan @ target.astype(np.float64)) / plan.sum(axis=1, keepdims=True)


def carry(
    points: Float64,
    source: Float32,
    target: Float32,
    coupling: Coupling,
    method: OutOfSample,
    *,
    ridge: float = 1e-3,
) -> Float64:
    """Move points that are not in the source set as the coupling moves the source.

    Args:
        points: (K, 3) m, source frame: hinge points.
        source: (n, 3) m, the points that were coupled.
        target: (m, 3) m.
        coupling: From `source` to `target`.
        method: Which extension.
        ridge: `linear` only: pull towards the identity (eta of Perrot et al.).
    Returns:
        (K, 3) m, target frame.
    """
    if len(points) == 0:
        return points.copy()
    if method is OutOfSample.ENTROPIC:
        return _entropic(
            np.ascontiguousarray(points, np.float64), target.astype(np.float64),
            coupling.target_potential.astype(np.float64), coupling.reg,
        )  # fmt: skip
    images = barycentric_images(coupling, target)
    if method is OutOfSample.LINEAR:
        linear, shift = affine_map(source.astype(np.float64), images, ridge)
        return points @ linear + shift
    if method is OutOfSample.RIGID:
        rotation, shift = rigid_map(source.astype(np.float64), images)
        return points @ rotation + shift
    nearest = _nearest(np.ascontiguousarray(points, np.float64), source.astype(np.float64))
    return points + (images - source)[nearest]


def affine_map(source: Float64, images: Float64, ridge: float) -> tuple[Float64, Float64]:
    """The affine map x -> x A + b nearest to sending `source` to `images`, pulled towards the identity.

    Returns:
        A (3, 3) and b (3,), least squares of |S A + b - I|^2 / (3 n) + ridge |A - 1|^2.
    Source: the linear step of Perrot et al. 2016 for a given coupling.
    """
    centre = source.mean(axis=0)
    s = source - centre
    shift = images.mean(axis=0)
    # in the centred variables the shift decouples; only the deviation of A from the identity is penalised
    weight = ridge * source.size
    gram = s.T @ s + weight * np.eye(3)
    linear = np.linalg.solve(gram, s.T @ (images - shift) + weight * np.eye(3))
    return linear, shift - centre @ linear


def rigid_map(source: Float64, images: Float64) -> tuple[Float64, Float64]:
    """The rigid map x -> x R + t nearest to sending `source` to `images`, both (n, 3) m.

    Returns:
        R (3, 3), a rotation, and t (3,), least squares.
    Source: Kabsch 1976.
    """
    centre, shift = source.mean(axis=0), images.mean(axis=0)
    u, _, v = np.linalg.svd((source - centre).T @ (images - shift))
    rotation = (u * [1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return rotation, shift - centre @ rotation


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _nearest(points, source):
    out = np.empty(len(points), np.int64)
    for k in range(len(points)):
        best = np.inf
        for i in range(len(source)):
            a = points[k, 0] - source[i, 0]
            b = points[k, 1] - source[i, 1]
            c = points[k, 2] - source[i, 2]
            d = a * a + b * b + c * c
            if d < best:
                best = d
                out[k] = i
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _entropic(points, target, potential, reg):
    out = np.empty((len(points), 3))
    exponent = np.empty(len(target))
    for k in range(len(points)):
        highest = -np.inf
        for j in range(len(target)):
            a = points[k, 0] - target[j, 0]
            b = points[k, 1] - target[j, 1]
            c = points[k, 2] - target[j, 2]
            exponent[j] = (potential[j] - (a * a + b * b + c * c)) / reg
            highest = max(highest, exponent[j])
        total = 0.0
        x, y, z = 0.0, 0.0, 0.0
        for j in range(len(target)):
            e = np.exp(exponent[j] - highest)
            total += e
            x += e * target[j, 0]
            y += e * target[j, 1]
            z += e * target[j, 2]
        out[k, 0] = x / total
        out[k, 1] = y / total
        out[k, 2] = z / total
    return out
