"""The one thread that changes a map."""

from __future__ import annotations

import collections
import time

from potserver.adapters import codec
from potserver.adapters.intake import CloudJob, IntakeQueue
from potserver.adapters.limits import Limits
from potserver.adapters.log import get_logger
from potserver.adapters.ports import Mapper
from potserver.adapters.poses import PoseBuffer
from potserver.adapters.receipts import ReceiptSender
from potserver.adapters.stamps import check_not_future
from potserver.domain.types import Float64, Scan
from potserver.errors import OldStampError, PotserverError
from potserver.services.health import Health

log = get_logger("potserver.writer")


class MapWriter:
    """Takes clouds from the intake queue, decodes, integrates, and answers each."""

    def __init__(
        self,
        map_id: str,
        *,
        mapper: Mapper,
        intake: IntakeQueue,
        receipts: ReceiptSender,
        poses: PoseBuffer,
        health: Health,
        limits: Limits,
        allowed_robots: frozenset[str],
        allow_old_stamps: bool,
        max_future_s: float,
        pose_wait_s: float,
    ) -> None:
        self._map_id = map_id
        self._mapper, self._intake, self._receipts = mapper, intake, receipts
        self._poses, self._health, self._limits = poses, health, limits
        self._allowed_robots, self._allow_old_stamps = allowed_robots, allow_old_stamps
        self._max_future_s, self._pose_wait_s = max_future_s, pose_wait_s
        self._last_stamps: collections.OrderedDict[str, int] = collections.OrderedDict()

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

    def clear(self) -> None:
        """Empty the map and tell the planners; runs on the writer thread, as a barrier."""
        changed = self._mapper.clear()
        self._last_stamps.clear()  # the same log may be replayed into the empty map
        self._health.count("maps.cleared")
        snapshot = self._mapper.snapshot
        self._receipts.tick(snapshot.map_revision, len(snapshot), changed)
        log.info("map_cleared", map_id=self._map_id)

    def _integrate(self, job: CloudJob) -> None:
        wait_ms = job.wait_ms()
        try:
            scan = codec.decode_cloud(
                job.payload.to_bytes(), robot_id=job.robot_id, limits=self._limits, pose_at=self._pose_at
            )
            codec.check_robot_id(scan.robot_id, self._allowed_robots)
            self._check_stamp(scan)
            started_s = time.perf_counter()
            update = self._mapper.integrate(scan)
        except PotserverError as error:
            self._receipts.refuse(job, error)
            return
        except Exception:
            log.exception("scan_failed", map_id=self._map_id, robot_id=job.robot_id)
            self._receipts.refuse(job, PotserverError("a bug of the server; the traceback is in its log"))
            return
        integrate_ms = (time.perf_counter() - started_s) * 1e3
        self._remember_stamp(scan)
        self._health.observe("integrate", integrate_ms)
        self._health.observe("clouds.wait", wait_ms)
        self._receipts.accept(job, scan, update, wait_ms=wait_ms, integrate_ms=integrate_ms)
        log.info(
            "scan_integrated",
            map_id=self._map_id,
            robot_id=scan.robot_id,
            seq=scan.seq,
            n_points=update.n_points,
            n_kernels=len(update.kernels),
            n_kernels_added=update.n_kernels_added,
            map_kernels=update.map_kernels,
            map_revision=update.map_revision,
            wait_ms=round(wait_ms, 1),
            elapsed_ms=round(integrate_ms, 1),
        )

    def _pose_at(self, robot_id: str, stamp_ns: int) -> Float64:
        return self._poses.at(robot_id, stamp_ns, wait_s=self._pose_wait_s)

    def _check_stamp(self, scan: Scan) -> None:
        # one wild stamp that we remembered would shut its robot out until the clock reaches it
        check_not_future(scan.stamp_ns, self._max_future_s)
        last = self._last_stamps.get(scan.robot_id)
        if last is not None and scan.stamp_ns <= last and not self._allow_old_stamps:
            behind_ms = (last - scan.stamp_ns) / 1e6
            raise OldStampError(
                f"the stamp is {behind_ms:.3f} ms before the last accepted cloud of {scan.robot_id}"
            )

    def _remember_stamp(self, scan: Scan) -> None:
        self._last_stamps[scan.robot_id] = max(scan.stamp_ns, self._last_stamps.get(scan.robot_id, 0))
        self._last_stamps.move_to_end(scan.robot_id)
        if len(self._last_stamps) > self._limits.max_robots:
            self._last_stamps.popitem(last=False)
