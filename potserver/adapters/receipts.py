"""What goes back for a cloud: exactly one receipt, the parameters where they are wanted, and the tick of the revision.

Lanes: receipts and revisions DATA_HIGH, parameters DATA; all BLOCK, because Zenoh drops without telling anyone. Two
outboxes of the map do the blocking, so that neither the mapper nor a receipt ever waits for somebody's slow bulk
transfer. When the bulk outbox is full, parameters are dropped and counted (`params.dropped`).
"""

from __future__ import annotations

import time
from typing import NamedTuple

import zenoh

from potschemas import messages
from potschemas.keys import MapKeys
from potserver.adapters.audit import Audit
from potserver.adapters.intake import CloudJob, IntakeQueue
from potserver.adapters.listeners import Listeners
from potserver.adapters.outbox import End, Outbox
from potserver.adapters.replies import reply, reply_error
from potserver.codec.base import Wire, encode
from potserver.codec.clouds import UNKNOWN_SEQ, decode_cloud_head
from potserver.codec.kernels import encode_own_map
from potserver.domain.map_state import MapState
from potserver.domain.types import MapUpdate, ParamsKind, Scan, TileChange
from potserver.errors import PotserverError, TooLargeError
from potserver.health import Health
from potserver.limits import Limits
from potserver.mapping.service import MappingService

_MAX_TILES = 10_000  # in one tick: more than a receiver decodes at once


class Waited(NamedTuple):
    """What a cloud met on its way to the mapper."""

    queue_depth: int  # clouds behind it when its receipt was made
    wait_ms: float  # in the queue


class ReceiptSender:
    """Answers the clouds of one map."""

    def __init__(
        self,
        session: zenoh.Session,
        keys: MapKeys,
        *,
        mapper: MappingService,
        intake: IntakeQueue,
        health: Health,
        limits: Limits,
        prompt: Outbox,
        bulk: Outbox,
    ) -> None:
        self._session, self._keys = session, keys
        self._listeners = Listeners(session, keys, limits.max_robots)
        self._mapper, self._intake, self._health = mapper, intake, health
        self._max_bytes = limits.max_cloud_bytes
        self._prompt, self._bulk = prompt, bulk
        self._audit = Audit(keys.map_id)

    def wanted(self, job: CloudJob, scan: Scan) -> ParamsKind:
        """Which parameters of a cloud are worth computing: those that it asks for; else fitted ones, if they reach anybody."""
        if scan.params is not None:
            return scan.params
        is_read = job.query is not None or self._listeners.listen_to(scan.robot_id)
        return ParamsKind.FITTED if is_read else ParamsKind.NONE

    def accept(
        self, job: CloudJob, scan: Scan, update: MapUpdate, *, wait_ms: float, integrate_ms: float
    ) -> None:
        """The cloud is in the map."""
        self._health.count("clouds.accepted")
        map_id, waited = self._keys.map_id, Waited(self._intake.depth, wait_ms)
        if job.query is not None:
            query = job.query
            self._bulk.post_now(
                lambda: self._reply(
                    query,
                    scan.robot_id,
                    encode_accepted(map_id, scan, update, waited, integrate_ms, with_kernels=True),
                ),
                ended=self._count_receipt,
            )
        else:
            self._prompt.post_now(
                lambda: self._put(
                    self._keys.receipt(scan.robot_id),
                    encode_accepted(map_id, scan, update, waited, integrate_ms, with_kernels=False),
                    zenoh.Priority.DATA_HIGH,
                ),
                ended=self._count_receipt,
            )
        self._send_params(scan, update, is_told=job.query is not None)
        self.tick(update.map_revision, update.map_kernels, update.changed)

    def tick(self, map_revision: int, map_kernels: int, changed: TileChange) -> None:
        """The map changed: say so to all."""
        stamp_ns = time.time_ns()
        # many tiles come in several ticks of one revision
        for start in range(0, max(1, len(changed.tiles)), _MAX_TILES):
            some = changed._replace(tiles=changed.tiles[start : start + _MAX_TILES])

            def send(some: TileChange = some) -> None:
                wire = encode_revision(
                    self._keys.map_id, map_revision, map_kernels, changed=some, stamp_ns=stamp_ns
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
        self._health.count(f"clouds.{refusal(error).value}.{error.code}")
        waited, state = Waited(self._intake.depth, job.wait_ms()), self._mapper.state
        if job.query is not None:
            self._health.count(f"queries.integrate.{error.code}")
            self._refuse_query(job.query, job.robot_id, error)
            return
        robot_id = job.robot_id
        payload = None if isinstance(error, TooLargeError) and job.n_bytes > self._max_bytes else job.payload
        n_bytes = 0 if payload is None else job.n_bytes

        def send() -> None:
            seq = UNKNOWN_SEQ if payload is None else decode_cloud_head(payload.to_bytes()).seq
            self._audit.refused("clouds", robot_id, error, seq=seq)
            wire = encode_refused(self._keys.map_id, robot_id, seq, error, waited, state)
            self._put(self._keys.receipt(robot_id), wire, zenoh.Priority.DATA_HIGH)

        if patient:
            self._prompt.post(send, n_bytes, ended=self._count_receipt)
        else:
            self._prompt.post_now(send, n_bytes, ended=self._count_receipt)

    def _send_params(self, scan: Scan, update: MapUpdate, *, is_told: bool) -> None:
        """Publish the parameters of a cloud, if there are any for anybody; `is_told`: its sender has them already."""
        if update.own.is_nothing:
            return
        is_asked = scan.params is not None and not is_told
        if not (is_asked or self._listeners.listen_to(scan.robot_id)):
            return
        if not self._bulk.offer(lambda: self._publish_params(scan, update)):
            self._health.count("params.dropped")

    def _publish_params(self, scan: Scan, update: MapUpdate) -> None:
        wire = encode_params(self._keys.map_id, scan, update)
        self._put(self._keys.params(scan.robot_id), wire, zenoh.Priority.DATA)
        self._health.count("params.sent")

    def _refuse_query(self, query: zenoh.Query, robot_id: str, error: PotserverError) -> None:
        """Knows nothing of the cloud, whose bytes can go at once."""
        self._audit.refused("queries.integrate", robot_id, error)

        def send() -> None:
            with query:
                reply_error(query, error)

        self._prompt.post_now(send, ended=self._count_receipt)

    def _count_receipt(self, end: End) -> None:
        self._health.count(f"receipts.{end.value}")

    def _put(self, key: str, wire: Wire, priority: zenoh.Priority) -> None:
        self._session.put(
            key,
            wire.payload,
            encoding=wire.encoding,
            priority=priority,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _reply(self, query: zenoh.Query, robot_id: str, wire: Wire) -> None:
        with query:
            reply(query, self._keys.integrate(robot_id), wire)
            self._health.count("queries.integrate.ok")


# --- messages -----------------------------------------------------------------------------------------------


def refusal(error: PotserverError) -> messages.ReceiptStatus:
    """`dropped` for load and shutdown, `rejected` for everything that would fail again."""
    return messages.ReceiptStatus.DROPPED if error.retryable else messages.ReceiptStatus.REJECTED


def encode_accepted(
    map_id: str, scan: Scan, update: MapUpdate, waited: Waited, integrate_ms: float, *, with_kernels: bool
) -> Wire:
    """The receipt of a cloud that is in the map; with its kernels for `in/<robot>/integrate`."""
    return encode(
        messages.Receipt(
            map=map_id,
            robot=scan.robot_id,
            seq=scan.seq,
            status=messages.ReceiptStatus.ACCEPTED,
            queue_depth=waited.queue_depth,
            wait_ms=waited.wait_ms,
            integrate_ms=integrate_ms,
            map_revision=int(update.map_revision),
            n_points=int(update.n_points),
            n_kernels=len(update.own.kernels),
            n_kernels_added=int(update.n_kernels_added),
            n_kernels_transported=int(update.n_kernels_transported),
            map_kernels=int(update.map_kernels),
            sectors=_sectors(update),
            kernels=encode_own_map(update.own, update.rule)
            if with_kernels and not update.own.is_nothing
            else None,
            borrowed=_borrowed(update),
        )
    )


def encode_refused(
    map_id: str, robot_id: str, seq: int, error: PotserverError, waited: Waited, state: MapState
) -> Wire:
    """The receipt of a cloud that is not in the map; `state` is the map's at that moment."""
    return encode(
        messages.Receipt(
            map=map_id,
            robot=robot_id,
            seq=seq,
            status=refusal(error),
            reason=error.code,
            message=str(error),
            queue_depth=waited.queue_depth,
            wait_ms=waited.wait_ms,
            map_revision=state.map_revision,
            map_kernels=len(state.snapshot),
            next_seq=messages.ABSENT if error.next_seq is None else error.next_seq,
        )
    )


def encode_params(map_id: str, scan: Scan, update: MapUpdate) -> Wire:
    """The parameters of one cloud."""
    return encode(
        messages.Params(
            map=map_id,
            robot=scan.robot_id,
            seq=scan.seq,
            stamp_ns=scan.stamp_ns,
            map_revision=int(update.map_revision),
            kernels=encode_own_map(update.own, update.rule),
            sectors=_sectors(update),
            borrowed=_borrowed(update),
        )
    )


def _sectors(update: MapUpdate) -> list[messages.SectorReport]:
    return [messages.SectorReport(**match._asdict()) for match in update.own.sectors]


def _borrowed(update: MapUpdate) -> list[messages.Borrowed] | messages.Absent:
    told = [
        messages.Borrowed(
            name=part.name,
            weight=min(part.weight, 1.0),
            displacement=part.displacement.tolist(),
            slope=list(part.slope),
            scale=part.scale,
        )
        for part in update.own.borrowed
    ]
    return told or messages.ABSENT


def encode_revision(
    map_id: str, map_revision: int, map_kernels: int, *, changed: TileChange, stamp_ns: int
) -> Wire:
    """The tick of `ev/revision`."""
    return encode(
        messages.Revision(
            map=map_id,
            map_revision=int(map_revision),
            stamp_ns=stamp_ns,
            n_kernels=int(map_kernels),
            tile_size_m=float(changed.tile_size_m),
            changed_tiles=[[int(i) for i in tile] for tile in changed.tiles],
        )
    )
