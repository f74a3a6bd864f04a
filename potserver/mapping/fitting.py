"""A scan's own map, fitted: kernels on two lattices, solved on the scan's labels beyond what the dictionary expects there.

It is small and cheap, because it goes back to the sender of every scan: kernels are wider than the overall map's, and of a
dense scan only so many beams are learned. Coordinates are relative to a corner below all labels, along the map's axes.
"""

from __future__ import annotations

import numpy as np

from potschemas.answers import PRIOR_VAR
from potschemas.lean import LeanTiles, to_bytes
from potserver.domain.tiles import COARSE_SPACING, TileIndex
from potserver.domain.types import Float32, Float64, KernelSet, OwnMap
from potserver.errors import SolverError
from potserver.mapping.leaning import EVERY, Expected
from potserver.mapping.placing import kernels_at
from potserver.mapping.refinement import LabelledRows, rows_of
from potserver.mapping.support import support_of
from potserver.numerics.beams import Beams, label_beams
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.geometry import bounds
from potserver.numerics.lattice_nodes import new_nodes
from potserver.numerics.lean import Lean
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

_BEAMS, _FREE_PER_BEAM = 18_000, 2
_GAP_M = 0.1  # between a hit and the last free sample of its beam
_FINE, _FINER = 3.0, 2.0  # resolutions: spacing of fine kernels, and where that makes few of them
_FEW = 500  # kernels
_COARSE_REACH, _FINE_REACH = 0.7, 0.9  # spacings: nearer nodes than this get a kernel
_SPARSE, _MANY = 4, 18_000  # of many rows every fourth asks for coarse kernels, which hundreds of rows share
_CUT = 0.1  # activations below this are left out of the solve
_SOLVER = Solver(n_newton=5, n_conjugate_gradient=8, longest_step=4.0, least_curvature=0.003)
_LEAN_TILE_M, _LEAN_NODES = 10.0, (3, 3, 41)  # the kernels make up for what a coarse lean smooths over


def fitted_map(
    beams: Beams,
    origin: Float64,
    expected: Expected | None,
    resolution_m: float,
    rng: np.random.Generator,
    *,
    planar: bool,
    threads: int,
) -> OwnMap:
    """What one scan says, in few kernels.

    Args:
        beams: To learn from, relative to `origin`, along the map's axes.
        origin: (3,) m, map frame: the sensor.
        expected: What the dictionary expects around it.
        resolution_m: Of the map.
        rng: Of the beams and of their free points.
        planar: Kernels stay in the plane of the beams.
        threads: Threads of the solve.
    Raises:
        SolverError: the solve ended without numbers.
    """
    drawn = _thinned(beams, rng)
    labelled = label_beams(drawn, free_per_beam=_FREE_PER_BEAM, gap_m=_GAP_M, rng=rng)
    fine_m = _FINE * resolution_m
    corner = origin + np.floor(bounds(labelled.points)[0] / fine_m - 1.0 - COARSE_SPACING) * fine_m
    if planar:
        corner[2] = origin[2]
    elif expected is not None:  # the ground lies between nodes, which then stand on both sides of it
        corner[2] += expected.ground.height_m % fine_m - fine_m
    local = labelled._replace(points=labelled.points + (origin - corner))
    rows = rows_of(local, resolution_m)
    if planar:
        rows.points[:, 2] = 0.0  # rows keep off the edges of their voxels
    kernels = _kernels_on(rows, fine_m, planar)
    if len(kernels) < _FEW:
        fine_m = _FINER * resolution_m
        kernels = _kernels_on(rows, fine_m, planar)
    lean = None if expected is None else _lean_of(expected, rows.points + corner)
    solved, converged = _solved(
        kernels, rows, _offset(lean, rows.points + corner), COARSE_SPACING * fine_m, threads
    )
    extent = float(bounds(rows.points)[1].max()) + 2.0 * COARSE_SPACING * fine_m
    return OwnMap(
        kernels=solved,
        origin=corner,
        spacings_m=(COARSE_SPACING * fine_m, fine_m),
        size_m=np.ceil(extent / (5.0 * fine_m)) * 5.0 * fine_m,
        lean=lean,
        borrowed=() if expected is None else expected.borrowed,
        converged=converged,
    )


def _thinned(beams: Beams, rng: np.random.Generator) -> Beams:
    n = len(beams.ends)
    if n <= _BEAMS:
        return beams
    drawn = np.sort(rng.choice(n, _BEAMS, replace=False))
    return beams.take(drawn)


def _kernels_on(rows: LabelledRows, fine_m: float, planar: bool) -> KernelSet:
    """Kernels with the prior's weights: fine ones about hits, coarse ones about all rows."""
    none, coarse_m = np.zeros((0, 3)), COARSE_SPACING * fine_m
    about = rows.points[:: 1 if len(rows.points) < _MANY else _SPARSE]
    coarse = new_nodes(about, none, coarse_m, within=_COARSE_REACH, planar=planar)
    fine = new_nodes(rows.points[rows.occupied], none, fine_m, within=_FINE_REACH, planar=planar)
    return KernelSet.concatenate(
        [kernels_at(coarse, coarse_m, PRIOR_VAR), kernels_at(fine, fine_m, PRIOR_VAR)]
    )


def _lean_of(expected: Expected, points: Float64) -> LeanTiles:
    """What is expected in the tiles that points, (N, 3) m, map frame, lie in."""
    tile = np.floor(points / _LEAN_TILE_M).astype(np.int64)
    low = tile.min(axis=0)
    size = tuple(tile.max(axis=0) - low + 1)
    found = np.unique(np.ravel_multi_index(tuple((tile - low).T), size))
    tiles = np.stack(np.unravel_index(found, size), axis=1) + low
    axes = [np.linspace(0.0, _LEAN_TILE_M, n) for n in _LEAN_NODES]
    local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    log_odds = expected.at((tiles[:, None] * _LEAN_TILE_M + local).reshape(-1, 3))
    told = to_bytes(log_odds, EVERY).reshape(-1, *_LEAN_NODES)
    index: list[TileIndex] = [(x, y, z) for x, y, z in tiles.tolist()]
    return LeanTiles(_LEAN_TILE_M, dict(zip(index, told, strict=True)))


def _offset(lean: LeanTiles | None, points: Float64) -> Float32 | None:
    return None if lean is None else Lean(*lean).at(points)


def _solved(
    kernels: KernelSet, rows: LabelledRows, offset: Float32 | None, edge_m: float, threads: int
) -> tuple[KernelSet, bool]:
    """The kernels with weights that explain the rows, and whether the solve went well."""
    blocks = feature_blocks(
        rows.points, kernels.hinge_mean, kernels.gamma, edge_m=edge_m, cut=_CUT, bytes_a_value=1, threads=threads
    )  # fmt: skip
    prior = Prior(kernels.weight_mean, kernels.weight_var, offset)
    fit = warm_fit(blocks, rows.occupied, rows.counts, prior, kernels.weight_mean, _SOLVER, threads=threads)
    if not np.isfinite(fit.weights).all():
        raise SolverError(
            f"the weights of {len(kernels)} kernels on {len(rows.points)} rows came out NaN or infinite"
        )
    support = support_of(blocks, rows.occupied.astype(np.uint8), rows.counts, threads)
    var = support.variance(kernels.weight_var)
    return kernels.replace(weight_mean=fit.weights, weight_var=var), fit.converged
