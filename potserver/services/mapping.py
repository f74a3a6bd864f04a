"""MappingService: a scan comes in, atoms are carried to it, the map grows (paper, Algorithm 1)."""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import IndexedKernels, KernelMap
from potserver.domain.tiles import TiledMap
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
from potserver.numerics import evidence
from potserver.numerics.beams import Beams, LabelledPoints, beam_weights, label_beams, limit_range
from potserver.numerics.geometry import in_sector, rotation_z, sector_edges, yaw_of
from potserver.numerics.threads import default_threads, parallel_map
from potserver.services.fusion import Fused, fuse, grid_for
from potserver.services.matching import Match, Matcher
from potserver.services.refinement import Refined, refine
from potserver.services.settings import MappingSettings
from potserver.services.transport import Transported, transport

_INSTANT_VOXEL = 2.0  # resolutions: the free points of such a voxel are one datum of the instantaneous map; hits in half of it


class MappingService:
    """One map. `integrate` and `clear` have one caller at a time; `snapshot` may be read from any thread, and never waits.

    `use_dictionary` may be called from any thread: the next scan sees the change, one in work does not.
    """

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
        self.settings = settings or MappingSettings()
        self.n_scans = 0
        self.atom_usage: Counter[str] = Counter()
        self._threads = threads or default_threads()
        self._seed = seed
        self.use_dictionary(dictionary if dictionary is not None else AtomDictionary.builtin())
        self._tiled: TiledMap | None = None  # what the next scan builds on; its grid is chosen by the first
        self.snapshot = self._map_of(KernelSet.empty(), revision=0)

    @property
    def dictionary(self) -> AtomDictionary:
        """The atoms that the next scan is matched against."""
        return self._atoms.dictionary

    def use_dictionary(self, dictionary: AtomDictionary) -> None:
        """Match against other atoms from the next scan on; the map keeps what it has."""
        matchers = {
            dims: Matcher(dictionary.of_dims(dims), self.settings, threads=self._threads, seed=self._seed)
            for dims in (2, 3)
        }
        self._atoms = _AtomsInUse(dictionary, matchers)  # one assignment: no scan sees a half of it

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
            drawn = self._draw(labelled, len(beams.ends), rng)
            sectors = self._cut_sectors(drawn, scan)
        with clock("match"):
            matches = self._atoms.matchers[2 if scan.is_planar else 3].match(sectors)
        with clock("transport"):
            transported = self._transport(matches, sectors)
        carried = KernelSet.concatenate([t.kernels for t in transported if t is not None])
        in_map = labelled._replace(points=labelled.points + scan.origin)
        if self.settings.refine:
            tiled = self._tiled or TiledMap.empty(grid_for(beams, self.settings))
            prior = carried.replace(weight_var=carried.weight_var + np.float32(self.settings.borrowed_var))
            with clock("refine"):
                instantaneous = self._refine(prior, in_map, _INSTANT_VOXEL * tiled.grid.fine_m)
            with clock("fuse"):
                fused = fuse(
                    tiled, in_map, beams, scan.origin, prior, self.settings, planar=scan.is_planar,
                    threads=self._threads,
                )  # fmt: skip
            with clock("index"):
                tiled = tiled.with_tiles(fused.tiles, self.settings.observed_activation)
                snapshot = self._map_of(list(tiled.parts.values()), revision=self.snapshot.map_revision + 1)
        else:
            instantaneous, fused, tiled = (
                Refined(carried, True),
                Fused({}, len(carried), len(carried), True),
                None,
            )
            with clock("index"):
                appended = KernelSet.concatenate([self.snapshot.kernels, carried])
                snapshot = self._map_of(appended, revision=self.snapshot.map_revision + 1)
        update = MapUpdate(
            map_revision=snapshot.map_revision,
            kernels=instantaneous.kernels,
            sectors=[_report(s, m, t) for s, m, t in zip(sectors, matches, transported, strict=True)],
            n_points=len(beams.ends),
            n_kernels_added=fused.n_added,
            n_kernels_transported=fused.n_transported,
            map_kernels=len(snapshot),
            converged=instantaneous.converged and fused.converged,
            rule=snapshot.rule,
            changed=self._touched(in_map.points),
            timings_ms=clock.timings_ms,
        )
        # nothing above changed the service, and nothing below can fail
        self.atom_usage.update(match.atom_id for match in update.sectors if match.atom_id is not None)
        self.n_scans += 1
        self._tiled, self.snapshot = tiled, snapshot
        return update

    def clear(self) -> None:
        """Forget all scans; the revision and the use of atoms go on counting, so that readers notice."""
        self.snapshot = self._map_of(KernelSet.empty(), revision=self.snapshot.map_revision + 1)
        self._tiled = None
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

    def _draw(self, labelled: LabelledPoints, n_beams: int, rng: np.random.Generator) -> LabelledPoints:
        """The points of the beams that transport and the instantaneous map are made from."""
        limit = self.settings.match_beams
        if n_beams <= limit:
            return labelled
        drawn = np.zeros(n_beams, bool)
        drawn[rng.choice(n_beams, limit, replace=False)] = True
        members = drawn[labelled.beam]
        return LabelledPoints(labelled.points[members], labelled.occupied[members], labelled.beam[members])

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

    def _refine(self, kernels: KernelSet, labelled: LabelledPoints, voxel_m: float) -> Refined:
        """The instantaneous map: transported weights as prior, the scan's points as data, those of one voxel as one."""
        s = self.settings
        corner = labelled.points.min(axis=0)
        rows, _ = evidence.add(
            evidence.Rows.empty(),
            labelled.points - corner,
            labelled.occupied,
            beam_weights(labelled),
            voxel_m,
        )
        return refine(
            kernels, evidence.positions(rows, voxel_m) + corner, rows.occupied, feature_cut=s.feature_cut,
            tolerance=s.instant_tolerance, threads=self._threads, sample_weight=rows.sums[:, 3],
        )  # fmt: skip

    def _touched(self, points: Float64) -> TileChange:
        size = self.settings.tile_size_m
        tile = np.floor(points / size).astype(np.int64)
        low = tile.min(axis=0)
        extent = tile.max(axis=0) - low + 1
        number = np.ravel_multi_index(tuple((tile - low).T), tuple(extent))
        tiles = np.stack(np.unravel_index(np.flatnonzero(np.bincount(number)), tuple(extent)), axis=1) + low
        return TileChange(size, [(int(x), int(y), int(z)) for x, y, z in tiles])

    def _map_of(self, kernels: KernelSet | Sequence[IndexedKernels], *, revision: int) -> KernelMap:
        s = self.settings
        return KernelMap(
            kernels, observed_activation=s.observed_activation, prior_var=s.prior_var, residual_var=s.residual_var,
            mean_moderation=s.mean_moderation, map_revision=revision, threads=self._threads,
        )  # fmt: skip


class _AtomsInUse(NamedTuple):
    dictionary: AtomDictionary
    matchers: dict[int, Matcher]  # by dimensions


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
