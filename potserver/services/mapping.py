"""MappingService: a scan comes in, atoms are carried to it, the map grows (paper, Algorithm 1)."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import (
    Float64,
    KernelSet,
    MapUpdate,
    Scan,
    Sector,
    SectorMatch,
    TileChange,
    yaw_pose,
)
from potserver.errors import EmptyError
from potserver.numerics.beams import Beams, LabelledPoints, label_beams, limit_range
from potserver.numerics.geometry import in_sector, rotation_z, sector_edges, voxel_pick, yaw_of
from potserver.numerics.kernel_index import sparse_features
from potserver.numerics.threads import default_threads, parallel_map
from potserver.services.matching import Match, Matcher
from potserver.services.refinement import Refined, activation, fill_kernels, is_fine, is_too_wide, refine
from potserver.services.settings import MappingSettings
from potserver.services.transport import Transported, transport


class MappingService:
    """One map. `integrate` and `clear` have one caller at a time; `snapshot` may be read from any thread, and never waits."""

    def __init__(
        self,
        dictionary: AtomDictionary | None = None,
        settings: MappingSettings | None = None,
        *,
        map_id: str = "default",
        threads: int | None = None,
        seed: int = 0,
    ) -> None:
        """Start an empty map.

        Args:
            dictionary: Atoms, 2D and 3D; the built-in ones by default.
            settings: The `default` profile by default.
            map_id: Name of the map.
            threads: Threads that integrating one scan may use; all processors by default.
            seed: Of every random choice; the same scans in the same order give the same map, up to rounding.
        """
        self.map_id = map_id
        self.dictionary = dictionary if dictionary is not None else AtomDictionary.builtin()
        self.settings = settings or MappingSettings()
        self.n_scans = 0
        self.atom_usage: Counter[str] = Counter()
        self._threads = threads or default_threads()
        self._seed = seed
        self._matchers = {
            dims: Matcher(self.dictionary.of_dims(dims), self.settings, threads=self._threads, seed=seed)
            for dims in (2, 3)
        }
        self.snapshot = self._map_of(KernelSet.empty(), revision=0)

    def integrate(self, scan: Scan) -> MapUpdate:
        """Carry atoms to a scan and add it to the map.

        Raises:
            EmptyError: no beam lies within the range limits. The map is unchanged, as after any error.
        """
        clock = _Stopwatch()
        rng = np.random.default_rng((self._seed, self.n_scans))
        with clock("label"):
            beams = self._beams(scan, rng)
            labelled = label_beams(
                beams, free_per_beam=self.settings.free_per_beam, gap_m=self.settings.gap_m, rng=rng
            )
            sectors = self._cut_sectors(labelled, scan)
        with clock("match"):
            matches = self._matchers[2 if scan.is_planar else 3].match(sectors)
        with clock("transport"):
            transported = self._transport(matches, sectors)
        carried = KernelSet.concatenate([t.kernels for t in transported if t is not None])
        in_map = labelled._replace(points=labelled.points + scan.origin)
        if self.settings.refine:
            with clock("refine"):
                prior = carried.replace(
                    weight_var=carried.weight_var + np.float32(self.settings.borrowed_var)
                )
                instantaneous, solved = self._refine(prior, in_map, self.settings.instant_tolerance)
            with clock("fuse"):
                fused = self._fuse(prior, in_map, rng)
        else:
            instantaneous, solved = carried, True
            appended = KernelSet.concatenate([self.snapshot.kernels, carried])
            fused = _Fused(appended, len(carried), len(carried), True)
        with clock("index"):
            snapshot = self._map_of(fused.kernels, revision=self.snapshot.map_revision + 1)
        update = MapUpdate(
            map_revision=snapshot.map_revision,
            kernels=instantaneous,
            sectors=[_report(s, m, t) for s, m, t in zip(sectors, matches, transported, strict=True)],
            n_points=len(beams.ends),
            n_kernels_added=fused.n_added,
            n_kernels_transported=fused.n_transported,
            map_kernels=len(snapshot),
            converged=solved and fused.converged,
            rule=snapshot.rule,
            changed=self._touched(in_map.points),
            timings_ms=clock.timings_ms,
        )
        # nothing above changed the service, and nothing below can fail
        self.atom_usage.update(match.atom_id for match in update.sectors if match.atom_id is not None)
        self.n_scans += 1
        self.snapshot = snapshot
        return update

    def clear(self) -> None:
        """Forget all scans; the revision and the use of atoms go on counting, so that readers notice."""
        self.snapshot = self._map_of(KernelSet.empty(), revision=self.snapshot.map_revision + 1)
        self.n_scans = 0

    def warm_up(self) -> None:
        """Compile or load the numerics on small synthetic scans, in a map of its own."""
        rng = np.random.default_rng(0)
        for planar in (False, True):
            scratch = MappingService(self.dictionary, self.settings, threads=self._threads)
            angle = rng.uniform(-np.pi, np.pi, 4000)
            height = np.zeros(4000) if planar else rng.uniform(-1.5, 3.0, 4000)
            points = np.stack([8.0 * np.cos(angle), 6.0 * np.sin(angle), height], axis=1).astype(np.float32)
            for k in range(2):
                pose = yaw_pose(0.3 * k, 0.0, 0.0)
                scratch.integrate(Scan(points=points, T_map_sensor=pose, is_planar=planar))
            scratch.snapshot.occupancy(points)

    # --- the steps, in order ---------------------------------------------------------------------------------------------

    def _beams(self, scan: Scan, rng: np.random.Generator) -> Beams:
        """The scan's beams, limited in range and number."""
        beams = limit_range(scan.beams, self.settings.min_range_m, self.settings.max_range_m)
        n = len(beams.ends)
        if n == 0:
            raise EmptyError(
                f"none of {len(scan.points)} beams is longer than {self.settings.min_range_m} m: nothing to learn from"
            )
        if n > self.settings.beams_per_scan:
            drawn = np.sort(rng.choice(n, self.settings.beams_per_scan, replace=False))
            beams = Beams(beams.ends[drawn], beams.is_return[drawn])
        return beams

    def _cut_sectors(self, labelled: LabelledPoints, scan: Scan) -> list[Sector]:
        """Cylindrical sectors about the vertical through the sensor, the first one centred on the sensor's heading."""
        heading = yaw_of(scan.T_map_sensor)
        radius = self.settings.max_range_m
        edges = sector_edges(self.settings.n_sectors)
        sectors = []
        for low, high in itertools.pairwise(edges):
            members = in_sector(labelled.points, heading + low, heading + high, radius)
            turn = heading + (low + high) / 2.0 if self.settings.align_sectors else 0.0
            rotation = rotation_z(turn)
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation, scan.origin
            local = (labelled.points @ rotation).astype(np.float32)  # R^T p, row by row
            sectors.append(
                Sector(
                    azimuth_min_rad=float(heading + low - turn),
                    azimuth_max_rad=float(heading + high - turn),
                    radius_m=radius,
                    hit_points=local[members & labelled.occupied],
                    free_points=local[members & ~labelled.occupied],
                    T_map_sector=T,
                )
            )
        return sectors

    def _transport(self, matches: list[Match | None], sectors: list[Sector]) -> list[Transported | None]:
        def run(i: int) -> Transported | None:
            match = matches[i]
            return None if match is None else transport(match, sectors[i], self.settings, seed=self._seed + i)

        return parallel_map(run, range(len(sectors)), self._threads)

    def _fuse(self, carried: KernelSet, labelled: LabelledPoints, rng: np.random.Generator) -> _Fused:
        """The overall map after a scan: kernels where the data ask for them, all weights near the scan solved jointly."""
        s = self.settings
        present = self.snapshot.kernels
        lower, upper = labelled.points.min(axis=0) - 3.0, labelled.points.max(axis=0) + 3.0
        near = ((present.hinge_mean >= lower) & (present.hinge_mean <= upper)).all(axis=1)
        local = present.take(near)
        # a transported kernel is taken where the scan has data for it and the map has no kernel yet; one much wider than the
        # map's own would only make the solve harder
        carried = carried.take(~is_too_wide(carried, s))
        if len(carried):
            supported = self._support(carried, labelled, rng) >= 1.0
            carried = carried.take(supported)
        if len(carried) and len(local):
            present_activation = np.empty(len(carried), np.float32)
            for scale in (False, True):
                members = is_fine(carried, s) == scale
                same = local.take(is_fine(local, s) == scale)
                present_activation[members] = activation(
                    same, carried.hinge_mean[members], threads=self._threads
                )
            carried = carried.take(present_activation < s.explained_activation)
        filled = fill_kernels(labelled, KernelSet.concatenate([local, carried]), s, threads=self._threads)
        new = KernelSet.concatenate([carried, filled])
        refined, converged = self._refine(KernelSet.concatenate([local, new]), labelled, s.refine_tolerance)
        everything = KernelSet.concatenate([present.take(~near), refined])
        return _Fused(everything, len(new), len(carried), converged)

    def _refine(self, kernels: KernelSet, labelled: LabelledPoints, tolerance: float) -> Refined:
        cut = self.settings.feature_cut
        return refine(kernels, labelled, feature_cut=cut, tolerance=tolerance, threads=self._threads)

    def _support(self, kernels: KernelSet, labelled: LabelledPoints, rng: np.random.Generator) -> np.ndarray:
        """(K,) about how many labelled points each kernel has, each counted by its activation; from one point in four."""
        features = sparse_features(
            labelled.points[rng.random(len(labelled.points)) < 0.25],
            kernels.hinge_mean,
            kernels.gamma,
            cut=0.1,
            threads=self._threads,
        )
        return 4.0 * np.bincount(features.indices, features.values, len(kernels))

    def _touched(self, points: Float64) -> TileChange:
        size = self.settings.tile_size_m
        tiles = np.floor(points[voxel_pick(points, size)] / size).astype(np.int64)
        return TileChange(size, [(int(x), int(y), int(z)) for x, y, z in tiles])

    def _map_of(self, kernels: KernelSet, *, revision: int) -> KernelMap:
        return KernelMap(
            kernels, observed_activation=self.settings.observed_activation, prior_var=self.settings.prior_var,
            residual_var=self.settings.residual_var, map_revision=revision, threads=self._threads,
        )  # fmt: skip


class _Fused(NamedTuple):
    kernels: KernelSet  # of the whole map
    n_added: int
    n_transported: int  # of those added
    converged: bool


def _report(sector: Sector, match: Match | None, transported: Transported | None) -> SectorMatch:
    turn = yaw_of(sector.T_map_sector)
    reason = None
    if match is None or transported is None:
        reason = (
            "nothing in the sector"
            if len(sector.hit_points) + len(sector.free_points) == 0
            else "no atom could be compared"
        )
    elif not transported.converged:
        reason = "the coupling did not converge"
    return SectorMatch(
        azimuth_min_rad=sector.azimuth_min_rad + turn,
        azimuth_max_rad=sector.azimuth_max_rad + turn,
        n_hits=len(sector.hit_points),
        n_free=len(sector.free_points),
        atom_id=None if match is None or reason else match.atom.atom_id,
        rotation_rad=0.0 if match is None else match.rotation_rad,
        w2_m2=float("inf") if match is None else match.w2_m2,
        n_kernels=0 if transported is None else len(transported.kernels),
        converged=transported is not None and transported.converged,
        marginal_error=float("nan") if transported is None else transported.marginal_error,
        n_iterations=0 if transported is None else transported.n_iterations,
        reason=reason,
    )


class _Stopwatch:
    def __init__(self) -> None:
        self.timings_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.timings_ms[stage] = (time.perf_counter() - start) * 1e3
