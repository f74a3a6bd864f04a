"""What kernels say when their positions and widths are distributions: hinges and gammas integrated out (paper, section II-A).

Eq. 1 sums w exp(-gamma |x - h|^2) with w and h Normal and gamma Gamma. Answers are made from one Gaussian bump a kernel: the
one that has the peak and the integral of the expected kernel, and likewise the integral of its variance. With E[gamma]
= g, shape a, D dimensions and hinge variances v_d:

    A = prod_d (1 + 2 g v_d)^(-1/2)                   peak of the expected bump
    gamma_0 = g / (1 + (D + 2) / (4 a))               first order in 1/a of E[gamma^(-D/2)], the integral
    gamma = gamma_0 A^(2/D)                           a blurred bump is wider
    weight = A w
    variance = A (var + w^2 u)                        u = min(1, 1 - A + D (D + 2) / (16 a))

u is the share of a bump's square that its position and width leave open. Without dispersion nothing changes. The approximation
is held against samples of all three distributions by a test.
"""

from __future__ import annotations

import numpy as np

from potserver.domain.types import KernelSet


def integrated_out(kernels: KernelSet, *, planar: bool) -> KernelSet:
    """The kernels whose means of hinge and gamma answer as the given distributions do on average.

    Dispersions stay in the record (the rate goes with the new mean of gamma): they must not be integrated out twice.

    Args:
        kernels: With the posterior of position and width.
        planar: They live in two dimensions.
    """
    dims = 2 if planar else 3
    shape = kernels.gamma_shape.astype(np.float64)
    gamma = shape / kernels.gamma_rate
    weight = kernels.weight_mean.astype(np.float64)
    peak = np.prod(1.0 + 2.0 * gamma[:, None] * kernels.hinge_var[:, :dims], axis=1) ** -0.5
    blurred = gamma / (1.0 + (dims + 2) / (4.0 * shape)) * peak ** (2.0 / dims)
    left_open = np.minimum(1.0 - peak + dims * (dims + 2) / (16.0 * shape), 1.0)
    variance = peak * (kernels.weight_var + np.square(weight) * left_open)
    return kernels.replace(
        gamma_rate=(shape / blurred).astype(np.float32),
        weight_mean=(peak * weight).astype(np.float32),
        weight_var=variance.astype(np.float32),
    )
