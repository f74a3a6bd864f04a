"""Learn atoms from scans: a Bayesian logistic regression of weights on kernels placed on the data of each sector."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, Float32, Float64, KernelSet, Scan
from potserver.errors import EmptyError, SettingsError, SolverError
from potserver.numerics.beams import label_beams, limit_range
from potserver.numerics.coupling import Ragged, coupling_costs
from potserver.numerics.geometry import in_sector, rotation_z, sector_edges, thin, yaw_of
from potserver.numerics.logistic import fit_dense
from potserver.services.refinement import place_kernels


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class LearningSettings:
    """How atoms are cut and learned."""

    n_sectors: int = 6
    min_range_m: float = 0.3
    max_range_m: float = 25.0
    free_per_beam: int = 3
    gap_m: float = 0.3
    coarse_m: float = 2.0  # kernel spacing anywhere
    fine_m: float = 0.7  # kernel spacing at hits
    max_labelled: int = 6_000  # points a sector is learned from
    max_points: int = 500  # of each label that the atom keeps
    min_hits: int = 40  # sectors with fewer make no atom
    prior_vars: tuple[float, ...] = (10.0, 30.0, 100.0)  # the log evidence picks one


def learn_atoms(
    scan: Scan, name: str, settings: LearningSettings, provenance: dict[str, str], *, seed: int = 0
) -> list[Atom]:
    """One atom for each sector of a scan that has enough hits.

    Args:
        scan: Its pose gives the vertical; the map frame is of no other use.
        name: Prefix of the atom ids.
        settings: How.
        provenance: Copied into every atom, with what this function adds: sector, learner, evidence.
        seed: Of the free samples and of every subsample.
    """
    rng = np.random.default_rng(seed)
    beams = limit_range(scan.beams, settings.min_range_m, settings.max_range_m)
    labelled = label_beams(beams, free_per_beam=settings.free_per_beam, gap_m=settings.gap_m, rng=rng)
    heading = yaw_of(scan.T_map_sensor)
    edges = sector_edges(settings.n_sectors)
    atoms = []
    for number, (low, high) in enumerate(itertools.pairwise(edges)):
        members = in_sector(labelled.points, heading + low, heading + high, settings.max_range_m)
        points = labelled.points[members] @ rotation_z(heading + (low + high) / 2.0)
        occupied = labelled.occupied[members]
        if int(occupied.sum()) < settings.min_hits:
            continue
        if len(points) > settings.max_labelled:
            drawn = rng.choice(len(points), settings.max_labelled, replace=False)
            points, occupied = points[drawn], occupied[drawn]
        kernels, prior_var, evidence = _learn(points, occupied, settings)
        hits, free = points[occupied], points[~occupied]
        atoms.append(
            Atom(
                atom_id=f"{name}-s{number}",
                dims=2 if scan.is_planar else 3,
                hit_points=_keep(hits, settings.max_points, rng),
                free_points=_keep(free, settings.max_points, rng),
                kernels=kernels,
                radius_m=settings.max_range_m,
                azimuth_width_rad=float(high - low),
                provenance=provenance
                | {
                    "sector": str(number),
                    "learner": f"Laplace, kernels every {settings.coarse_m} m and every {settings.fine_m} m at hits",
                    "prior_var": f"{prior_var:g}",
                    "log_evidence_per_point": f"{evidence / len(points):.4f}",
                },
            )
        )
    return atoms


def _learn(
    points: Float64, occupied: np.ndarray, settings: LearningSettings
) -> tuple[KernelSet, float, float]:
    placed = KernelSet.concatenate(
        [place_kernels(points, settings.coarse_m, 1.0), place_kernels(points[occupied], settings.fine_m, 1.0)]
    )
    d2 = np.square(points[:, None, :] - placed.hinge_mean[None]).sum(axis=2)
    phi = np.exp(-placed.gamma.astype(np.float64) * d2)
    k = len(placed)
    fits = [(v, fit_dense(phi, occupied, np.zeros(k), np.full(k, v))) for v in settings.prior_vars]
    solved = [fit for fit in fits if fit[1].converged]
    if not solved:
        raise SolverError(
            f"no prior variance of {settings.prior_vars} let the weights of {k} kernels converge"
        )
    prior_var, best = max(solved, key=lambda fit: fit[1].log_evidence)
    kernels = placed.replace(weight_mean=best.mean.astype(np.float32), weight_var=best.var.astype(np.float32))
    return kernels, prior_var, best.log_evidence


def _keep(points: Float64, n: int, rng: np.random.Generator) -> Float32:
    """At most `n` points that cover the set evenly: one a voxel, then farthest-first."""
    import open3d  # here and not above: it takes seconds to load, and only learning needs it

    picked = points[thin(points, len(points), 0.2, rng)]
    if len(picked) > n:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(picked))
        picked = np.asarray(cloud.farthest_point_down_sample(n).points)
    return picked.astype(np.float32)


def choose_diverse(atoms: list[Atom], n: int, *, threads: int = 1) -> AtomDictionary:
    """Farthest-first choice of `n` atoms under the squared 2-Wasserstein distance of hits plus that of free points.

    Raises:
        EmptyError: no atoms to choose from.
        SettingsError: n is not positive.
    """
    if not atoms:
        raise EmptyError("no sector had enough hits to make an atom")
    if n < 1:
        raise SettingsError(f"cannot choose {n} atoms")
    rng = np.random.default_rng(0)
    distance = np.zeros((len(atoms), len(atoms)))
    pairs = np.stack(
        np.meshgrid(np.arange(len(atoms)), np.arange(len(atoms)), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    for points_of, count in ((lambda a: a.hit_points, 100), (lambda a: a.free_points, 60)):
        sets = []
        for atom in atoms:
            points = points_of(atom)
            centred = points - atom.hit_points.mean(axis=0)
            sets.append(centred[thin(centred, count, 0.4, rng)].astype(np.float32))
        packed = Ragged.of(sets)
        solved = coupling_costs(packed, packed, pairs, reg=2.0, tolerance=1e-3, threads=threads)
        distance += np.where(solved.converged, solved.cost, np.inf).reshape(distance.shape)
    # the most typical atom first, then whatever is farthest from all chosen so far
    chosen = [int(distance.mean(axis=1).argmin())]
    while len(chosen) < min(n, len(atoms)):
        nearest = distance[:, chosen].min(axis=1)
        nearest[chosen] = -np.inf
        chosen.append(int(nearest.argmax()))
    return AtomDictionary(tuple(atoms[i] for i in sorted(chosen)))
