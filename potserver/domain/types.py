"""The nouns. Frozen, numpy inside, every array with shape, dtype, unit and frame. 2D is 3D with z = 0."""

from __future__ import annotations

import dataclasses
import math
from enum import Enum
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potschemas.answers import AnswerRule
from potschemas.lean import LeanTiles
from potserver.errors import BadPointsError, BadPoseError, EmptyError, ShapeError
from potserver.numerics.beams import Beams

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


class ParamsKind(str, Enum):
    """Which kernels a scan's sender gets back."""

    FITTED = "fitted"  # solved on the scan's labels, beyond what the dictionary expects there
    TRANSPORTED = "transported"  # of the nearest atoms: carried by transport, refined by the labels
    NONE = "none"  # none are computed


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Scan:
    """One LiDAR sweep with its pose.

    Raises (on construction):
        ShapeError: points are not (N, 3), is_return not (N,), or the pose not (4, 4).
        EmptyError: no points. BadPointsError: NaN or infinite coordinates, or a planar scan out of its plane.
        BadPoseError: the pose is not rigid.
    """

    points: Float32  # (N, 3) m, sensor frame: echoes, and ends of beams without one
    T_map_sensor: Float64  # (4, 4) rigid
    is_return: Bool = None  # type: ignore[assignment]  # (N,) false = no echo, the beam was free up to the point; all by default
    is_planar: bool = False  # a 2D scanner: everything has z = 0
    robot_id: str = "robot"
    session: str = ""  # the run of the robot's program that counts `seq`
    seq: int = 0
    stamp_ns: int = 0
    params: ParamsKind | None = None  # what the sender wants back; none: it did not say

    def __post_init__(self) -> None:
        n = len(self.points)
        returned = np.ones(n, bool) if self.is_return is None else self.is_return
        for name, value, dtype in (
            ("points", self.points, np.float32),
            ("is_return", returned, np.bool_),
            ("T_map_sensor", self.T_map_sensor, np.float64),
        ):
            object.__setattr__(self, name, np.ascontiguousarray(value, dtype))
        if self.points.shape != (n, 3) or self.is_return.shape != (n,) or self.T_map_sensor.shape != (4, 4):
            raise ShapeError(
                f"scan: points {self.points.shape}, is_return {self.is_return.shape}, pose {self.T_map_sensor.shape};"
                " need (N, 3), (N,), (4, 4)"
            )
        if n == 0:
            raise EmptyError("the cloud has no points")
        if not np.isfinite(self.points).all():
            bad = int((~np.isfinite(self.points)).any(axis=1).sum())
            raise BadPointsError(f"{bad} of {n} points have NaN or infinite coordinates")
        check_rigid(self.T_map_sensor)
        if self.is_planar and self.points[:, 2].any():
            raise BadPointsError("a planar scan has points with z other than 0")

    @property
    def origin(self) -> Float64:
        """(3,) m, map frame: where the beams start."""
        return self.T_map_sensor[:3, 3]

    @property
    def beams(self) -> Beams:
        """The beams in a frame at the sensor with the map's axes."""
        return self.beams_at(slice(None))

    def beams_at(self, index: NDArray[np.intp] | slice) -> Beams:
        """Some of `beams`, by a numpy index: most scans have more than a map takes."""
        R = self.T_map_sensor[:3, :3]
        return Beams(self.points[index].astype(np.float64) @ R.T, self.is_return[index])


def check_rigid(transform: Float64, tolerance: float = 1e-3) -> None:
    """Refuse a matrix that is not a rotation and a translation.

    Raises:
        BadPoseError: not finite, a bottom row other than (0, 0, 0, 1), or a rotation part that is off by more than
            `tolerance` (scale, shear or mirror).
    """
    if not np.isfinite(transform).all():
        raise BadPoseError("the pose has NaN or infinite entries")
    if not np.allclose(transform[3], (0.0, 0.0, 0.0, 1.0), atol=1e-9):
        raise BadPoseError(f"the pose's last row is {transform[3].tolist()}, need 0 0 0 1")
    rotation = transform[:3, :3]
    if np.abs(rotation).max() > 1.0 + tolerance:
        raise BadPoseError("the pose is not rigid: its rotation part has entries beyond 1")
    defect = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if defect > tolerance or np.linalg.det(rotation) < 0:
        raise BadPoseError(
            f"the pose is not rigid: R R^T is off by {defect:.2g}, det {np.linalg.det(rotation):.3f}"
        )


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class KernelSet:
    """K kernels of a Bayesian Hilbert map in one frame: ten numbers each (paper, section II-A). Read-only arrays.

    Raises (on construction):
        ShapeError: the arrays disagree on K, are not finite, or gamma or a variance has an illegal sign.
    """

    hinge_mean: Float64  # (K, 3) m; float64, because maps live at UTM coordinates
    hinge_var: Float32  # (K, 3) m^2, along the frame's axes
    gamma_shape: Float32  # (K,) > 0
    gamma_rate: Float32  # (K,) m^2, > 0; E[gamma] = shape / rate
    weight_mean: Float32  # (K,) log-odds
    weight_var: Float32  # (K,) log-odds^2, > 0

    def __post_init__(self) -> None:
        for name in KERNEL_ARRAYS:
            view = getattr(self, name).view()
            _check_kernels(name, view, len(self.hinge_mean))
            view.flags.writeable = False  # kernels are shared between threads
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.hinge_mean)

    @property
    def gamma(self) -> Float32:
        """(K,) 1/m^2: the mean of each kernel's Gamma distribution."""
        return self.gamma_shape / self.gamma_rate

    def take(self, index: NDArray[np.intp] | Bool | slice) -> KernelSet:
        """The kernels that a numpy index picks."""
        return KernelSet._checked({name: getattr(self, name)[index] for name in KERNEL_ARRAYS})

    def replace(self, **arrays: NDArray[np.floating]) -> KernelSet:
        """A copy with some arrays exchanged.

        Raises:
            ShapeError: as on construction.
        """
        for name, array in arrays.items():
            _check_kernels(name, array, len(self))
        views = {name: array.view() for name, array in arrays.items()}
        return KernelSet._checked({name: getattr(self, name) for name in KERNEL_ARRAYS} | views)

    def moved(self, by_m: Float64) -> KernelSet:
        """The same kernels in a frame whose origin lies at -`by_m`, (3,) m, of this one."""
        arrays = {name: getattr(self, name) for name in KERNEL_ARRAYS}
        return KernelSet._checked(arrays | {"hinge_mean": self.hinge_mean + by_m})

    @staticmethod
    def concatenate(sets: list[KernelSet]) -> KernelSet:
        """One set of all kernels, in order; no sets give the empty set."""
        if not sets:
            return KernelSet.empty()
        return KernelSet._checked(
            {name: np.concatenate([getattr(s, name) for s in sets]) for name in KERNEL_ARRAYS}
        )

    @staticmethod
    def _checked(arrays: dict[str, NDArray[np.floating]]) -> KernelSet:
        """A set of rows of sets that were checked before: cutting tiles makes hundreds of them a scan."""
        new = object.__new__(KernelSet)
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(new, name, array)
        return new

    @staticmethod
    def of(record: Any) -> KernelSet:
        """The kernels of a record that has arrays of the same names.

        Raises:
            ShapeError: as on construction.
        """
        return KernelSet(**{name: getattr(record, name) for name in KERNEL_ARRAYS})

    @staticmethod
    @cache
    def empty() -> KernelSet:
        """No kernels."""
        z = np.zeros(0, np.float32)
        return KernelSet(
            hinge_mean=np.zeros((0, 3)),
            hinge_var=np.zeros((0, 3), np.float32),
            gamma_shape=z,
            gamma_rate=z,
            weight_mean=z,
            weight_var=z,
        )


KERNEL_ARRAYS = tuple(field.name for field in dataclasses.fields(KernelSet))  # by name


def _check_kernels(name: str, array: NDArray[np.floating], k: int) -> None:
    """One array of K kernels."""
    shape = (k, 3) if name in ("hinge_mean", "hinge_var") else (k,)
    if array.shape != shape:
        raise ShapeError(f"{name}: {array.shape}, need {shape}")
    if not np.isfinite(array).all():
        raise ShapeError(f"{name}: NaN or infinite values")
    if name in ("gamma_shape", "gamma_rate") and (array <= 0).any():
        raise ShapeError("gamma_shape and gamma_rate must be > 0")
    if name in ("weight_var", "hinge_var") and (array < 0).any():
        raise ShapeError("variances must be >= 0")


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Atom:
    """A source sector: its points and the kernels learned on them. Frame: sensor at the origin, x along the bisector."""

    atom_id: str
    dims: int  # 2 or 3
    hit_points: Float32  # (H, 3) m, atom frame
    free_points: Float32  # (F, 3) m, atom frame
    kernels: KernelSet  # atom frame
    radius_m: float
    azimuth_width_rad: float
    provenance: dict[str, str]

    def __post_init__(self) -> None:
        for name in ("hit_points", "free_points"):
            points = getattr(self, name)
            if points.ndim != 2 or points.shape[1] != 3:
                raise ShapeError(f"atom {self.atom_id}: {name} has shape {points.shape}, need (N, 3)")
            if not np.isfinite(points).all():
                raise BadPointsError(f"atom {self.atom_id}: {name} has NaN or infinite coordinates")
        if len(self.hit_points) + len(self.free_points) == 0:
            raise EmptyError(f"atom {self.atom_id} has no points: nothing could be matched to it")
        if self.dims not in (2, 3):
            raise ShapeError(f"atom {self.atom_id}: {self.dims} dimensions, need 2 or 3")

    @property
    def centre(self) -> Float64:
        """(3,) m: the mean of its hits, or of its free points where it has no hits."""
        points = self.hit_points if len(self.hit_points) else self.free_points
        return points.mean(axis=0, dtype=np.float64)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Sector:
    """A pie slice of one scan (a cylindrical sector in 3D); its frame: origin at the sensor, levelled, x along the bisector."""

    azimuth_min_rad: float  # about the sensor, in the levelled sensor frame
    azimuth_max_rad: float
    radius_m: float
    hit_points: Float32  # (M, 3) m, sector frame
    free_points: Float32  # (F, 3) m, sector frame
    T_map_sector: Float64  # (4, 4)


class SectorMatch(NamedTuple):
    """Which atom served a sector, and how the transport ended."""

    azimuth_min_rad: float
    azimuth_max_rad: float
    n_hits: int
    n_free: int
    atom_id: str | None
    rotation_rad: float
    w2_m2: float
    n_kernels: int
    converged: bool
    marginal_error: float
    n_iterations: int
    reason: str | None = None


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Occupancy:
    """What a map says at N points, in the order asked."""

    mean: Float64  # (N,) P(occupied)
    var: Float64  # (N,) variance of that probability: its squared error as expected, in [0, 0.25]
    latent_mean: Float32  # (N,) log-odds
    latent_var: Float32  # (N,) log-odds^2
    observed: Bool  # (N,) false = no kernel near: unknown, not free
    borrowed: Float32  # (N,) in [0, 1]: the share of the answer that is what the dictionary expects, and not evidence
    map_revision: int = 0
    gradient: Float64 | None = None  # (N, 3) 1/m, of `mean`; 0 where nothing is known; none unless asked for
    latent_gradient: Float64 | None = None  # (N, 3) log-odds/m, of `latent_mean`; likewise

    @staticmethod
    def concatenate(parts: list[Occupancy]) -> Occupancy:
        """Answers of one map at the points of all parts, in order; at least one part."""
        if len(parts) == 1:
            return parts[0]
        columns: dict[str, Any] = {
            field.name: np.concatenate([getattr(part, field.name) for part in parts])
            for field in dataclasses.fields(Occupancy)
            if isinstance(getattr(parts[0], field.name), np.ndarray)
        }
        return Occupancy(map_revision=parts[0].map_revision, **columns)


class Unknown(str, Enum):
    """What rays and robots take unobserved space for."""

    OCCUPIED = "occupied"  # it stops a ray, and touching it is a collision
    FREE = "free"  # as if nothing were there
    PRIOR = "prior"  # as the map answers for it: what is expected there, or occupied with probability 0.5


class TileChange(NamedTuple):
    """Which cubes of the map a scan touched."""

    tile_size_m: float
    tiles: list[tuple[int, int, int]]  # floor(p_map / tile_size_m)


class Borrowed(NamedTuple):
    """A part of the dictionary that fitted kernels lean on, and where it was put."""

    name: str
    weight: float  # share of what is expected
    displacement: Float64  # (3,) m, map frame: of its origin
    slope: tuple[float, float]  # of the ground along x and y
    scale: float  # of its log-odds, in (0, 1]


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OwnMap:
    """What one scan says by itself, its instantaneous map: this goes back to the sender."""

    kernels: KernelSet  # hinges relative to `origin`, along the map's axes
    origin: Float64  # (3,) m, map frame
    spacings_m: tuple[float, ...] = ()  # of the lattices that all kernels stand on; none: they were carried
    size_m: float = 0.0  # edge of the cube at `origin` that holds those lattices
    lean: LeanTiles | None = None  # what the kernels' sums are added to
    borrowed: tuple[Borrowed, ...] = ()  # what that comes from
    sectors: tuple[SectorMatch, ...] = ()  # how each was served; of carried kernels
    converged: bool = True

    is_nothing: bool = False  # nobody wanted any

    @staticmethod
    def nothing() -> OwnMap:
        """That of a scan whose sender wants none."""
        return OwnMap(kernels=KernelSet.empty(), origin=np.zeros(3), is_nothing=True)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MapUpdate:
    """What one integrated scan did."""

    map_revision: int
    own: OwnMap
    n_points: int  # beams used
    n_kernels_added: int  # that the overall map took, of both kinds
    # of those, carried from atoms; the others were placed where nothing explained the data
    n_kernels_transported: int
    map_kernels: int
    converged: bool  # neither joint solve got stuck; if one did, its weights are the best found
    rule: AnswerRule  # what turns the kernels of `own` into answers
    changed: TileChange
    timings_ms: dict[str, float]  # per stage of the pipeline
    leans_on: str | None = None  # what in the dictionary is expected about this scan
    foretold: float | None = None  # how well that foretells the scan's own beams, in (0, 1]
    not_leaning: str | None = (
        None  # why the map leans on nothing about this scan; none: it does, nobody asked, or never would
    )

    @property
    def kernels(self) -> KernelSet:
        """The scan's own map, map frame."""
        return self.own.kernels.moved(self.own.origin)

    @property
    def sectors(self) -> tuple[SectorMatch, ...]:
        """Which atoms served them; of transported parameters."""
        return self.own.sectors


def yaw_pose(x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> Float64:
    """(4, 4) pose of a planar robot."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, z_m], [0, 0, 0, 1]], np.float64)
