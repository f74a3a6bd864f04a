"""MappingService: a scan comes in, atoms are carried to it, the map grows (paper, Algorithm 1)."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from potschemas.answers import AnswerRule
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.running_scores import RunningScores
from potserver.domain.tiles import TiledMap, TileGrid, TileIndex
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
from potserver.errors import EmptyError, SettingsError, UnknownRobotError
from potserver.mapping import edits as map_edits
from potserver.mapping.fusion import Fused, Moment, append, fuse, grid_for, refit, stalest_part
from potserver.mapping.matching import Match, Matcher
from potserver.mapping.refinement import Refined, refine
from potserver.mapping.settings import MappingSettings
from potserver.mapping.transport import Transported, transport
from potserver.numerics import evidence
from potserver.numerics.beams import Beams, LabelledPoints, beam_weights, label_beams, limit_range
from potserver.numerics.geometry import bounds, in_sector, rotation_z, sector_edges, yaw_of
from potserver.numerics.threads import default_threads, parallel_map, parallel_pair

_INSTANT_VOXEL = 2.0  # resolutions: the free points of such a voxel are one datum of the instantaneous map; hits in half of it
_CUBE = 2.5  # of those voxels, in which their rows are solved together
_MOST_CHECKED = 100  # beams a scan, about
_CHECK_GAP_M = 0.5  # before a beam's end, where the map is not asked whether it is free

Commit = Callable[[MapState], None]  # told of a new state before it becomes the map


class MappingService:
    """One map. What changes it has one caller at a time; `state` may be read from any thread, and never waits.

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
        self.atom_usage: Counter[str] = Counter()
        self._threads = threads or default_threads()
        # where neither needs the other, what is carried from atoms and the overall map are worked out at the same time
        self._side_by_side = self.settings.refine and not self.settings.carry_into_map
        self._threads_each = max(1, self._threads // 2) if self._side_by_side else self._threads
        self._seed = seed
        self.use_dictionary(dictionary if dictionary is not None else AtomDictionary.builtin())
        self.state = MapState(snapshot=self._map_of(None, revision=0))

    @property
    def snapshot(self) -> KernelMap:
        """What queries are answered from."""
        return self.state.snapshot

    @property
    def scores(self) -> RunningScores:
        """How well the map answers about beams that it never learned."""
        return self.state.scores

    @property
    def n_scans(self) -> int:
        """Scans in the map."""
        return self.state.n_scans

    @property
    def dictionary(self) -> AtomDictionary:
        """The atoms that the next scan is matched against."""
        return self._atoms.dictionary

    def use_dictionary(self, dictionary: AtomDictionary) -> None:
        """Match against other atoms from the next scan on; the map keeps what it has."""
        matchers = {
            dims: Matcher(
                dictionary.of_dims(dims), self.settings, threads=self._threads_each, seed=self._seed
            )
            for dims in (2, 3)
        }
        self._atoms = _AtomsInUse(dictionary, matchers)  # one assignment: no scan sees a half of it

    def integrate(self, scan: Scan, *, commit: Callable[[], None] | None = None) -> MapUpdate:
        """Carry atoms to a scan and add it to the map.

        Args:
            scan: With its pose in the map.
            commit: Called when all is computed and nothing has changed yet; if it raises, nothing will.
        Raises:
            EmptyError: no beam lies within the range limits. The map is unchanged, as after any error.
        """
        clock = _Stopwatch()
        state = self.state
        rng = np.random.default_rng((self._seed, state.n_scans))
        checks = np.random.default_rng((self._seed, state.n_scans, 1))
        with clock("label"):
            beams, checked = self._beams(scan, rng, checks)
            labelled = label_beams(
                beams, free_per_beam=self.settings.free_per_beam, gap_m=self.settings.gap_m, rng=rng
            )
            drawn = self._draw(labelled, len(beams.ends), rng)
            sectors = self._cut_sectors(drawn, scan)
        in_map = labelled._replace(points=labelled.points + scan.origin)
        tiled = state.tiled or TiledMap.empty(grid_for(beams, self.settings))
        tiled, source = tiled.with_robot(scan.robot_id)
        moment = Moment(state.map_revision + 1, max(state.stamp_ns, scan.stamp_ns), self.settings.half_life_s)

        def from_atoms() -> _FromAtoms:
            with clock("match"):
                matches = self._atoms.matchers[2 if scan.is_planar else 3].match(sectors)
            with clock("transport"):
                transported = self._transport(matches, sectors)
            reports = [_report(s, m, t) for s, m, t in zip(sectors, matches, transported, strict=True)]
            served = [
                (m, t) for m, t in zip(matches, transported, strict=True) if m is not None and t is not None
            ]
            if not self.settings.refine:
                carried = KernelSet.concatenate([t.kernels for _, t in served])
                return _FromAtoms(reports, carried, Refined(carried, True))
            prior = KernelSet.concatenate([self._prior_of(t.kernels, m.w2_m2) for m, t in served])
            with clock("refine"):
                refined = self._refine(prior, in_map, _INSTANT_VOXEL * tiled.grid.fine_m)
            return _FromAtoms(reports, prior, refined)

        def from_evidence(carried: KernelSet) -> Fused:
            with clock("fuse"):
                return fuse(
                    tiled, in_map, beams, scan.origin, carried, self.settings, source=source, moment=moment,
                    planar=scan.is_planar, threads=self._threads,
                )  # fmt: skip

        if self._side_by_side:
            instantaneous, fused = parallel_pair(
                from_atoms, lambda: from_evidence(KernelSet.empty()), self._threads
            )
        else:
            instantaneous = from_atoms()
            carried = instantaneous.carried
            if self.settings.refine:
                fused = from_evidence(carried)
            else:
                fused = Fused(append(tiled, carried, moment), len(carried), len(carried), True)
        with clock("index"):
            changed = fused.tiles
            tiled = tiled.with_tiles(changed, self.settings.observed_activation, threads=self._threads)
            if (stale := stalest_part(tiled, moment)) is not None:
                aged, _ = refit(tiled, stale, self.settings, moment, threads=self._threads)
                tiled = tiled.with_tiles(aged, self.settings.observed_activation)
                changed = changed | aged
            snapshot = self._map_of(tiled, revision=moment.revision, scores=state.scores)
        with clock("check"):
            scores = self._check(snapshot, checked, scan, state.scores, checks)
        update = MapUpdate(
            map_revision=moment.revision,
            kernels=instantaneous.refined.kernels,
            sectors=instantaneous.sectors,
            n_points=len(beams.ends) + len(checked.ends),
            n_kernels_added=fused.n_added,
            n_kernels_transported=fused.n_transported,
            map_kernels=len(snapshot),
            converged=instantaneous.refined.converged and fused.converged,
            rule=snapshot.rule,
            changed=TileChange(tiled.grid.size_m, sorted(changed)),
            timings_ms=clock.timings_ms,
        )
        if commit is not None:
            commit()
        # nothing above changed the service, and nothing below can fail
        self.atom_usage.update(match.atom_id for match in update.sectors if match.atom_id is not None)
        self.state = MapState(
            snapshot=snapshot, tiled=tiled, epoch=state.epoch, n_scans=state.n_scans + 1, stamp_ns=moment.stamp_ns,
            scores=scores,
        )  # fmt: skip
        return update

    def clear(self, *, commit: Commit | None = None) -> TileChange:
        """Forget all scans; the revision and the use of atoms go on counting, so that readers notice.

        Args:
            commit: Called with the new state before it becomes the map; if it raises, nothing changes.
        """
        return self._swap(MapState(snapshot=self._map_of(None, revision=self.state.map_revision + 1)), commit)

    def restore(self, state: MapState, *, commit: Commit | None = None) -> TileChange:
        """Take a state that was saved in place of the present one, with all its numbers.

        Args:
            state: Its snapshot is made anew, by this service's settings.
            commit: As for `clear`.
        Raises:
            SettingsError: it was made with another `tile_size_m`.
        """
        size = self.settings.tile_size_m
        if state.tiled is not None and state.tiled.grid.size_m != size:
            raise SettingsError(
                f"the saved map has tiles of {state.tiled.grid.size_m} m, mapping.tile_size_m is {size}: set it to the map's"
            )
        snapshot = self._map_of(state.tiled, revision=state.map_revision, scores=state.scores)
        return self._swap(dataclasses.replace(state, snapshot=snapshot), commit)

    def merge(self, other: MapState, T_map_other: Float64, *, commit: Commit | None = None) -> TileChange:
        """Take in another map of the same place, see `map_edits.merge`.

        Args:
            other: It is not changed.
            T_map_other: (4, 4) rigid.
            commit: As for `clear`.
        Raises:
            BadPoseError: the transform is not rigid. The map is unchanged, as after any error.
        """
        if other.tiled is None:
            return TileChange(self.settings.tile_size_m, [])
        state = self.state
        moment = Moment(
            state.map_revision + 1, max(state.stamp_ns, other.stamp_ns), self.settings.half_life_s
        )
        ours = state.tiled or TiledMap.empty(TileGrid.of(self.settings.tile_size_m, other.tiled.grid.fine_m))
        tiled, changed = map_edits.merge(
            ours, other.tiled, T_map_other, self.settings, moment, threads=self._threads
        )
        return self._edited(tiled, changed, moment, state.n_scans + other.n_scans, commit)

    def remove_robot(self, robot_id: str, *, commit: Commit | None = None) -> TileChange:
        """Take out what one robot has seen, see `map_edits.remove_robot`.

        Args:
            robot_id: Whose.
            commit: As for `clear`.
        Raises:
            UnknownRobotError: the map has nothing from this robot. The map is unchanged, as after any error.
            UnsupportedError: the map keeps no evidence.
        """
        state = self.state
        moment = Moment(state.map_revision + 1, state.stamp_ns, self.settings.half_life_s)
        if state.tiled is None:
            raise UnknownRobotError(f"the map is empty: it has nothing from {robot_id!r}")
        tiled, changed = map_edits.remove_robot(
            state.tiled, robot_id, self.settings, moment, threads=self._threads
        )
        return self._edited(tiled, changed, moment, state.n_scans, commit)

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

    def _beams(
        self, scan: Scan, rng: np.random.Generator, checks: np.random.Generator
    ) -> tuple[Beams, Beams]:
        """The scan's beams, limited in range and number: those to learn from, and those that are only asked about."""
        beams = limit_range(scan.beams, self.settings.min_range_m, self.settings.max_range_m)
        n = len(beams.ends)
        if n == 0:
            raise EmptyError(
                f"none of {len(scan.points)} beams is longer than {self.settings.min_range_m} m: nothing to learn from"
            )
        drawn = np.arange(n)
        if n > self.settings.beams_per_scan:
            drawn = np.sort(rng.choice(n, self.settings.beams_per_scan, replace=False))
        is_checked = checks.random(len(drawn)) < min(self.settings.check_share, _MOST_CHECKED / len(drawn))
        is_checked[0] &= not is_checked.all()  # something must be learned
        learned, checked = drawn[~is_checked], drawn[is_checked]
        return (
            Beams(beams.ends[learned], beams.is_return[learned]),
            Beams(beams.ends[checked], beams.is_return[checked]),
        )

    def _check(
        self,
        snapshot: KernelMap,
        checked: Beams,
        scan: Scan,
        scores: RunningScores,
        rng: np.random.Generator,
    ) -> RunningScores:
        """Ask the map about beams that it did not learn: their ends, and one point of each that they crossed."""
        asked = label_beams(checked, free_per_beam=1, gap_m=_CHECK_GAP_M, rng=rng)
        answer = snapshot.occupancy(asked.points + scan.origin)
        latent_mean = np.where(answer.observed, answer.latent_mean, np.float32(0))
        return scores.with_points(
            latent_mean, answer.latent_var, asked.occupied, snapshot.rule.mean_moderation
        )

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

        return parallel_map(run, range(len(sectors)), self._threads_each)

    def _prior_of(self, carried: KernelSet, w2_m2: float) -> KernelSet:
        """Kernels carried over such a distance, with what their weights are worth before this scan's labels."""
        s = self.settings
        if s.borrow_weights:
            borrowed = np.float32(s.borrowed_var_per_m2 * max(w2_m2, 0.0))  # the entropy may make it negative
            return carried.replace(weight_var=carried.weight_var + borrowed)
        zeros = np.zeros(len(carried), np.float32)
        return carried.replace(weight_mean=zeros, weight_var=zeros + np.float32(s.prior_var))

    def _refine(self, kernels: KernelSet, labelled: LabelledPoints, voxel_m: float) -> Refined:
        """The instantaneous map: transported weights as prior, the scan's points as data, those of one voxel as one."""
        s = self.settings
        corner = bounds(labelled.points)[0]
        rows, _ = evidence.add(
            evidence.Rows.empty(),
            labelled.points - corner,
            labelled.occupied,
            beam_weights(labelled),
            voxel_m,
        )
        return refine(
            kernels, evidence.positions(rows, voxel_m) + corner, rows.occupied, edge_m=_CUBE * voxel_m,
            feature_cut=s.feature_cut, newton_steps=s.instant_newton_steps, gradient_steps=s.instant_gradient_steps,
            threads=self._threads_each, sample_weight=rows.sums[:, 3],
        )  # fmt: skip

    def _edited(
        self,
        tiled: TiledMap,
        changed: Iterable[TileIndex],
        moment: Moment,
        n_scans: int,
        commit: Commit | None,
    ) -> TileChange:
        state = dataclasses.replace(
            self.state,
            snapshot=self._map_of(tiled, revision=moment.revision, scores=self.state.scores),
            tiled=tiled,
            n_scans=n_scans,
            stamp_ns=moment.stamp_ns,
        )
        if commit is not None:
            commit(state)
        self.state = state
        return TileChange(tiled.grid.size_m, sorted(changed))

    def _swap(self, state: MapState, commit: Commit | None) -> TileChange:
        """Put another map in the place of this one; all tiles of both have changed."""
        if commit is not None:
            commit(state)
        tiles = {index for s in (self.state, state) if s.tiled is not None for index in s.tiled.tiles}
        self.state = state
        return TileChange(self.settings.tile_size_m, sorted(tiles))

    def _map_of(
        self, tiled: TiledMap | None, *, revision: int, scores: RunningScores | None = None
    ) -> KernelMap:
        s = self.settings
        moderation = s.mean_moderation
        if s.calibrate and scores is not None:
            moderation = scores.moderation(moderation)
        return KernelMap(
            list(tiled.parts.values()) if tiled is not None else [],
            rule=dataclasses.replace(AnswerRule.of(s), mean_moderation=moderation),
            map_revision=revision,
            threads=self._threads,
        )


class _FromAtoms(NamedTuple):
    """What transport made of a scan."""

    sectors: list[SectorMatch]
    carried: KernelSet  # map frame, as prior
    refined: Refined  # the instantaneous map


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
