"""A scan's own map: the weights of carried kernels are solved on the scan's labels (RePOT, paper section III-D).

All weights are solved jointly, the prior stays fixed and every datum counts once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.domain.types import Bool, Float32, Float64, KernelSet
from potserver.errors import SolverError
from potserver.numerics import evidence
from potserver.numerics.beams import LabelledPoints, beam_weights
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.geometry import bounds
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

FEATURE_CUT = 0.02  # activations below this are left out of solves
_VOXEL = 2.0  # resolutions: the free points of such a voxel are one datum, the hits of half of it
_CUBE = 2.5  # voxels along a cube whose rows are solved together: some twenty rows a cube
_BORROWED_VAR_PER_M2 = 10.0  # log-odds^2 for each m^2; see `borrowed_prior`


class Effort(NamedTuple):
    """Steps of a solve."""

    newton_steps: int
    gradient_steps: int  # conjugate-gradient steps for each Newton step


INSTANT_EFFORT = Effort(newton_steps=4, gradient_steps=8)


class LabelledRows(NamedTuple):
    """Labelled points, those of one voxel and label as one: their mean."""

    points: Float64  # (N, 3) m
    occupied: Bool  # (N,)
    counts: Float32  # (N,) how much each counts


class Refined(NamedTuple):
    """Kernels with refined weights, and whether the solve went well; if not, they are the best found."""

    kernels: KernelSet
    converged: bool


def borrowed_prior(carried: KernelSet, w2_m2: float) -> KernelSet:
    """Carried kernels as a prior: borrowed knowledge is worth less the farther it was carried.

    Args:
        carried: With the weights of their atom.
        w2_m2: Squared 2-Wasserstein distance between atom and sector; the entropy may make it negative.
    """
    borrowed = np.float32(_BORROWED_VAR_PER_M2 * max(w2_m2, 0.0))
    return carried.replace(weight_var=carried.weight_var + borrowed)


def flat_prior(carried: KernelSet, prior_var: float) -> KernelSet:
    """Carried kernels of which only positions and widths count: weights 0 with the prior variance, log-odds^2."""
    zeros = np.zeros(len(carried), np.float32)
    return carried.replace(weight_mean=zeros, weight_var=zeros + np.float32(prior_var))


def rows_of(labelled: LabelledPoints, voxel_m: float) -> LabelledRows:
    """The points of each voxel as one datum; hits have voxels of half the edge.

    Args:
        labelled: Small coordinates.
        voxel_m: Edge of a voxel.
    """
    rows, _ = evidence.add(
        evidence.Rows.empty(), labelled.points, labelled.occupied, beam_weights(labelled), voxel_m
    )
    return LabelledRows(evidence.positions(rows, voxel_m), rows.occupied, rows.sums[:, 3])


def instantaneous_map(
    prior: KernelSet, labelled: LabelledPoints, resolution_m: float, *, threads: int
) -> Refined:
    """What one scan says by the kernels that were carried to it.

    Args:
        prior: K kernels, map frame; their weights' mean and variance are the prior.
        labelled: The scan's points, map frame; those of one voxel are one datum.
        resolution_m: Of the map.
        threads: Threads of the solve.
    Raises:
        SolverError: the solve ended without numbers.
    """
    voxel_m = _VOXEL * resolution_m
    corner = bounds(labelled.points)[0]
    rows = rows_of(labelled._replace(points=labelled.points - corner), voxel_m)
    return refine(
        prior, rows.points + corner, rows.occupied, rows.counts, edge_m=_CUBE * voxel_m, threads=threads
    )


def refine(
    prior: KernelSet,
    points: Float64,
    occupied: Bool,
    counts: Float32,
    *,
    edge_m: float,
    effort: Effort = INSTANT_EFFORT,
    threads: int,
) -> Refined:
    """Solve all weights jointly on labelled points.

    The solve starts from weights of 0: carried ones are the prior, but as a start they are far off where scenes differ.

    Args:
        prior: K kernels in the frame of the points; their weights' mean and variance are the prior.
        points: (N, 3) m.
        occupied: (N,) their labels.
        counts: (N,) how much each point counts.
        edge_m: Of the cubes that points are solved in; some twenty points to a cube are good.
        effort: Steps of the solve.
        threads: Threads of the solve.
    Raises:
        SolverError: the solve ended without numbers.
    """
    corner = points.min(axis=0) if len(points) else np.zeros(3)
    blocks = feature_blocks(
        points - corner, prior.hinge_mean - corner, prior.gamma, edge_m=edge_m, cut=FEATURE_CUT, bytes_a_value=1,
        threads=threads,
    )  # fmt: skip
    fit = warm_fit(
        blocks, occupied, counts, Prior(prior.weight_mean, prior.weight_var), np.zeros_like(prior.weight_mean),
        Solver(effort.newton_steps, effort.gradient_steps), threads=threads,
    )  # fmt: skip
    if not (np.isfinite(fit.weights).all() and np.isfinite(fit.var).all()):
        raise SolverError(
            f"the weights of {len(prior)} kernels on {len(points)} points came out NaN or infinite"
        )
    return Refined(prior.replace(weight_mean=fit.weights, weight_var=fit.var), fit.converged)
