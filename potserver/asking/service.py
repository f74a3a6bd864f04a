"""QueryService: bounded questions to the newest snapshot of a map."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potserver.asking.tiles import MANTISSA_BITS, KnownTiles, TilesPlan, plan_tiles
from potserver.domain.kernel_map import KernelMap, as_points
from potserver.domain.types import (
    Bool,
    Float64,
    KernelSet,
    Occupancy,
    PathRisk,
    RayReturns,
    Unknown,
    check_rigid,
)
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.mapping.service import MappingService
from potserver.numerics.arrays import Int64
from potserver.numerics.lattice import covered_cells, most_cells
from potserver.numerics.rays import FirstReturns

_MAX_QUANTILES = 16
_MAX_LATTICE = 2**21 - 1  # cells along an axis: three of them make one integer


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GridPlan:
    """A grid whose parts all come from one snapshot, computed when asked for."""

    kernel_map: KernelMap
    lower: Float64  # (3,) m, map frame
    resolution: float  # m
    shape: tuple[int, int, int]  # cells along x, y, z
    part_cells: int

    @property
    def n_cells(self) -> int:
        """Cells of the whole grid."""
        return math.prod(self.shape)

    @property
    def n_parts(self) -> int:
        """Parts of at most `part_cells` cells; the last one may be smaller."""
        return -(-self.n_cells // self.part_cells)

    def part(self, i: int) -> tuple[int, Occupancy]:
        """Flat index of a part's first cell, and the answers at its cell centres, in C order of (x, y, z)."""
        first = i * self.part_cells
        flat = np.arange(first, min(first + self.part_cells, self.n_cells))
        cells = np.stack(np.unravel_index(flat, self.shape), axis=1)
        return first, self.kernel_map.occupancy(self.lower + (cells + 0.5) * self.resolution)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RayPlan:
    """Rays that passed their checks; all parts come from one snapshot, computed when asked for."""

    kernel_map: KernelMap
    origins: Float64  # (N, 3) m, map frame
    directions: Float64  # (N, 3) of unit length
    max_range_m: float
    step_m: float
    quantiles: Float64  # (Q,) ascending
    unknown: Unknown
    width_m: float | None
    part_rays: int

    @property
    def n_parts(self) -> int:
        """Parts of at most `part_rays` rays; at least one, which may be empty."""
        return max(1, -(-len(self.origins) // self.part_rays))

    def part(self, i: int) -> FirstReturns:
        """The answers of one run of rays."""
        run = slice(i * self.part_rays, (i + 1) * self.part_rays)
        origins = self.origins[run]
        return self.kernel_map.first_returns(
            origins,
            self.directions[run],
            np.full(len(origins), self.max_range_m),
            step_m=self.step_m,
            quantiles=self.quantiles,
            unknown=self.unknown,
            width_m=self.width_m,
        )

    def result(self, parts: Iterable[FirstReturns]) -> RayReturns:
        """The answer, from all parts in order."""
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return RayReturns(
            **dict(zip(FirstReturns._fields, columns, strict=True)),
            step_m=self.step_m,
            map_revision=self.kernel_map.map_revision,
        )


class _CellRisk(NamedTuple):
    """Of cells of a swept volume."""

    probability: Float64  # (C,) of being occupied
    hazard: Float64  # (C,) what each adds to -ln P(all are free)
    unknown: Bool  # (C,)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RiskPlan:
    """A robot's path as the cells of a lattice that it covers; all parts come from one snapshot, computed when asked for."""

    kernel_map: KernelMap
    n_poses: int
    pose: Int64  # (M,) ascending: which pose covers ...
    cell_of_pose: Int64  # (M,) ... which of the cells
    cells: Int64  # (C, 3) distinct; cell (i, j, k) is centred at (i + .5, j + .5, k + .5) * resolution
    dims: int
    resolution_m: float
    unknown: Unknown
    correlation_m: float | None
    part_cells: int

    @property
    def n_parts(self) -> int:
        """Parts of at most `part_cells` cells; at least one, which may be empty."""
        return max(1, -(-len(self.cells) // self.part_cells))

    def part(self, i: int) -> _CellRisk:
        """What one run of the cells adds to the risk.

        With a correlation length c, edge h and d dims, a cell adds -ln(1 - p) (h / c)^d: a cube of edge c is one trial, in
        however many cells. Without one, c is the width of the kernels at the cell, as along rays.
        """
        cells = self.cells[i * self.part_cells : (i + 1) * self.part_cells].astype(np.float64)
        points = (cells + 0.5) * self.resolution_m
        if self.dims == 2:
            points[:, 2] = 0.0
        answer = self.kernel_map.occupancy(points)
        assumed = {Unknown.OCCUPIED: 1.0, Unknown.FREE: 0.0, Unknown.PRIOR: 0.5}[self.unknown]
        p = np.where(answer.observed, answer.mean, assumed)
        if self.correlation_m is None:
            typical = self.kernel_map.typical_width_m
            width = np.where(answer.observed, self.kernel_map.widths(points), typical)
        else:
            width = np.full(len(points), self.correlation_m)
        with np.errstate(divide="ignore"):  # a cell that is taken for occupied
            hazard = -np.log1p(-p) * (self.resolution_m / width) ** self.dims
        return _CellRisk(p, hazard, ~answer.observed)

    def result(self, parts: Iterable[_CellRisk]) -> PathRisk:
        """The answer, from all parts in order."""
        p, hazard, unknown = (np.concatenate(column) for column in zip(*parts, strict=True))
        n, covered = self.n_poses, self.cell_of_pose
        most = np.zeros(n)
        np.maximum.at(most, self.pose, p[covered])
        n_covered = np.bincount(self.pose, minlength=n)
        summed = np.bincount(self.pose, weights=hazard[covered], minlength=n)
        n_unknown = np.bincount(self.pose, weights=unknown[covered], minlength=n)
        path_most = float(p.max(initial=0.0))
        # a robot smaller than the correlation length is one trial at its likeliest cell, not a part of one
        union = np.maximum(most, -np.expm1(-summed))
        return PathRisk(
            max_probability=most,
            union_probability=union,
            unknown_share=n_unknown / np.maximum(n_covered, 1),
            path_max_probability=path_most,
            path_union_probability=max(path_most, float(union.max(initial=0.0)), -math.expm1(-hazard.sum())),
            path_unknown_share=float(unknown.mean()) if len(unknown) else 0.0,
            n_cells=len(p),
            resolution_m=self.resolution_m,
            map_revision=self.kernel_map.map_revision,
        )


class QueryService:
    """Answers from the newest snapshot; never waits for a scan that is being integrated."""

    def __init__(
        self,
        mapping: MappingService,
        *,
        max_points: int = 200_000,
        max_grid_cells: int = 4_000_000,
        max_samples: int = 4_000_000,
        max_rays: int = 50_000,
        max_poses: int = 5_000,
        max_spheres: int = 256,
        max_known_tiles: int = 100_000,
        max_coordinate_m: float = 1e7,
    ) -> None:
        """Bound what may be asked.

        Args:
            max_points: Of one query.
            max_grid_cells: Of one grid.
            max_samples: Places that one query of rays (steps of all rays) or of risk (cells at all poses) may look at.
            max_rays: Of one query.
            max_poses, max_spheres: Of one query of risk.
            max_known_tiles: That the asker of one query of tiles has.
            max_coordinate_m: Of everything, absolute.
        """
        self._mapping = mapping
        self.max_points = max_points
        self.max_grid_cells = max_grid_cells
        self.max_samples = max_samples
        self.max_rays = max_rays
        self.max_poses = max_poses
        self.max_spheres = max_spheres
        self.max_known_tiles = max_known_tiles
        self.max_coordinate_m = max_coordinate_m

    def occupancy(self, points: ArrayLike, *, with_gradient: bool = False) -> Occupancy:
        """Occupancy at (N, 3) or (N, 2) points, m, map frame; with the gradients of its mean and of its latent mean on request.

        Raises:
            ShapeError, BadPointsError, TooLargeError, OutOfRangeError.
        """
        array = as_points(points)
        if len(array) > self.max_points:
            raise TooLargeError(f"{len(array)} points in one query, the limit is {self.max_points}")
        self._check_coordinates(array)
        snapshot = self._mapping.snapshot
        return snapshot.occupancy_with_gradient(array) if with_gradient else snapshot.occupancy(array)

    def rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        *,
        quantiles: ArrayLike = (0.05, 0.5, 0.95),
        unknown: Unknown = Unknown.PRIOR,
        width_m: float | None = None,
        step_m: float | None = None,
        part_samples: int = 200_000,
    ) -> RayPlan:
        """Plan where rays first return; `numerics.rays` has the model.

        Args:
            origins, directions: (N, 3) or (N, 2) m, map frame; directions of any length but 0.
            max_range_m: Of all rays.
            quantiles: (Q,) ascending, in (0, 1), of the range to answer.
            unknown: What rays take unobserved space for.
            width_m: The length over which an occupancy probability counts as one trial; None = the kernels' own there.
            step_m: Longest step of the summation; None = `KernelMap.fine_step_m`.
            part_samples: About how many steps make a part.
        Raises:
            ShapeError, BadPointsError, OutOfRangeError: of the rays or the options.
            TooLargeError: too many rays, or steps of them.
        """
        starts, ways = as_points(origins), as_points(directions)
        if len(starts) != len(ways):
            raise ShapeError(f"{len(starts)} origins and {len(ways)} directions: need one direction a ray")
        if len(starts) > self.max_rays:
            raise TooLargeError(f"{len(starts)} rays in one query, the limit is {self.max_rays}")
        self._check_coordinates(starts)
        _need_positive("max_range_m", max_range_m)
        if max_range_m > self.max_coordinate_m:
            raise OutOfRangeError(f"rays of {max_range_m:.3g} m, the limit is {self.max_coordinate_m:.3g} m")
        for name, value in (("width_m", width_m), ("step_m", step_m)):
            if value is not None:
                _need_positive(name, value)
        levels = np.asarray(quantiles, np.float64)
        if (
            levels.ndim != 1
            or not ((levels > 0) & (levels < 1)).all()
            or (np.diff(levels) <= 0).any()
            or len(levels) > _MAX_QUANTILES
        ):
            raise BadPointsError(
                f"quantiles: need at most {_MAX_QUANTILES} ascending numbers between 0 and 1, not {levels.tolist()}"
            )
        largest = np.abs(ways).max(axis=1, initial=0.0)
        if not (largest > 0).all():
            raise BadPointsError(f"{int((largest == 0).sum())} of {len(ways)} directions have no length")
        ways = ways / largest[:, None]  # first, so that the squares neither overflow nor vanish
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        snapshot = self._mapping.snapshot
        step = snapshot.fine_step_m if step_m is None else step_m
        steps_a_ray = max(math.ceil(min(max_range_m / step, 1e15)), 1)
        if len(starts) * steps_a_ray > self.max_samples:
            raise TooLargeError(
                f"{len(starts)} rays of {steps_a_ray:.3g} steps of {step:.3g} m, the limit is {self.max_samples} steps in all;"
                " ask for fewer or shorter rays, or set a longer step_m"
            )
        return RayPlan(
            kernel_map=snapshot,
            origins=starts,
            directions=ways,
            max_range_m=float(max_range_m),
            step_m=float(step),
            quantiles=levels,
            unknown=unknown,
            width_m=width_m,
            part_rays=max(1, part_samples // steps_a_ray),
        )

    def risk(
        self,
        path: ArrayLike,
        spheres: ArrayLike,
        *,
        unknown: Unknown = Unknown.OCCUPIED,
        resolution_m: float | None = None,
        correlation_m: float | None = None,
        dims: int = 3,
        part_cells: int = 50_000,
    ) -> RiskPlan:
        """Plan how likely a robot on a path touches something.

        The robot covers, at each pose, the cells of a lattice fixed to the map whose centres lie in one of its spheres, and the
        cells of the spheres' own centres. So a larger robot or a longer path covers all that a smaller one does. Poses count as
        they are: nothing is covered between them.

        Args:
            path: (P, 4, 4) T_map_body, rigid.
            spheres: (S, 4): centre, m, body frame, and radius, m.
            unknown: What unobserved cells are taken for.
            resolution_m: Edge of a cell; None = half the smallest radius.
            correlation_m: Edge of a cube that counts as one trial; None = the kernels' own width there.
            dims: 2 takes the spheres for discs in the plane z = 0, for planar maps.
            part_cells: Cells of a part.
        Raises:
            ShapeError, BadPointsError, BadPoseError, OutOfRangeError: of the path, the robot or the options.
            TooLargeError: too many poses, spheres, or cells of them.
        """
        poses, balls = np.asarray(path, np.float64), np.asarray(spheres, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise ShapeError(f"path: {poses.shape}, need (P, 4, 4)")
        if balls.ndim != 2 or balls.shape[1] != 4 or len(balls) == 0:
            raise ShapeError(f"spheres: {balls.shape}, need (S, 4) with S of at least 1")
        if len(poses) > self.max_poses or len(balls) > self.max_spheres:
            raise TooLargeError(
                f"{len(poses)} poses and {len(balls)} spheres, the limits are {self.max_poses} and {self.max_spheres}"
            )
        if not np.isfinite(balls).all() or not (balls[:, 3] > 0).all():
            raise BadPointsError("spheres: need finite centres and positive radii")
        if dims not in (2, 3):
            raise BadPointsError(f"dims is {dims}, need 2 or 3")
        for pose in poses:
            check_rigid(pose)
        edge = 0.5 * float(balls[:, 3].min()) if resolution_m is None else resolution_m
        _need_positive("resolution_m", edge)
        if correlation_m is not None:
            _need_positive("correlation_m", correlation_m)
        centres = np.einsum("pij,sj->psi", poses[:, :3, :3], balls[:, :3]) + poses[:, None, :3, 3]
        self._check_coordinates(np.abs(centres) + balls[:, 3, None])
        most = len(poses) * most_cells(balls[:, 3], edge, dims)
        extent = np.ptp(centres.reshape(-1, 3), axis=0).max() / edge if len(poses) else 0.0
        if most > self.max_samples or extent + 4.0 * balls[:, 3].max() / edge > _MAX_LATTICE:
            raise TooLargeError(
                f"the robot covers up to {most:.3g} cells of {edge:.3g} m over {extent * edge:.3g} m, the limits are"
                f" {self.max_samples} cells and {_MAX_LATTICE} along an axis; ask for fewer poses or a coarser resolution_m"
            )
        pose, cells = covered_cells(centres, balls[:, 3], edge, dims)
        lower = cells.min(axis=0, initial=np.iinfo(np.int64).max) if len(cells) else np.zeros(3, np.int64)
        x, y, z = (cells - lower).T
        key, number = np.unique((x << 42) | (y << 21) | z, return_inverse=True)
        distinct = np.stack([key >> 42, (key >> 21) & _MAX_LATTICE, key & _MAX_LATTICE], axis=1) + lower
        pairs = np.unique(pose * max(len(key), 1) + number)
        return RiskPlan(
            kernel_map=self._mapping.snapshot,
            n_poses=len(poses),
            pose=pairs // max(len(key), 1),
            cell_of_pose=pairs % max(len(key), 1),
            cells=distinct,
            dims=dims,
            resolution_m=float(edge),
            unknown=unknown,
            correlation_m=correlation_m,
            part_cells=part_cells,
        )

    def grid(
        self, lower: ArrayLike, upper: ArrayLike, resolution: float, *, part_cells: int = 50_000
    ) -> GridPlan:
        """Plan a grid over a box; cells start at `lower` and the last ones reach or pass `upper`.

        Raises:
            BadPointsError: not finite, an upper corner below the lower one, or a resolution that is not positive.
            TooLargeError: more cells than the limit.
            OutOfRangeError: beyond the largest coordinate.
        """
        low, high = self._corner(lower), self._corner(upper)
        if not (math.isfinite(resolution) and resolution > 0):
            raise BadPointsError(f"resolution is {resolution}, need a positive number of metres")
        if (high < low).any():
            raise BadPointsError(f"the box is inverted: lower {low.tolist()}, upper {high.tolist()}")
        # half a millionth of slack, so that a box of 10 m at 0.1 m has 100 cells and not 101
        with np.errstate(
            over="ignore"
        ):  # a tiny resolution gives infinitely many cells, which is over the limit
            counts = np.maximum(np.ceil((high - low) / resolution - 5e-7), 1.0)
            n_cells = float(np.prod(counts))
        if n_cells > self.max_grid_cells:
            raise TooLargeError(
                f"{n_cells:.3g} cells, the limit is {self.max_grid_cells}; ask for a coarser or smaller grid"
            )
        nx, ny, nz = (int(c) for c in counts)
        return GridPlan(self._mapping.snapshot, low, float(resolution), (nx, ny, nz), part_cells)

    def params(
        self, lower: ArrayLike | None = None, upper: ArrayLike | None = None, *, part_kernels: int = 20_000
    ) -> tuple[list[KernelSet], int]:
        """The overall map's kernels, all or those with their hinge mean inside a box, in parts, and the map revision.

        Raises:
            BadPointsError, OutOfRangeError: an illegal corner.
        """
        snapshot = self._mapping.snapshot
        kernels = snapshot.kernels
        inside: NDArray[np.bool_] = np.ones(len(kernels), bool)
        if lower is not None:
            inside &= (kernels.hinge_mean >= self._corner(lower)).all(axis=1)
        if upper is not None:
            inside &= (kernels.hinge_mean <= self._corner(upper)).all(axis=1)
        chosen = kernels.take(inside)
        starts = range(0, max(len(chosen), 1), part_kernels)
        return [chosen.take(slice(i, i + part_kernels)) for i in starts], snapshot.map_revision

    def tiles(
        self,
        known: KnownTiles | None = None,
        *,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        mantissa_bits: int = MANTISSA_BITS,
        part_kernels: int = 20_000,
    ) -> TilesPlan:
        """Plan what brings an asker from the tiles that it has to those of the newest state of the map.

        Args:
            known: What the asker has; None = nothing.
            lower, upper: (3,) m, map frame: only tiles that this box touches are compared; None = no bound on that side.
            mantissa_bits: Of each weight's mean and variance, 2 to 23. With b of them the latent mean changes by at most
                2^-(b + 1) sum_m |weight_mean_m| phi_m, and the probability by at most a quarter of that, beside a relative
                2^-(b + 1) of the latent variance.
            part_kernels: Kernels of a part, at most.
        Raises:
            ShapeError, BadPointsError, OutOfRangeError: an illegal corner, or known tiles of unequal number.
            TooLargeError: too many known tiles.
        """
        if known is not None:
            n = len(known.indices)
            if known.indices.shape != (n, 3) or known.revisions.shape != (n,):
                raise ShapeError(
                    f"known tiles: {known.indices.shape} and {known.revisions.shape}, need (N, 3) and (N,)"
                )
            if n > self.max_known_tiles:
                raise TooLargeError(f"{n} known tiles, the limit is {self.max_known_tiles}; ask about a box")
        if not 2 <= mantissa_bits <= MANTISSA_BITS:
            raise BadPointsError(f"mantissa_bits is {mantissa_bits}, need 2 to {MANTISSA_BITS}")
        return plan_tiles(
            self._mapping.state,
            known,
            None if lower is None else self._corner(lower),
            None if upper is None else self._corner(upper),
            tile_size_m=self._mapping.settings.tile_size_m,
            mantissa_bits=mantissa_bits,
            part_kernels=part_kernels,
        )

    def warm_up(self) -> None:
        """Compile what questions of every kind use, so that the first one does not wait for that."""
        kernels = KernelMap.from_arrays([[0.0, 0.0, 0.0]], [1.0], [1.0], [1.0], threads=1)
        kernels.occupancy_with_gradient([[0.0, 0.0, 0.0]])
        kernels.first_returns(
            np.zeros((1, 3)),
            np.array([[1.0, 0.0, 0.0]]),
            np.ones(1),
            step_m=1.0,
            quantiles=np.array([0.5]),
            unknown=Unknown.FREE,
            width_m=None,
        )
        covered_cells(np.zeros((1, 1, 3)), np.ones(1), 1.0, 3)

    def _corner(self, corner: ArrayLike) -> Float64:
        array = np.asarray(corner, np.float64)
        if array.shape != (3,):
            raise ShapeError(f"a corner of a box has shape {array.shape}, need (3,)")
        if not np.isfinite(array).all():
            raise BadPointsError("a corner of the box is NaN or infinite")
        self._check_coordinates(array)
        return array

    def _check_coordinates(self, array: Float64) -> None:
        farthest = float(np.abs(array).max(initial=0.0))
        if farthest > self.max_coordinate_m:
            raise OutOfRangeError(
                f"a coordinate of {farthest:.3g} m, the limit is {self.max_coordinate_m:.3g} m"
            )


def _need_positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise BadPointsError(f"{name} is {value}, need a positive number")
