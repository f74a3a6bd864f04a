"""Refine weights with a scan's labels (RePOT, paper section III-D), and put kernels on data.

All weights are solved jointly, the prior stays fixed and every datum counts once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.domain.types import Bool, Float32, Float64, KernelSet
from potserver.errors import SolverError
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.kernel_index import build_index, latent_sums
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

_GAMMA_SHAPE = 100.0  # a placed kernel's width is known to 10 %


def gamma_of_spacing(spacing_m: float) -> float:
    """1/m^2: the width at which kernels of this spacing overlap smoothly, a length-scale of 0.6 spacings."""
    return 0.5 / (0.6 * spacing_m) ** 2


def kernels_at(hinge: Float64, spacing_m: float, prior_var: float) -> KernelSet:
    """Kernels of a spacing's width at (K, 3) m, weight 0 with the prior variance, log-odds^2."""
    k = len(hinge)
    return KernelSet(
        hinge_mean=hinge,
        hinge_var=np.full((k, 3), spacing_m**2 / 12.0, np.float32),  # uniform in the voxel
        gamma_shape=np.full(k, _GAMMA_SHAPE, np.float32),
        gamma_rate=np.full(k, _GAMMA_SHAPE / gamma_of_spacing(spacing_m), np.float32),
        weight_mean=np.zeros(k, np.float32),
        weight_var=np.full(k, prior_var, np.float32),
    )


def activation(kernels: KernelSet, points: Float64, *, threads: int) -> np.ndarray:
    """(N,) sum of phi at each point."""
    zeros = np.zeros(len(kernels))
    index = build_index(kernels.hinge_mean, kernels.gamma, zeros, zeros, activation_cut=0.01, tau=1.0)
    return latent_sums(index, points, threads=threads).activation


class Refined(NamedTuple):
    """Kernels with refined weights, and whether the solve went well; if not, they are the best found."""

    kernels: KernelSet
    converged: bool


def refine(
    kernels: KernelSet,
    points: Float64,
    occupied: Bool,
    *,
    edge_m: float,
    feature_cut: float,
    newton_steps: int,
    gradient_steps: int,
    threads: int,
    sample_weight: Float32 | None = None,
) -> Refined:
    """Solve all weights of `kernels` jointly on labelled points; their present mean and variance are the prior.

    The solve starts from weights of 0: transported ones are the prior, but as a start they are far off where the scenes differ.

    Args:
        kernels: In the frame of the points.
        points: (N, 3) m.
        occupied: (N,) their labels.
        edge_m: Of the cubes that points are solved in; some twenty points to a cube are good.
        feature_cut: Activations below this are left out of the solve.
        newton_steps, gradient_steps: Newton steps, and conjugate-gradient steps for each.
        threads: Threads of the solve.
        sample_weight: (N,) how much each point counts; 1 by default.
    Raises:
        SolverError: the solve ended without numbers.
    """
    corner = points.min(axis=0) if len(points) else np.zeros(3)
    blocks = feature_blocks(
        points - corner, kernels.hinge_mean - corner, kernels.gamma, edge_m=edge_m, cut=feature_cut,
        bytes_a_value=1, threads=threads,
    )  # fmt: skip
    counts = np.ones(len(points), np.float32) if sample_weight is None else sample_weight
    fit = warm_fit(
        blocks, occupied, counts, Prior(kernels.weight_mean, kernels.weight_var),
        np.zeros_like(kernels.weight_mean), Solver(newton_steps, gradient_steps), threads=threads,
    )  # fmt: skip
    if not (np.isfinite(fit.weights).all() and np.isfinite(fit.var).all()):
        raise SolverError(
            f"the weights of {len(kernels)} kernels on {len(points)} points came out NaN or infinite"
        )
    return Refined(kernels.replace(weight_mean=fit.weights, weight_var=fit.var), fit.converged)
