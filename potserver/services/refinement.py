"""Refine weights with a scan's labels (RePOT, paper section III-D), and add kernels where transport explains nothing.

All weights are solved jointly, the prior stays fixed and every datum counts once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.domain.types import Float64, KernelSet
from potserver.errors import SolverError
from potserver.numerics.beams import LabelledPoints
from potserver.numerics.geometry import voxel_pick
from potserver.numerics.kernel_index import build_index, latent_sums, sparse_features
from potserver.numerics.logistic import fit_sparse
from potserver.services.settings import MappingSettings

_TOO_WIDE = 1.5  # times the coarse spacing
_GAMMA_SHAPE = 100.0  # a placed kernel's width is known to 10 %


def gamma_of_spacing(spacing_m: float) -> float:
    """1/m^2: the width at which kernels of this spacing overlap smoothly, a length-scale of 0.6 spacings."""
    return 0.5 / (0.6 * spacing_m) ** 2


def place_kernels(points: Float64, spacing_m: float, prior_var: float) -> KernelSet:
    """One kernel in every occupied voxel of the points, weight 0 with the prior variance.

    Args:
        points: (N, 3) m.
        spacing_m: Voxel edge.
        prior_var: log-odds^2.
    """
    picked = voxel_pick(points, spacing_m)
    hinge = (np.floor(points[picked] / spacing_m) + 0.5) * spacing_m
    if len(points) and np.ptp(points[:, 2]) == 0.0:
        hinge[:, 2] = points[0, 2]  # a planar map keeps its kernels in its plane
    k = len(hinge)
    return KernelSet(
        hinge_mean=hinge,
        hinge_var=np.full((k, 3), spacing_m**2 / 12.0, np.float32),  # uniform in the voxel
        gamma_shape=np.full(k, _GAMMA_SHAPE, np.float32),
        gamma_rate=np.full(k, _GAMMA_SHAPE / gamma_of_spacing(spacing_m), np.float32),
        weight_mean=np.zeros(k, np.float32),
        weight_var=np.full(k, prior_var, np.float32),
    )


def fill_kernels(
    labelled: LabelledPoints, known: KernelSet, settings: MappingSettings, *, threads: int
) -> KernelSet:
    """Kernels for the points that `known` does not explain: coarse ones anywhere, fine ones at hits.

    A point is explained when the kernels of the right scale sum to at least `explained_activation` there. Kernels much wider
    than the coarse ones explain nothing: an atom of a wide street must not keep detail out of a room.
    """
    parts: list[KernelSet] = []
    fine = is_fine(known, settings)
    if settings.fill_coarse_m:
        wide = known.take(~fine & ~is_too_wide(known, settings))
        parts.append(_fill(labelled.points, wide, settings.fill_coarse_m, settings, threads))
    if settings.fill_fine_m:
        narrow = known.take(fine)
        parts.append(
            _fill(labelled.points[labelled.occupied], narrow, settings.fill_fine_m, settings, threads)
        )
    return KernelSet.concatenate(parts)


def is_too_wide(kernels: KernelSet, settings: MappingSettings) -> np.ndarray:
    """(K,) which kernels are much wider than those that the map places itself; none, if it places none."""
    if not settings.fill_coarse_m:
        return np.zeros(len(kernels), bool)
    return kernels.gamma < gamma_of_spacing(_TOO_WIDE * settings.fill_coarse_m)


def is_fine(kernels: KernelSet, settings: MappingSettings) -> np.ndarray:
    """(K,) which kernels are of the fine scale: nearer to `fill_fine_m` than to `fill_coarse_m`, by ratio."""
    coarse, fine = settings.fill_coarse_m or settings.fill_fine_m, settings.fill_fine_m
    if not fine:
        return np.zeros(len(kernels), bool)
    return kernels.gamma > np.sqrt(gamma_of_spacing(coarse) * gamma_of_spacing(fine))


def _fill(
    points: Float64, known: KernelSet, spacing_m: float, settings: MappingSettings, threads: int
) -> KernelSet:
    if len(points) and len(known):
        points = points[activation(known, points, threads=threads) < settings.explained_activation]
    return place_kernels(points, spacing_m, settings.prior_var)


def activation(kernels: KernelSet, points: Float64, *, threads: int) -> np.ndarray:
    """(N,) sum of phi at each point."""
    zeros = np.zeros(len(kernels))
    index = build_index(kernels.hinge_mean, kernels.gamma, zeros, zeros, activation_cut=0.01, tau=1.0)
    return latent_sums(index, points, threads=threads).activation


class Refined(NamedTuple):
    """Kernels with refined weights, and whether the solve reached its tolerance; if not, they are the best found."""

    kernels: KernelSet
    converged: bool


def refine(
    kernels: KernelSet, labelled: LabelledPoints, *, feature_cut: float, tolerance: float, threads: int
) -> Refined:
    """Solve all weights of `kernels` jointly on labelled points; their present mean and variance are the prior.

    Args:
        kernels: In the frame of the points.
        labelled: What a scan says.
        feature_cut: Activations below this are left out of the solve.
        tolerance: Of the gradient, relative to its start.
        threads: Threads of the solve.
    Raises:
        SolverError: the solve ended without numbers.
    """
    features = sparse_features(
        labelled.points,
        kernels.hinge_mean,
        kernels.gamma,
        cut=feature_cut,
        threads=threads,
    )
    posterior = fit_sparse(
        features, labelled.occupied, kernels.weight_mean, kernels.weight_var,
        tolerance=tolerance, threads=threads,
    )  # fmt: skip
    if not (np.isfinite(posterior.mean).all() and np.isfinite(posterior.var).all()):
        raise SolverError(
            f"the weights of {len(kernels)} kernels on {len(labelled.points)} points came out NaN or infinite"
        )
    return Refined(kernels.replace(weight_mean=posterior.mean, weight_var=posterior.var), posterior.converged)
