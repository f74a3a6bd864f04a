"""Kernels placed on data, not carried from atoms."""

from __future__ import annotations

import numpy as np

from potserver.domain.types import Float32, Float64, KernelSet
from potserver.numerics.kernel_index import build_index, latent_sums

_GAMMA_SHAPE = 100.0  # a placed kernel's width is known to 10 %
_ACTIVATION_CUT = 0.01  # of one kernel: far less than any threshold that activations are held against


def gamma_of_spacing(spacing_m: float) -> float:
    """1/m^2: the width at which kernels of this spacing overlap smoothly, a length-scale of 0.6 spacings."""
    return 0.5 / (0.6 * spacing_m) ** 2


def kernels_at(hinge: Float64, spacing_m: float, prior_var: float) -> KernelSet:
    """Kernels of a spacing's width at (K, 3) m, weight 0 with the prior variance, log-odds^2."""
    k = len(hinge)
    if not k:
        return KernelSet.empty()
    return KernelSet(
        hinge_mean=hinge,
        hinge_var=np.full((k, 3), spacing_m**2 / 12.0, np.float32),  # uniform in the voxel
        gamma_shape=np.full(k, _GAMMA_SHAPE, np.float32),
        gamma_rate=np.full(k, _GAMMA_SHAPE / gamma_of_spacing(spacing_m), np.float32),
        weight_mean=np.zeros(k, np.float32),
        weight_var=np.full(k, prior_var, np.float32),
    )


def activation(kernels: KernelSet, points: Float64, *, threads: int) -> Float32:
    """(N,) sum of phi over the kernels, at each of (N, 3) points."""
    zeros = np.zeros(len(kernels))
    index = build_index(
        kernels.hinge_mean, kernels.gamma, zeros, zeros, activation_cut=_ACTIVATION_CUT, tau=1.0
    )
    return latent_sums(index, points, threads=threads).activation
