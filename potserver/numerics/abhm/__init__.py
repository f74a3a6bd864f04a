"""Automorphing Bayesian Hilbert maps (ABHM): weights, hinges and widths of K kernels learned from labelled points.

    y_n ~ Bernoulli(sigmoid(f(x_n))),   f(x) = sum_m w_m exp(-gamma_m |x - h_m|^2)
    w_m ~ Normal(0, weight_var),   h_m ~ Normal(start, (hinge_reach ell)^2),   gamma_m ~ Gamma(gamma_shape, mean = start)

with ell = 1 / sqrt(2 gamma), the length scale a kernel starts with. Source: Senanayake, Tompkins, Ramos, CoRL 2018, and section
II-A of the RSS 2020 paper. Black-box variational inference over all ten numbers of a kernel at once is slow, and ends worse
than fixed kernels with jointly solved weights. So the posterior q(w) q(h) q(gamma) is found in two stages:

1. *Means* (`means`). Given hinges and widths the weights are a convex problem, which `warm_fit` solves jointly. Each epoch
   improves the weights, then takes stochastic gradient steps (Adam, mini-batches) on h, log gamma and w together; the last
   epoch solves the weights to the end. The step size falls along a half cosine, and by a factor after each epoch that gained
   nothing. The third such epoch ends the means: noise of mini-batches may hide a gain at large steps, not at small ones.
   Nothing is sampled here: with sampled h and gamma the means stay near their start, and held-out NLL is half as large again.
2. *Dispersions* (`dispersions`). With the means held, the variances of h and the shapes of gamma maximise the evidence lower
   bound by stochastic variational inference in torch: reparameterised samples of h and gamma, the exact KL divergence of each.
   They start at the Gauss-Newton curvature, so that few epochs suffice.

Points lie in cubes that share a list of kernels (`problem`, `feature_blocks`). A mini-batch takes some points of every cube:
that is less noisy than points drawn at random, and inner loops run over dense memory.
"""

from potserver.numerics.abhm.fit import AbhmPosterior, fit_abhm
from potserver.numerics.abhm.means import AbhmEpoch
from potserver.numerics.abhm.problem import AbhmOptions, AbhmStart

__all__ = ["AbhmEpoch", "AbhmOptions", "AbhmPosterior", "AbhmStart", "fit_abhm"]
