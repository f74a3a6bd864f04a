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
from potserver.adapters.outbox import End, Outbox
from potserver.adapters.ports import Mapper
from potserver.domain.types import MapUpdate, Scan, TileChange
from potserver.errors import PotserverError, TooLargeError
from potserver.health import Health
from potserver.limits import Limits

log = get_logger("potserver.receipts")

_MAX_TILES = 10_000  # in one tick


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
        limits: Limits,
        prompt: Outbox,
        bulk: Outbox,
    ) -> None:
        self._session, self._keys = session, keys
        self._mapper, self._intake, self._health = mapper, intake, health
        self._max_bytes = limits.max_cloud_bytes
        self._prompt, self._bulk = prompt, bulk
        self._reported_s: dict[str, float] = {}

    def accept(
        self, job: CloudJob, scan: Scan, update: MapUpdate, *, wait_ms: float, integrate_ms: float
    ) -> None:
        """The cloud is in the map."""
        self._health.count("clouds.accepted")
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
            self._bulk.post_now(
                lambda: self._reply(query, receipt(with_kernels=True)), ended=self._count_receipt
            )
        else:
            self._prompt.post_now(
                lambda: self._put(
                    self._keys.receipt(scan.robot_id), receipt(with_kernels=False), zenoh.Priority.DATA_HIGH
                ),
                ended=self._count_receipt,
            )
            if not self._bulk.offer(publish_params):
                self._health.count("params.dropped")
        self.tick(update.map_revision, update.map_kernels, update.changed)

    def tick(self, map_revision: int, map_kernels: int, changed: TileChange) -> None:
        """The map changed: say so to all."""
        stamp_ns = time.time_ns()
        # more tiles than a receiver decodes at once, only ever after a clear, come in several ticks of one revision
        for start in range(0, max(1, len(changed.tiles)), _MAX_TILES):
            some = changed._replace(tiles=changed.tiles[start : start + _MAX_TILES])

            def send(some: TileChange = some) -> None:
                wire = codec.encode_revision(
                    map_id=self._keys.map_id,
                    map_revision=map_revision,
                    map_kernels=map_kernels,
                    changed=some,
                    stamp_ns=stamp_ns,
                )
                self._put(self._keys.revision, wire, zenoh.Priority.DATA_HIGH)

            self._prompt.post_now(send)

    def refuse(self, job: CloudJob, error: PotserverError, *, patient: bool = False) -> None:
        """The cloud is not in the map.

        Args:
            job: The cloud; its number is read for the receipt, on the outbox's thread, unless it is too large.
            error: Why.
            patient: Wait while the outbox is full: for the thread of the published clouds, so that a flood of
                refused ones is slowed down at its source. Queries never wait: other questions are behind them.
        """
        self._health.count(f"clouds.{codec.refusal(error).value}.{error.code}")
        depth, wait_ms = self._intake.depth, job.wait_ms()
        if job.query is not None:
            self._health.count(f"queries.integrate.{error.code}")
            self._refuse_query(job.query, error)
            return
        robot_id = job.robot_id or ""
        payload = None if isinstance(error, TooLargeError) and job.n_bytes > self._max_bytes else job.payload
        n_bytes = 0 if payload is None else job.n_bytes

        def send() -> None:
            seq = codec.UNKNOWN_SEQ if payload is None else codec.decode_cloud_head(payload.to_bytes()).seq
            self._report(error)(
                "scan_refused",
                map_id=self._keys.map_id,
                robot_id=robot_id,
                seq=seq,
                reason=error.code,
                detail=str(error),
            )
            snapshot = self._mapper.snapshot
            wire = codec.refused_receipt(
                map_id=self._keys.map_id,
                robot_id=robot_id,
                seq=seq,
                error=error,
                queue_depth=depth,
                wait_ms=wait_ms,
                map_revision=snapshot.map_revision,
                map_kernels=len(snapshot),
            )
            self._put(self._keys.receipt(robot_id), wire, zenoh.Priority.DATA_HIGH)

        if patient:
            self._prompt.post(send, n_bytes, ended=self._count_receipt)
        else:
            self._prompt.post_now(send, n_bytes, ended=self._count_receipt)

    def _refuse_query(self, query: zenoh.Query, error: PotserverError) -> None:
        """Knows nothing of the cloud, whose bytes can go at once."""

        def send() -> None:
            with query, contextlib.suppress(zenoh.ZError):  # the asker may be gone
                wire = codec.encode_error(error)
                query.reply_err(wire.payload, encoding=wire.encoding)

        self._prompt.post_now(send, ended=self._count_receipt)

    def _count_receipt(self, end: End) -> None:
        self._health.count(f"receipts.{end.value}")

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
