"""Learn an ABHM: the entry to both stages, and the posterior they give."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from potserver.errors import EmptyError, ShapeError
from potserver.numerics.abhm.dispersions import learn_dispersions, one_torch_thread
from potserver.numerics.abhm.means import AbhmEpoch, learn_means
from potserver.numerics.abhm.problem import (
    AbhmOptions,
    AbhmStart,
    KernelPrior,
    Problem,
)
from potserver.numerics.arrays import Bool, Float32, Float64


class AbhmPosterior(NamedTuple):
    """Normal over weights and hinges, Gamma over widths; how learning ended."""

    weight_mean: Float32  # (K,) log-odds
    weight_var: Float32  # (K,) log-odds^2: given the other weights, at the mean hinges and widths
    hinge_mean: Float64  # (K, 3) m
    hinge_var: Float32  # (K, 3) m^2; 0 along an axis in which all points agree
    gamma_shape: Float32  # (K,)
    gamma_rate: Float32  # (K,) m^2; gamma's mean is shape / rate, 1/m^2
    objectives: list[float]  # of the means, one an epoch: nats a point
    # evidence lower bound, to second order in the weights, nats a point; one an epoch of the dispersions
    elbos: list[float]
    # the means gained little in their last epochs, and their weights were solved to tolerance
    converged: bool


def fit_abhm(
    points: Float64,
    occupied: Bool,
    start: AbhmStart,
    options: AbhmOptions,
    *,
    sample_weight: Float32 | None = None,
    seed: int = 0,
    threads: int = 1,
    on_epoch: Callable[[AbhmEpoch], None] | None = None,
) -> AbhmPosterior:
    """Learn K kernels from N labelled points.

    Args:
        points: (N, 3) m. Hinges do not move along an axis in which all points agree (a planar scan's z).
        occupied: (N,) labels.
        start: The kernels before learning, in the frame of the points.
        options: How.
        sample_weight: (N,) how much each point counts; 1 by default.
        seed: Of mini-batches and samples; the same seed gives the same bits on the same machine and versions.
        threads: For the products with the features; the result does not depend on it.
        on_epoch: Called after each epoch of the means, e.g. to score held-out points and move a progress bar.
    Raises:
        EmptyError: no points or no kernels.
        ShapeError: arrays disagree, gamma is not positive, or the seed is negative.
        SolverError: the objective is no longer finite.
    """
    _check(points, occupied, start, sample_weight)
    if seed < 0:
        raise ShapeError(f"seed must be >= 0, got {seed}")
    count = np.ones(len(points), np.float32) if sample_weight is None else sample_weight.astype(np.float32)
    free_axes = (np.ptp(points, axis=0) > 0.0).astype(np.float32)
    problem = Problem(points, occupied, count, options, threads)
    prior = KernelPrior(start._replace(gamma=np.asarray(start.gamma, np.float64)), free_axes, options)
    rng = np.random.default_rng(seed)

    means = learn_means(problem, prior, rng, on_epoch)
    with one_torch_thread():
        hinge_sd, shape, elbos = learn_dispersions(problem, prior, means, rng)
    return AbhmPosterior(
        weight_mean=means.weights.mean,
        weight_var=means.weights.var,
        hinge_mean=means.hinge,
        hinge_var=np.square(hinge_sd).astype(np.float32),
        gamma_shape=shape.astype(np.float32),
        gamma_rate=(shape / means.gamma).astype(np.float32),
        objectives=means.objectives,
        elbos=elbos,
        converged=means.converged,
    )


def _check(points: Float64, occupied: Bool, start: AbhmStart, sample_weight: Float32 | None) -> None:
    n, k = len(points), len(start.hinge)
    if n == 0 or k == 0:
        raise EmptyError(f"nothing to learn: {n} points, {k} kernels")
    wanted = {"points": (n, 3), "occupied": (n,), "hinge": (k, 3), "gamma": (k,), "sample_weight": (n,)}
    given = {"points": points, "occupied": occupied, "hinge": start.hinge, "gamma": np.asarray(start.gamma)}
    if sample_weight is not None:
        given["sample_weight"] = sample_weight
    for name, array in given.items():
        if array.shape != wanted[name]:
            raise ShapeError(f"{name}: {array.shape}, need {wanted[name]}")
        if not np.isfinite(array).all():
            raise ShapeError(f"{name}: NaN or infinite values")
    if not (start.gamma > 0).all():
        raise ShapeError("gamma must be > 0")
    if sample_weight is not None and (sample_weight < 0).any():
        raise ShapeError("sample_weight must be >= 0")
