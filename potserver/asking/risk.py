"""How likely a robot on a path touches something."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from potserver.asking.plan import Plan, check_extent, check_positive
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Bool, Float32, Float64, Unknown, check_rigid
from potserver.errors import BadPointsError, ShapeError, TooLargeError
from potserver.limits import Limits
from potserver.numerics.arrays import Int64
from potserver.numerics.lattice import covered_cells, most_cells

PART_CELLS = 50_000  # of a part: some tens of milliseconds of work
_AXIS_BITS = 21  # of a cell's number along an axis: three of them make one integer
_MAX_LATTICE = 2**_AXIS_BITS - 1  # cells along an axis
_ASSUMED = {Unknown.OCCUPIED: 1.0, Unknown.FREE: 0.0, Unknown.PRIOR: 0.5}


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Risk:
    """What is asked.

    The robot covers, at each pose, the cells of a lattice fixed to the map whose centres lie in one of its spheres, and the
    cells of the spheres' own centres. So a larger robot or a longer path covers all that a smaller one does. Poses count as
    they are: nothing is covered between them.
    """

    path: ArrayLike  # (P, 4, 4) T_map_body, rigid
    spheres: ArrayLike  # (S, 4) m: centre in the body frame, and radius
    unknown: Unknown = Unknown.OCCUPIED  # what unobserved cells are taken for
    resolution_m: float | None = None  # edge of a cell; None = half the smallest radius
    # edge of a cube that is one trial; None = the kernels' own width there
    correlation_m: float | None = None
    dims: int = 3  # 2 takes the spheres for discs in the plane z = 0, for planar maps
    evidence_only: bool = False  # nothing is borrowed: what is not observed is unknown

    def plan(self, snapshot: KernelMap, limits: Limits, *, part_cells: int = PART_CELLS) -> RiskPlan:
        """Check the question, and find the cells that the robot covers.

        Raises:
            ShapeError, BadPointsError, BadPoseError, OutOfRangeError: of the path, the robot or the options.
            TooLargeError: too many poses, spheres, or cells of them.
        """
        poses, spheres = self._checked_robot(limits)
        edge = 0.5 * float(spheres[:, 3].min()) if self.resolution_m is None else self.resolution_m
        check_positive("resolution_m", edge)
        if self.correlation_m is not None:
            check_positive("correlation_m", self.correlation_m)
        centres = np.einsum("pij,sj->psi", poses[:, :3, :3], spheres[:, :3]) + poses[:, None, :3, 3]
        check_extent(np.abs(centres) + spheres[:, 3, None], limits)
        most = len(poses) * most_cells(spheres[:, 3], edge, self.dims)
        extent = np.ptp(centres.reshape(-1, 3), axis=0).max() / edge if len(poses) else 0.0
        if most > limits.max_query_samples or extent + 4.0 * spheres[:, 3].max() / edge > _MAX_LATTICE:
            raise TooLargeError(
                f"the robot covers up to {most:.3g} cells of {edge:.3g} m over {extent * edge:.3g} m, the limits are"
                f" {limits.max_query_samples} cells and {_MAX_LATTICE} along an axis; ask for fewer poses or a coarser"
                " resolution_m"
            )
        swept = _distinct(*covered_cells(centres, spheres[:, 3], edge, self.dims))
        return RiskPlan(
            snapshot=snapshot,
            n_poses=len(poses),
            swept=swept,
            dims=self.dims,
            resolution_m=float(edge),
            unknown=self.unknown,
            correlation_m=self.correlation_m,
            evidence_only=self.evidence_only,
            part_size=part_cells,
        )

    def _checked_robot(self, limits: Limits) -> tuple[Float64, Float64]:
        """(P, 4, 4) poses and (S, 4) spheres."""
        poses, spheres = np.asarray(self.path, np.float64), np.asarray(self.spheres, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise ShapeError(f"path: {poses.shape}, need (P, 4, 4)")
        if spheres.ndim != 2 or spheres.shape[1] != 4 or len(spheres) == 0:
            raise ShapeError(f"spheres: {spheres.shape}, need (S, 4) with S of at least 1")
        if len(poses) > limits.max_query_poses or len(spheres) > limits.max_query_spheres:
            raise TooLargeError(
                f"{len(poses)} poses and {len(spheres)} spheres, the limits are"
                f" {limits.max_query_poses} and {limits.max_query_spheres}"
            )
        if not np.isfinite(spheres).all() or not (spheres[:, 3] > 0).all():
            raise BadPointsError("spheres: need finite centres and positive radii")
        if self.dims not in (2, 3):
            raise BadPointsError(f"dims is {self.dims}, need 2 or 3")
        for pose in poses:
            check_rigid(pose)
        return poses, spheres


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PathRisk:
    """How likely a robot on P poses touches something.

    The truth of the joint probability lies between `max_probability`, where all cells are one trial, and the sum of them all;
    `union_probability` takes cells as independent beyond the correlation length.
    """

    max_probability: Float64  # (P,) of the likeliest cell that the robot covers
    union_probability: Float64  # (P,) that any of its cells is occupied
    unknown_share: Float64  # (P,) of its cells, unobserved
    borrowed_share: Float64  # (P,) of what its cells are taken for: what is expected there, and not evidence
    path_max_probability: float
    path_union_probability: float  # every cell of the swept volume counted once
    path_unknown_share: float
    path_borrowed_share: float
    n_cells: int  # of the swept volume
    resolution_m: float  # edge of a cell
    map_revision: int


class SweptCells(NamedTuple):
    """The volume that a robot sweeps, as cells of a lattice."""

    cells: Int64  # (C, 3) distinct; cell (i, j, k) is centred at (i + .5, j + .5, k + .5) * resolution
    pose: Int64  # (M,) ascending: which pose covers ...
    cell_of_pose: Int64  # (M,) ... which of the cells


class CellRisk(NamedTuple):
    """Of cells of a swept volume."""

    probability: Float64  # (C,) of being occupied
    hazard: Float64  # (C,) what each adds to -ln P(all are free)
    unknown: Bool  # (C,)
    borrowed: Float32  # (C,) share of the probability that is expected, and not evidence


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RiskPlan(Plan[CellRisk]):
    """A path that passed its checks."""

    snapshot: KernelMap
    n_poses: int
    swept: SweptCells
    dims: int
    resolution_m: float
    unknown: Unknown
    correlation_m: float | None
    evidence_only: bool
    part_size: int

    @property
    def n_items(self) -> int:
        """Cells of the swept volume."""
        return len(self.swept.cells)

    def part(self, i: int) -> CellRisk:
        """What one run of the cells adds to the risk.

        With a correlation length c, edge h and d dims, a cell adds -ln(1 - p) (h / c)^d: a cube of edge c is one trial, in
        however many cells. Without one, c is the width of the kernels at the cell, as along rays.
        """
        points = (self.swept.cells[self.items(i)].astype(np.float64) + 0.5) * self.resolution_m
        if self.dims == 2:
            points[:, 2] = 0.0
        answer = self.snapshot.occupancy(points, evidence_only=self.evidence_only)
        is_told = answer.observed | (self.unknown is Unknown.PRIOR)
        p = np.where(is_told, answer.mean, _ASSUMED[self.unknown])
        if self.correlation_m is None:
            typical = self.snapshot.typical_width_m
            width = np.where(answer.observed, self.snapshot.widths(points), typical)
        else:
            width = np.full(len(points), self.correlation_m)
        with np.errstate(divide="ignore"):  # a cell that is taken for occupied
            hazard = -np.log1p(-p) * (self.resolution_m / width) ** self.dims
        return CellRisk(p, hazard, ~answer.observed, np.where(is_told, answer.borrowed, np.float32(0.0)))

    def result(self, parts: Iterable[CellRisk]) -> PathRisk:
        """The answer, from all parts in order."""
        p, hazard, unknown, borrowed = (np.concatenate(column) for column in zip(*parts, strict=True))
        n, pose, covered = self.n_poses, self.swept.pose, self.swept.cell_of_pose
        most = np.zeros(n)
        np.maximum.at(most, pose, p[covered])
        n_covered = np.maximum(np.bincount(pose, minlength=n), 1)
        summed = np.bincount(pose, weights=hazard[covered], minlength=n)
        path_most = float(p.max(initial=0.0))
        # a robot smaller than the correlation length is one trial at its likeliest cell, not a part of one
        union = np.maximum(most, -np.expm1(-summed))
        return PathRisk(
            max_probability=most,
            union_probability=union,
            unknown_share=np.bincount(pose, unknown[covered], n) / n_covered,
            borrowed_share=np.bincount(pose, borrowed[covered], n) / n_covered,
            path_max_probability=path_most,
            path_union_probability=max(path_most, float(union.max(initial=0.0)), -math.expm1(-hazard.sum())),
            path_unknown_share=float(unknown.mean()) if len(unknown) else 0.0,
            path_borrowed_share=float(borrowed.mean()) if len(borrowed) else 0.0,
            n_cells=len(p),
            resolution_m=self.resolution_m,
            map_revision=self.snapshot.map_revision,
        )


def _distinct(pose: Int64, cells: Int64) -> SweptCells:
    """Cells that poses cover, (M,) and (M, 3) with repetitions, each once."""
    lower = cells.min(axis=0) if len(cells) else np.zeros(3, np.int64)
    x, y, z = (cells - lower).T
    key, number = np.unique((x << (2 * _AXIS_BITS)) | (y << _AXIS_BITS) | z, return_inverse=True)
    distinct = np.stack(
        [key >> (2 * _AXIS_BITS), (key >> _AXIS_BITS) & _MAX_LATTICE, key & _MAX_LATTICE], axis=1
    )
    # `np.unique` would hold the interpreter for a fifth of a second here, a sort does not
    pairs = np.sort(pose * max(len(key), 1) + number)
    pairs = pairs[np.diff(pairs, prepend=-1) > 0]
    return SweptCells(distinct + lower, pairs // max(len(key), 1), pairs % max(len(key), 1))
