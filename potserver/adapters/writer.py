"""The one thread that changes a map."""

from __future__ import annotations

import time
from typing import NamedTuple

from potserver import allocator
from potserver.adapters.clouds import CloudReader
from potserver.adapters.intake import CloudJob, IntakeQueue
from potserver.adapters.poses import WAIT_S, PoseNotYetError
from potserver.adapters.receipts import ReceiptSender
from potserver.adapters.replies import failure
from potserver.adapters.stamps import check_not_future
from potserver.domain.map_size import MapSize
from potserver.domain.map_state import MapState
from potserver.domain.order import CloudOrder
from potserver.domain.tiles import check_reach
from potserver.domain.types import Float64, TileChange
from potserver.errors import MapFullError
from potserver.health import Health
from potserver.log import get_logger
from potserver.mapping.service import MappingService
from potserver.storage.map_store import MapStore, MemoryOnly
from potserver.storage.read_only import ReadOnlyStore

log = get_logger("potserver.writer")

Keeper = MapStore | MemoryOnly | ReadOnlyStore
_GIVE_BACK_SCANS = 25  # after so many, memory that is free goes back to the system


class Bounds(NamedTuple):
    """What the writer refuses."""

    max_future_s: float  # stamps so far ahead
    max_coordinate_m: float  # of what is merged into the map
    max_map_bytes: int  # no cloud enters a map of so many
    max_robot_bytes: int  # nor one of a robot whose share of the map is as large


class MapWriter:
    """Takes clouds from the intake queue, decodes, integrates, and answers each."""

    def __init__(
        self,
        mapper: MappingService,
        keeper: Keeper,
        *,
        order: CloudOrder,
        bounds: Bounds,
        intake: IntakeQueue,
        reader: CloudReader,
        receipts: ReceiptSender,
        health: Health,
    ) -> None:
        self._map_id, self._mapper, self._keeper, self._order = mapper.map_id, mapper, keeper, order
        self._bounds = bounds
        self._size = MapSize()
        self._n_scans = 0  # since the start
        self._intake, self._reader, self._receipts, self._health = intake, reader, receipts, health

    def run(self) -> None:
        """Work until the intake queue closes."""
        while (work := self._intake.take()) is not None:
            try:
                if isinstance(work, CloudJob):
                    self._integrate(work)
                else:
                    work.run()
            except Exception:
                log.exception("writer_step_failed", map_id=self._map_id)
            finally:
                self._intake.done()

    def clear(self) -> str:
        """Empty the map and tell the planners; like the verbs below it runs on the writer thread, as a barrier.

        Returns:
            What was done, for people; so do the verbs below.
        Raises:
            StorageError: the store does not take it. The map is unchanged, as after any error here.
        """
        changed = self._mapper.clear(commit=lambda state: self._keeper.replace(state, {}))
        self._order.replace({})  # the same log may be replayed into the empty map
        self._health.count("maps.cleared")
        self._tell(changed)
        log.info("map_cleared", map_id=self._map_id)
        return "the map is empty"

    def save(self, name: str | None) -> str:
        """Write a snapshot, and a file of its own if there is a name.

        Raises:
            UnsupportedError: the map is kept in memory only.
            StorageError: the store does not take it.
        """
        done = self._keeper.save(name, self._mapper, self._order.heard)
        log.info("map_saved", map_id=self._map_id, name=name)
        return done

    def load(self, name: str) -> str:
        """Put a saved map in the place of this one, and tell the planners.

        Raises:
            UnsupportedError: the map is kept in memory only.
            UnknownMapError, MapFileError: there is no such map, or it cannot be used.
            StorageError: the store does not take it.
        """
        state, heard = self._keeper.load(name, self._mapper)
        changed = self._mapper.restore(state, commit=lambda new: self._keeper.replace(new, heard))
        self._order.replace(heard)
        self._health.count("maps.loaded")
        self._tell(changed)
        log.info("map_loaded", map_id=self._map_id, name=name, n_scans=self._mapper.n_scans)
        return f"the map is {name!r} of {self._mapper.n_scans} scans"

    def merge(self, name: str, T_map_saved: Float64) -> str:
        """Take a saved map into this one, by a known transform, and tell the planners.

        Raises:
            UnsupportedError: the map is kept in memory only.
            UnknownMapError, MapFileError: there is no such map, or it cannot be used.
            OutOfRangeError: the transform takes it to where no map may be.
            StorageError: the store does not take it.
        """
        other, _ = self._keeper.load(name, self._mapper)
        if other.tiled is not None:
            check_reach(other.tiled, T_map_saved, self._bounds.max_coordinate_m)
        changed = self._mapper.merge(other, T_map_saved, commit=self._keep)
        self._health.count("maps.merged")
        self._tell(changed)
        log.info("map_merged", map_id=self._map_id, name=name, n_tiles=len(changed.tiles))
        return f"{name!r} of {other.n_scans} scans is in the map, {len(changed.tiles)} tiles changed"

    def forget(self, robot_id: str) -> str:
        """Take out what one robot has seen, and tell the planners.

        Raises:
            UnknownRobotError: the map has nothing from it.
            UnsupportedError: the map keeps no evidence (profile `paper`).
            StorageError: the store does not take it.
        """
        heard = self._order.without(robot_id)
        changed = self._mapper.remove_robot(robot_id, commit=lambda state: self._keeper.replace(state, heard))
        self._order.replace(heard)  # it may send again what it had sent
        self._health.count("maps.robots_forgotten")
        self._tell(changed)
        log.info("robot_forgotten", map_id=self._map_id, robot_id=robot_id, n_tiles=len(changed.tiles))
        return f"nothing from {robot_id} is left, {len(changed.tiles)} tiles changed"

    def _check_room(self, robot_id: str) -> None:
        n_bytes = self._size.of(self._mapper.state)
        if n_bytes >= self._bounds.max_map_bytes:
            raise MapFullError(
                f"the map has {n_bytes} bytes, the limit is {self._bounds.max_map_bytes} (limits.max_map_bytes): save and clear"
                " it, or forget a robot"
            )
        share = self._size.of_robot(robot_id)
        if share >= self._bounds.max_robot_bytes:
            self._health.count("maps.shares_full")
            raise MapFullError(
                f"{share} bytes of the map are from {robot_id}, the limit is {self._bounds.max_robot_bytes}"
                " (limits.max_robot_bytes): forget the robot, or save and clear the map"
            )

    def _keep(self, state: MapState) -> None:
        self._keeper.replace(state, self._order.heard)

    def _tell(self, changed: TileChange) -> None:
        self._keeper.relieve(self._mapper)
        snapshot = self._mapper.snapshot
        self._receipts.tick(snapshot.map_revision, len(snapshot), changed)

    def _waits(self, job: CloudJob, error: PoseNotYetError) -> bool:
        """Let a cloud wait for its pose, while others are mapped; False if it has waited long enough."""
        until_s = job.arrived_s + WAIT_S
        if time.monotonic() >= until_s or not self._intake.put_back(job, until_s):
            return False
        self._reader.poses.tell_when_reached(
            job.robot_id, error.stamp_ns, lambda: self._intake.wake(job.robot_id)
        )
        return True

    def _integrate(self, job: CloudJob) -> None:
        wait_ms = job.wait_ms()
        try:
            self._keeper.check_takes()
            self._check_room(job.robot_id)
            scan = self._reader.read(job)
            check_not_future(scan.stamp_ns, self._bounds.max_future_s)
            self._order.check(scan.robot_id, scan.session, scan.seq)
            started_s = time.perf_counter()
            wanted = self._receipts.wanted(job, scan)
            with self._keeper.keeping(scan) as commit:
                update = self._mapper.integrate(scan, params=wanted, commit=commit)
        except Exception as error:
            if not (isinstance(error, PoseNotYetError) and self._waits(job, error)):
                told = {"map_id": self._map_id, "robot_id": job.robot_id}
                self._receipts.refuse(
                    job, failure(error, self._keeper.check_readable, log, "scan_failed", **told)
                )
            return
        integrate_ms = (time.perf_counter() - started_s) * 1e3
        self._order.remember(scan.robot_id, scan.session, scan.seq)
        if update.not_leaning is not None:
            self._health.count(f"not_leaning.{update.not_leaning}")
        self._health.observe("integrate", integrate_ms)
        self._health.observe("clouds.wait", wait_ms)
        self._receipts.accept(job, scan, update, wait_ms=wait_ms, integrate_ms=integrate_ms)
        self._keeper.relieve(self._mapper)
        self._keeper.advance(self._mapper, self._order.heard)
        self._n_scans += 1
        if self._n_scans % _GIVE_BACK_SCANS == 0:
            allocator.give_back()
        log.info(
            "scan_integrated",
            map_id=self._map_id,
            robot_id=scan.robot_id,
            seq=scan.seq,
            n_points=update.n_points,
            n_kernels=len(update.own.kernels),
            n_kernels_added=update.n_kernels_added,
            map_kernels=update.map_kernels,
            map_revision=update.map_revision,
            wait_ms=round(wait_ms, 1),
            elapsed_ms=round(integrate_ms, 1),
        )
