"""Clouds published on `in/<robot>/cloud`."""

from __future__ import annotations

import zenoh

from potschemas import keys, messages
from potserver.adapters import codec
from potserver.adapters.intake import CloudJob, IntakeQueue
from potserver.adapters.key_exprs import sender_of
from potserver.adapters.log import get_logger
from potserver.adapters.receipts import ReceiptSender
from potserver.errors import PotserverError
from potserver.health import Health
from potserver.limits import Limits

log = get_logger("potserver.clouds")


class CloudSubscriber:
    """Checks what needs no decoding, and queues; its channel is short, so the queue is the only buffer."""

    def __init__(
        self,
        session: zenoh.Session,
        map_keys: keys.MapKeys,
        *,
        intake: IntakeQueue,
        receipts: ReceiptSender,
        health: Health,
        limits: Limits,
        allowed_robots: frozenset[str],
    ) -> None:
        self._intake, self._receipts, self._health = intake, receipts, health
        self._limits, self._allowed_robots = limits, allowed_robots
        self._subscriber = session.declare_subscriber(map_keys.cloud("*"), zenoh.handlers.FifoChannel(4))

    def run(self) -> None:
        """Take samples until undeclared, on a thread of our own."""
        for sample in self._subscriber:
            try:
                self._admit(sample)
            except Exception:
                log.exception("cloud_admission_failed", key=str(sample.key_expr))

    def undeclare(self) -> None:
        """Take no more; ends `run`."""
        self._subscriber.undeclare()

    def _admit(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            self._health.count("clouds.deletes_ignored")
            return
        robot_id = sender_of(sample.key_expr)
        if robot_id is None:  # nobody to send a receipt to
            self._health.count("clouds.rejected.bad_key")
            return
        self._health.count("clouds.received")
        job = CloudJob(robot_id=robot_id, payload=sample.payload)
        try:
            codec.check_size(job.n_bytes, self._limits.max_cloud_bytes, "cloud")
            codec.check_robot_id(job.lane, self._allowed_robots)
            codec.check_encoding(str(sample.encoding), messages.Cloud)
        except PotserverError as error:
            self._receipts.refuse(job, error, patient=True)
            return
        for refused, why in self._intake.admit(job):
            self._receipts.refuse(refused, why, patient=True)
