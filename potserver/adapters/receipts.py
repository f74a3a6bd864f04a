"""What goes back for a cloud: exactly one receipt, the transported parameters, and the tick of the revision.

Lanes: receipts and revisions DATA_HIGH, parameters DATA, all BLOCK, because Zenoh drops without telling
    anyone. Blocking is
done by two outboxes of the map, so that neither the mapper nor a receipt ever waits for somebody's slow bulk
transfer; when the bulk outbox is full, parameters are dropped and counted (`params.dropped`).
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable

import zenoh

from potschemas.keys import MapKeys
from potserver.adapters import codec
from potserver.adapters.intake import CloudJob, IntakeQueue
from potserver.adapters.log import get_logger
from potserver.adapters.outbox import Outbox
from potserver.adapters.ports import Mapper
from potserver.domain.types import MapUpdate, Scan
from potserver.errors import PotserverError
from potserver.services.health import Health

log = get_logger("potserver.receipts")


class ReceiptSender:
    """Answers the clouds of one map."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: MapKeys,
        *,
        mapper: Mapper,
        intake: IntakeQueue,
        health: Health,
        prompt: Outbox,
        bulk: Outbox,
    ) -> None:
        self._session, self._keys = session, keys
        self._mapper, self._intake, self._health = mapper, intake, health
        self._prompt, self._bulk = prompt, bulk
        self._reported_s: dict[str, float] = {}

    def accept(
        self, job: CloudJob, scan: Scan, update: MapUpdate, *, wait_ms: float, integrate_ms: float
    ) -> None:
        """The cloud is in the map."""
        self._health.count("clouds.accepted")
        stamp_ns = time.time_ns()
        map_id = self._keys.map_id
        snapshot = self._mapper.snapshot
        rule = snapshot.rule
        depth = self._intake.depth

        def receipt(with_kernels: bool) -> codec.Wire:
            return codec.accepted_receipt(
                map_id=map_id,
                scan=scan,
                update=update,
                kernels=codec.encode_kernels(update.kernels, rule) if with_kernels else None,
                queue_depth=depth,
                wait_ms=wait_ms,
                integrate_ms=integrate_ms,
            )

        def publish_params() -> None:
            wire = codec.encode_params(map_id=map_id, scan=scan, update=update, rule=rule)
            self._put(self._keys.params(scan.robot_id), wire, zenoh.Priority.DATA)
            self._health.count("params.sent")

        if job.query is not None:
            query = job.query
            self._bulk.post_now(lambda: self._reply(query, receipt(with_kernels=True)))
        else:
            self._prompt.post_now(
                lambda: self._put(
                    self._keys.receipt(scan.robot_id), receipt(with_kernels=False), zenoh.Priority.DATA_HIGH
                )
            )
            if not self._bulk.offer(publish_params):
                self._health.count("params.dropped")
        self._prompt.post_now(
            lambda: self._put(
                self._keys.revision,
                codec.encode_revision(map_id=map_id, update=update, stamp_ns=stamp_ns),
                zenoh.Priority.DATA_HIGH,
            )
        )

    def refuse(self, job: CloudJob, error: PotserverError, *, patient: bool = False) -> None:
        """The cloud is not in the map.

        Args:
            job: The cloud; its number is read for the receipt, on the outbox's thread.
            error: Why.
            patient: Wait while the outbox is full: for the intake threads, so that a flood of refused clouds
                is slowed down at its source.
        """
        self._health.count(f"clouds.{codec.refusal(error).value}.{error.code}")
        depth, wait_ms = self._intake.depth, job.wait_ms()
        query = job.query
        if query is not None:
            self._health.count(f"queries.integrate.{error.code}")

        def send() -> None:
            if query is not None:
                with query, contextlib.suppress(zenoh.ZError):  # the asker may be gone
                    wire = codec.encode_error(error)
                    query.reply_err(wire.payload, encoding=wire.encoding)
                return
            head = codec.decode_cloud_head(job.payload.to_bytes())
            robot_id = job.robot_id or ""
            self._report(error)(
                "scan_refused",
                map_id=self._keys.map_id,
                robot_id=robot_id,
                seq=head.seq,
                reason=error.code,
                detail=str(error),
            )
            if "*" in robot_id or "$" in robot_id:  # a put on a wild key: its receipt would reach every robot
                self._health.count("receipts.unaddressed")
                return
            snapshot = self._mapper.snapshot
            wire = codec.refused_receipt(
                map_id=self._keys.map_id,
                robot_id=robot_id,
                seq=head.seq,
                error=error,
                queue_depth=depth,
                wait_ms=wait_ms,
                map_revision=snapshot.map_revision,
                map_kernels=len(snapshot),
            )
            self._put(self._keys.receipt(robot_id), wire, zenoh.Priority.DATA_HIGH)

        if patient:
            self._prompt.post(send, job.n_bytes)
        else:
            self._prompt.post_now(send, job.n_bytes)

    def _report(self, error: PotserverError) -> Callable[..., None]:
        """One line a second and reason; the counters have them all."""
        now_s = time.monotonic()
        if now_s - self._reported_s.get(error.code, -math.inf) < 1.0:
            return log.debug
        self._reported_s[error.code] = now_s
        return log.info

    def _put(self, key: str, wire: codec.Wire, priority: zenoh.Priority) -> None:
        self._session.put(
            key,
            wire.payload,
            encoding=wire.encoding,
            priority=priority,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _reply(self, query: zenoh.Query, wire: codec.Wire) -> None:
        with query:
            query.reply(self._keys.query("integrate"), wire.payload, encoding=wire.encoding)
            self._health.count("queries.integrate.ok")
