"""MappingService: one map that scans are integrated into. The steps stand in `default.py` and `paper.py`."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Protocol

import numpy as np

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.looks import Looks
from potserver.domain.map_state import MapState
from potserver.domain.pages import Pages
from potserver.domain.running_scores import RunningScores
from potserver.domain.tiles import TiledMap, TileGrid, TileIndex
from potserver.domain.types import Float64, MapUpdate, ParamsKind, Scan, TileChange, yaw_pose
from potserver.errors import SettingsError, UnknownRobotError
from potserver.mapping import edits
from potserver.mapping.default import DefaultPipeline
from potserver.mapping.fusion import Moment
from potserver.mapping.novelty import Novelty
from potserver.mapping.paper import PAPER, PotPipeline
from potserver.mapping.pipeline import Method, Pipeline
from potserver.mapping.settings import MappingSettings
from potserver.numerics.threads import default_threads

Commit = Callable[[MapState], None]  # told of a new state before it becomes the map


class MakePipeline(Protocol):
    """Makes the pipeline of a map."""

    def __call__(self, settings: MappingSettings, *, threads: int, seed: int) -> Pipeline: ...


_METHODS = {
    "default": Method(),
    "paper": PAPER,
}


def method_of(profile: str) -> Method:
    """How the steps of a profile work."""
    return _METHODS[profile]


def pipeline_of(settings: MappingSettings, *, threads: int, seed: int) -> Pipeline:
    """The pipeline that the settings' profile names."""
    kind = PotPipeline if settings.profile == "paper" else DefaultPipeline
    return kind(settings, method_of(settings.profile), threads=threads, seed=seed)


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
        make_pipeline: MakePipeline = pipeline_of,
    ) -> None:
        """Start an empty map.

        Args:
            dictionary: Atoms, 2D and 3D; the built-in ones by default.
            settings: The `default` profile by default.
            map_id: Name of the map.
            threads: Threads that integrating one scan may use; all processors by default.
            seed: Of every random choice; the same scans in the same order give the same map, up to rounding.
            make_pipeline: For other ways to map than those of the profiles.
        """
        self.map_id = map_id
        self.settings = settings or MappingSettings()
        self.atom_usage: Counter[str] = Counter()
        self._looks: Looks | None = None
        self._novelty: Novelty | None = None
        self._threads = threads or default_threads()
        self._make_pipeline = make_pipeline
        self._pipeline = make_pipeline(self.settings, threads=self._threads, seed=seed)
        self.use_dictionary(dictionary if dictionary is not None else AtomDictionary.builtin())
        self.state = MapState(snapshot=self._pipeline.snapshot(None, 0, RunningScores()))

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
    def keeps_evidence(self) -> bool:
        """Whether the map keeps what was seen, and not only kernels."""
        return self._pipeline.keeps_evidence

    @property
    def dictionary(self) -> AtomDictionary:
        """The atoms that the next scan is matched against."""
        return self._carrier.dictionary

    def use_dictionary(self, dictionary: AtomDictionary) -> None:
        """Match against other atoms from the next scan on; the map keeps what it has."""
        self._carrier = self._pipeline.carrier(dictionary)  # one assignment: no scan sees a half of it

    def integrate(
        self, scan: Scan, *, params: ParamsKind | None = None, commit: Callable[[], None] | None = None
    ) -> MapUpdate:
        """Add a scan to the map, and work out what goes back to its sender.

        Args:
            scan: With its pose in the map.
            params: What that is; by default what the scan asks for, and `FITTED` where it does not say. In profile `paper` both
                kinds are what was carried.
            commit: Called when all is computed and nothing has changed yet; if it raises, nothing will.
        Raises:
            EmptyError: no beam lies within the range limits. The map is unchanged, as after any error.
        """
        wanted = params or scan.params or ParamsKind.FITTED
        state, update = self._pipeline.integrate(self.state, scan, self._carrier, wanted)
        if commit is not None:
            commit()
        # nothing above changed the service, and nothing below can fail
        self.atom_usage.update(match.atom_id for match in update.sectors if match.atom_id is not None)
        if update.leans_on is not None:
            self.atom_usage[update.leans_on] += 1
        is_kept = self._looks is not None and self._looks.take(scan)
        self.state = state
        if is_kept and self._novelty is not None:
            self._novelty.note(update)
        return update

    def keep_looks(self, on_novelty: Callable[[], None] | None = None) -> None:
        """From now on keep some of the scans, up to 25 MB, for the dictionary to learn from.

        Args:
            on_novelty: Called when so many of them were new that learning is worth while, see `Novelty`; it must not wait.
        """
        self._looks = Looks()
        self._novelty = None if on_novelty is None else Novelty(on_novelty)

    @property
    def learned_from(self) -> tuple[Scan, ...]:
        """The scans that were kept; none unless `keep_looks` was called."""
        return () if self._looks is None else self._looks.scans

    def clear(self, *, commit: Commit | None = None) -> TileChange:
        """Forget all scans; the revision and the use of atoms go on counting, so that readers notice.

        Args:
            commit: Called with the new state before it becomes the map; if it raises, nothing changes.
        """
        return self._swap(
            MapState(snapshot=self._pipeline.snapshot(None, self.state.map_revision + 1, RunningScores())),
            commit,
        )

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
        snapshot = self._pipeline.snapshot(state.tiled, state.map_revision, state.scores)
        return self._swap(dataclasses.replace(state, snapshot=snapshot), commit)

    def merge(self, other: MapState, T_map_other: Float64, *, commit: Commit | None = None) -> TileChange:
        """Take in another map of the same place, see `edits.merge`.

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
        tiled, changed = edits.merge(
            ours, other.tiled, T_map_other, self._pipeline.fusion, moment, threads=self._threads
        )
        return self._edited(tiled, changed, moment, state.n_scans + other.n_scans, commit)

    def remove_robot(self, robot_id: str, *, commit: Commit | None = None) -> TileChange:
        """Take out what one robot has seen, see `edits.remove_robot`.

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
        tiled, changed = edits.remove_robot(
            state.tiled, robot_id, self._pipeline.fusion, moment, threads=self._threads
        )
        change = self._edited(tiled, changed, moment, state.n_scans, commit)
        if self._looks is not None:
            self._looks.forget(robot_id)
        return change

    def relieve(self, pages: Pages) -> None:
        """Keep in memory what it may hold of the map, and the rest on pages; the map is the same, to the bit.

        Raises:
            OSError: the disk refuses; all stays where it was.
        """
        state = self.state
        if state.tiled is None:
            return
        tiled = pages.relieve(state.tiled)
        if tiled is not state.tiled:
            snapshot = state.snapshot.with_parts(list(tiled.parts.values()))
            self.state = dataclasses.replace(state, tiled=tiled, snapshot=snapshot)

    def warm_up(self, *, transported: bool = True) -> None:
        """Compile or load the numerics on small synthetic scans, in a map of its own.

        Args:
            transported: Also what only the senders need that ask for transported parameters.
        """
        kinds = ParamsKind.FITTED, ParamsKind.TRANSPORTED if transported else ParamsKind.FITTED
        rng = np.random.default_rng(0)
        for planar in (False, True):
            scratch = MappingService(
                self.dictionary, self.settings, threads=self._threads, make_pipeline=self._make_pipeline
            )
            angle = rng.uniform(-np.pi, np.pi, 4000)
            height = np.zeros(4000) if planar else rng.uniform(-1.5, 3.0, 4000)
            points = np.stack([8.0 * np.cos(angle), 6.0 * np.sin(angle), height], axis=1).astype(np.float32)
            for k, params in enumerate(kinds):
                pose = yaw_pose(0.3 * k, 0.0, 0.0)
                scratch.integrate(Scan(points=points, T_map_sensor=pose, is_planar=planar), params=params)
            scratch.snapshot.occupancy(points)

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
            snapshot=self._pipeline.snapshot(tiled, moment.revision, self.state.scores),
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
        if self._looks is not None:
            self._looks = Looks()
        tiles = {index for s in (self.state, state) if s.tiled is not None for index in s.tiled.tiles}
        self.state = state
        return TileChange(self.settings.tile_size_m, sorted(tiles))
