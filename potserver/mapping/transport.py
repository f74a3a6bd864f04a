"""Carry one atom's kernels to one sector (paper, section III-B; Algorithm 1's transfer step)."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from potserver.domain.types import Float32, KernelSet, Sector
from potserver.mapping.matching import Match, shared_centres
from potserver.numerics.coupling import Coupling, couple
from potserver.numerics.displacement import OutOfSample, carry
from potserver.numerics.geometry import in_sector, rotated_diagonal, rotation_z, thin

_RETRY_REG_FACTOR = 4.0  # an unconverged coupling is solved once more, blurrier


class Solve(Protocol):
    """A solver of eq. 4; `couple` is the balanced one. `reg` is a share of the largest cost."""

    def __call__(
        self, source: Float32, target: Float32, *, reg: float, tolerance: float, max_iterations: int
    ) -> Coupling: ...


class CouplingOptions(NamedTuple):
    """How an atom is coupled to its sector, and what moves with the coupling (eq. 3-4)."""

    n_points: int = 200  # of each label and side, at most
    voxel_m: float = 0.25  # points are thinned to one a voxel first; 0 draws them at random
    reg: float = 0.002  # weight of the entropy, as a share of the largest cost
    tolerance: float = 1e-3  # of the marginals, in L1
    max_iterations: int = 2000
    # free-space kernels move with the free points' own coupling; false: with the hits'
    is_label_aware: bool = True
    # kernels carried out of their sector are left out; false: only those out of the circle
    stays_in_sector: bool = True
    out_of_sample: OutOfSample = OutOfSample.NEAREST
    solve: Solve = couple


class Transported(NamedTuple):
    """The kernels of an atom in a sector, and how the couplings that moved them ended."""

    kernels: KernelSet  # map frame; empty if a coupling failed
    converged: bool
    marginal_error: float  # the larger of the couplings'
    n_iterations: int


def transport(match: Match, sector: Sector, options: CouplingOptions, seed: int) -> Transported:
    """Move all ten parameters of every kernel of the matched atom.

    Positions go with the coupling; dispersions of position turn with the atom; gamma, weight and their dispersions go along
    as they are ("implicitly", in the paper's words).
    """
    rng = np.random.default_rng(seed)
    atom, rotation = match.atom, rotation_z(match.rotation_rad)
    source_centre, target_centre = shared_centres(atom, sector)
    hinge = (atom.kernels.hinge_mean - source_centre) @ rotation.T
    solved: list[Coupling] = []

    def move(members: np.ndarray, source: Float32, target: Float32) -> None:
        x = ((_subsample(source, options, rng) - source_centre) @ rotation.T).astype(np.float32)
        y = (_subsample(target, options, rng) - target_centre).astype(np.float32)
        coupling = _couple(x, y, options)
        solved.append(coupling)
        if coupling.converged:
            hinge[members] = carry(hinge[members], x, y, coupling, options.out_of_sample)

    hits = bool(len(atom.hit_points) and len(sector.hit_points))
    free = bool(len(atom.free_points) and len(sector.free_points))
    occupied = atom.kernels.weight_mean > 0
    carried = np.ones(len(hinge), bool)
    if options.is_label_aware and free:
        move(~occupied, atom.free_points, sector.free_points)
        if hits:
            move(occupied, atom.hit_points, sector.hit_points)
        else:
            carried = ~occupied  # nothing was hit here: obstacles of the atom have no place to go
    elif hits:
        move(carried, atom.hit_points, sector.hit_points)
    elif free:
        move(carried, atom.free_points, sector.free_points)
    converged = bool(solved) and all(c.converged for c in solved)
    error = max((c.marginal_error for c in solved), default=float("nan"))
    iterations = sum(c.n_iterations for c in solved)
    if not converged:
        return Transported(KernelSet.empty(), False, error, iterations)
    hinge += target_centre
    keep = carried & in_sector(hinge, *_keep_bounds(sector, options))
    R, t = sector.T_map_sector[:3, :3], sector.T_map_sector[:3, 3]
    kernels = atom.kernels.take(keep)
    return Transported(
        kernels.replace(
            hinge_mean=hinge[keep] @ R.T + t, hinge_var=rotated_diagonal(kernels.hinge_var, R @ rotation)
        ),
        True,
        error,
        iterations,
    )


def _keep_bounds(sector: Sector, options: CouplingOptions) -> tuple[float, float, float]:
    """Azimuths in the sector frame and radius that transported kernels must lie in."""
    if not options.stays_in_sector:
        return -np.pi, np.pi + 1e-9, sector.radius_m
    return sector.azimuth_min_rad, sector.azimuth_max_rad, sector.radius_m


def _subsample(points: Float32, options: CouplingOptions, rng: np.random.Generator) -> Float32:
    return points[thin(points, options.n_points, options.voxel_m, rng)]


def _couple(x: Float32, y: Float32, options: CouplingOptions) -> Coupling:
    for factor in (1.0, _RETRY_REG_FACTOR):
        coupling = options.solve(
            x, y, reg=options.reg * factor, tolerance=options.tolerance,
            max_iterations=options.max_iterations,
        )  # fmt: skip
        if coupling.converged:
            break
    return coupling
