"""Learn atoms from scans: an automorphing Bayesian Hilbert map (ABHM) of each sector, started on a lattice over its data."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from potserver.domain.types import Atom, Bool, Float32, Float64, KernelSet, Scan
from potserver.errors import EmptyError, SettingsError, ShapeError, SolverError
from potserver.mapping.sectors import SectorCut, sector_frames
from potserver.numerics.abhm import AbhmEpoch, AbhmOptions, AbhmPosterior, AbhmStart, fit_abhm
from potserver.numerics.beams import label_beams, limit_range
from potserver.numerics.geometry import thin, voxel_pick

# length scale that a kernel starts with; narrower ones cannot bridge the gaps between rings
_LENGTH_IN_SPACINGS = 1.0
_KEPT_VOXEL_M = 0.2  # an atom keeps at most one point of each label in such a voxel


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class LearningSettings:
    """How atoms are cut and learned."""

    n_sectors: int = 6
    min_range_m: float = 0.3
    max_range_m: float = 25.0
    free_per_beam: int = 3  # a beam's free samples count together as much as its hit
    gap_m: float = 0.3
    max_labelled: int = 10_000  # points a sector is learned from
    max_points: int = 500  # of each label that the atom keeps
    min_hits: int = 40  # sectors with fewer make no atom
    max_kernels: int = 400  # of an atom
    points_per_kernel: int = 8  # at least; sectors with few points get fewer kernels
    # of the ABHM; see numerics/abhm
    weight_var: float = 200.0  # log-odds^2
    hinge_reach: float = 1.0
    gamma_shape: float = 2.0
    max_epochs: int = 10
    dispersion_epochs: int = 4
    steps: int = 60
    batch: int = 2_000
    learning_rate: float = 0.1

    def __post_init__(self) -> None:
        for name in (
            "n_sectors",
            "free_per_beam",
            "max_labelled",
            "max_points",
            "max_kernels",
            "points_per_kernel",
        ):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.gap_m >= 0.0:
            raise SettingsError(f"gap_m must be at least 0, got {self.gap_m}")
        if not 0.0 <= self.min_range_m < self.max_range_m:
            raise SettingsError(
                f"need 0 <= min_range_m ({self.min_range_m}) < max_range_m ({self.max_range_m})"
            )
        try:
            self.abhm  # noqa: B018 - it checks the rest
        except ShapeError as error:
            raise SettingsError(str(error)) from error

    @property
    def abhm(self) -> AbhmOptions:
        """What the numerics need of these."""
        own, wanted = ({f.name for f in dataclasses.fields(kind)} for kind in (self, AbhmOptions))
        return AbhmOptions(**{name: getattr(self, name) for name in own & wanted})


class LabelledSector(NamedTuple):
    """What scans say about one sector."""

    number: int
    width_rad: float
    points: Float64  # (N, 3) m, hits and free samples in the sector's frame: sensor at the origin, x along the bisector
    occupied: Bool  # (N,)


def cut_sectors(
    scans: Sequence[Scan], settings: LearningSettings, rng: np.random.Generator
) -> list[LabelledSector]:
    """All sectors about the first scan's sensor, with the labels of all scans."""
    points, occupied = [], []
    for scan in scans:
        beams = limit_range(scan.beams, settings.min_range_m, settings.max_range_m)
        labelled = label_beams(beams, free_per_beam=settings.free_per_beam, gap_m=settings.gap_m, rng=rng)
        points.append(labelled.points + (scan.origin - scans[0].origin))
        occupied.append(labelled.occupied)
    where, labels = np.concatenate(points), np.concatenate(occupied)
    sectors = []
    for frame in sector_frames(scans[0].T_map_sensor, settings.max_range_m, SectorCut(settings.n_sectors)):
        inside = frame.inside(where)
        sectors.append(
            LabelledSector(frame.number, frame.width_rad, frame.local(where[inside]), labels[inside])
        )
    return sectors


class SectorEpoch(NamedTuple):
    """Where learning one sector stands."""

    sector: int
    epoch: AbhmEpoch  # kernels in the atom's frame


def learn_atoms(
    scans: Scan | Sequence[Scan],
    name: str,
    settings: LearningSettings,
    provenance: dict[str, str],
    *,
    seed: int = 0,
    threads: int = 1,
    on_epoch: Callable[[SectorEpoch], None] | None = None,
    on_failure: Callable[[int, SolverError], None] | None = None,
) -> list[Atom]:
    """One atom for each sector about the first scan that has enough hits.

    Args:
        scans: One scan, or several of one place that are learned together; the first one's pose gives the sectors.
        name: Prefix of the atom ids.
        settings: How.
        provenance: Copied into every atom, with what this function adds: sector, learner and how it ended.
        seed: Of the free samples, of every subsample and of the learner.
        threads: Of the learner.
        on_epoch: Called with every epoch of every sector.
        on_failure: Called with the number of a sector whose learning diverged, which then makes no atom; without it the
            error is raised.
    Raises:
        EmptyError: no scans.
        SettingsError: the seed is negative.
        SolverError: a sector's learning diverged, and nobody asked to be told.
    """
    window = [scans] if isinstance(scans, Scan) else list(scans)
    if not window:
        raise EmptyError("no scans to learn from")
    if seed < 0:
        raise SettingsError(f"seed must be at least 0, got {seed}")
    rng = np.random.default_rng(seed)
    atoms = []
    for number, width_rad, local, labels in cut_sectors(window, settings, rng):
        if int(labels.sum()) < settings.min_hits:
            continue
        sector_seed = seed * settings.n_sectors + number
        watch = functools.partial(_tell, on_epoch, number) if on_epoch else None
        try:
            learned = learn_kernels(
                local, labels, settings, seed=sector_seed, threads=threads, on_epoch=watch
            )
        except SolverError as error:
            if on_failure is None:
                raise
            on_failure(number, error)
            continue
        atoms.append(
            Atom(
                atom_id=f"{name}-s{number}",
                dims=2 if window[0].is_planar else 3,
                hit_points=_keep(local[labels], settings.max_points, rng),
                free_points=_keep(local[~labels], settings.max_points, rng),
                kernels=KernelSet.of(learned),
                radius_m=settings.max_range_m,
                azimuth_width_rad=width_rad,
                provenance=provenance
                | {
                    "sector": str(number),
                    "scans": str(len(window)),
                    "learner": "ABHM, collapsed weights",
                    "learner_epochs": str(len(learned.objectives) - 1),
                    "learner_converged": str(learned.converged).lower(),
                    "nats_per_point": f"{learned.objectives[-1]:.4f}",
                },
            )
        )
    return atoms


def _tell(on_epoch: Callable[[SectorEpoch], None], number: int, epoch: AbhmEpoch) -> None:
    on_epoch(SectorEpoch(number, epoch))


def learn_kernels(
    points: Float64,
    occupied: Bool,
    settings: LearningSettings,
    *,
    seed: int = 0,
    threads: int = 1,
    on_epoch: Callable[[AbhmEpoch], None] | None = None,
) -> AbhmPosterior:
    """The ABHM of one sector's labelled points, of which at most `max_labelled` are drawn.

    Args:
        points: (N, 3) m, hits and free samples.
        occupied: (N,) labels.
        settings: How.
        seed, threads, on_epoch: As for `fit_abhm`.
    Raises:
        SettingsError: the seed is negative.
    """
    if seed < 0:
        raise SettingsError(f"seed must be at least 0, got {seed}")
    if len(points) > settings.max_labelled:
        drawn = np.random.default_rng(seed).choice(len(points), settings.max_labelled, replace=False)
        points, occupied = points[drawn], occupied[drawn]
    n_kernels = max(1, min(settings.max_kernels, len(points) // settings.points_per_kernel))
    hinge, gamma = lattice(points, n_kernels)
    return fit_abhm(
        points, occupied, AbhmStart(hinge, gamma), settings.abhm,
        sample_weight=beam_weights(occupied, settings.free_per_beam), seed=seed, threads=threads, on_epoch=on_epoch,
    )  # fmt: skip


def beam_weights(occupied: Bool, free_per_beam: int) -> Float32:
    """(N,) weights by which a beam's free samples count together as much as its hit; 1 on average."""
    weight = np.where(occupied, 1.0, 1.0 / free_per_beam)
    return (weight / weight.mean()).astype(np.float32)


def lattice(points: Float64, n_kernels: int) -> tuple[Float64, Float64]:
    """Hinges (K, 3), m, and gammas (K,), 1/m^2, on the finest cubic lattice that has at most `n_kernels` cells with points.

    Cells start at the points' lower corner, so that one kernel is enough if only one is wanted. Points of one plane give
    hinges in that plane.
    """
    lower, extent = points.min(axis=0), np.ptp(points, axis=0)
    flat = extent == 0.0
    coarse = 1.001 * max(float(extent.max()), 1e-3)  # one cell holds them all
    fine = coarse / 1024.0
    for _ in range(24):  # bisection of the spacing
        spacing = (coarse * fine) ** 0.5
        if len(voxel_pick(points - lower, spacing)) > n_kernels:
            fine = spacing
        else:
            coarse = spacing
    picked = voxel_pick(points - lower, coarse)
    hinge = lower + (np.floor((points[picked] - lower) / coarse) + 0.5) * coarse
    hinge[:, flat] = points[0, flat]
    return hinge, np.full(len(hinge), 0.5 / (_LENGTH_IN_SPACINGS * coarse) ** 2)


def _keep(points: Float64, n: int, rng: np.random.Generator) -> Float32:
    """At most `n` points that cover the set evenly: one a voxel, then farthest-first."""
    import open3d  # it takes seconds to load, and only learning needs it

    picked = points[thin(points, len(points), _KEPT_VOXEL_M, rng)]
    if len(picked) > n:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(picked))
        picked = np.asarray(cloud.farthest_point_down_sample(n).points)
    return picked.astype(np.float32)
