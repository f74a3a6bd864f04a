"""Clouds on their way in: published on `in/<robot>/cloud`, or asked with on `in/<robot>/integrate`."""

from __future__ import annotations

import zenoh

from potschemas import keys, messages
from potserver.adapters.audit import Audit
from potserver.adapters.intake import CloudJob, IntakeQueue
from potserver.adapters.key_exprs import check_robot_id, sender_of
from potserver.adapters.poses import PoseBuffer
from potserver.adapters.queryable import Queryable
from potserver.adapters.receipts import ReceiptSender
from potserver.adapters.replies import asker_of, reply_error
from potserver.codec import clouds as codec
from potserver.codec.base import check_encoding, check_size
from potserver.domain.types import Scan
from potserver.errors import PotserverError, UnsupportedError
from potserver.health import Health
from potserver.limits import Limits
from potserver.log import get_logger

log = get_logger("potserver.clouds")

_CHANNEL = 4  # clouds between Zenoh and our admission: the intake queue is the buffer


class CloudDoor:
    """Checks what needs no decoding, and queues. Every cloud gets into the queue or is refused with a receipt."""

    def __init__(
        self,
        intake: IntakeQueue,
        receipts: ReceiptSender,
        health: Health,
        limits: Limits,
        allowed_robots: frozenset[str],
    ) -> None:
        self._intake, self._receipts, self._health = intake, receipts, health
        self._limits, self._allowed_robots = limits, allowed_robots

    def admit_sample(self, sample: zenoh.Sample) -> None:
        """Take a published cloud."""
        if sample.kind == zenoh.SampleKind.DELETE:
            self._health.count("clouds.deletes_ignored")
            return
        robot_id = sender_of(sample.key_expr)
        if robot_id is None:  # nobody to send a receipt to
            self._health.count("clouds.rejected.bad_key")
            return
        self._admit(CloudJob(robot_id=robot_id, payload=sample.payload), str(sample.encoding))

    def admit_query(self, query: zenoh.Query) -> None:
        """Take the cloud of an `in/<robot>/integrate`; its receipt is the reply.

        Raises:
            UnsupportedError: the key is wild.
        """
        robot_id = sender_of(query.key_expr)
        if robot_id is None:
            raise UnsupportedError(
                "integrate changes a map: name the map and the robot, wildcards are not taken"
            )
        job = CloudJob(robot_id=robot_id, payload=query.payload or zenoh.ZBytes(b""), query=query)
        self._admit(job, None if query.encoding is None else str(query.encoding))

    def _admit(self, job: CloudJob, encoding: str | None) -> None:
        self._health.count("clouds.received")
        patient = job.query is None  # publishers can be slowed down; the clouds of others wait behind a query
        try:
            check_size(job.n_bytes, self._limits.max_cloud_bytes, "cloud")
            check_robot_id(job.robot_id, self._allowed_robots)
            check_encoding(encoding, messages.Cloud)
        except PotserverError as error:
            self._receipts.refuse(job, error, patient=patient)
            return
        for refused, why in self._intake.admit(job):
            self._receipts.refuse(refused, why, patient=patient)


class CloudSubscriber:
    """Takes the published clouds of one map."""

    def __init__(self, session: zenoh.Session, map_keys: keys.MapKeys, door: CloudDoor) -> None:
        self._door = door
        self._subscriber = session.declare_subscriber(
            map_keys.cloud("*"), zenoh.handlers.FifoChannel(_CHANNEL)
        )

    def run(self) -> None:
        """Take samples until undeclared, on a thread of our own."""
        for sample in self._subscriber:
            try:
                self._door.admit_sample(sample)
            except Exception:
                log.exception("cloud_admission_failed", key=str(sample.key_expr))

    def undeclare(self) -> None:
        """Take no more; ends `run`."""
        self._subscriber.undeclare()


class IntegrateQueryable(Queryable):
    """`in/<robot>/integrate` of one map: clouds whose receipt is the reply."""

    def __init__(
        self, session: zenoh.Session, map_keys: keys.MapKeys, door: CloudDoor, health: Health
    ) -> None:
        self._door, self._health, self._audit = door, health, Audit(map_keys.map_id)
        super().__init__(session, map_keys.integrate("*"))

    def admit(self, query: zenoh.Query) -> None:
        """Queue a cloud for the map's writer."""
        self._health.count("queries.received")
        self._door.admit_query(query)

    def refuse(self, query: zenoh.Query, error: PotserverError) -> None:
        """Count and send what is wrong, at once."""
        self._health.count(f"queries.integrate.{error.code}")
        self._audit.refused("queries.integrate", asker_of(query), error)
        with query:
            reply_error(query, error)


class CloudReader:
    """Makes scans of queued clouds, on the writer's thread."""

    def __init__(self, limits: Limits, poses: PoseBuffer) -> None:
        self._limits, self.poses = limits, poses

    def read(self, job: CloudJob) -> Scan:
        """The scan; a cloud without a pose takes the one of the robot's pose stream.

        Raises:
            PotserverError: see `codec.clouds.decode_cloud`; `PoseNotYetError` if it may be read later.
        """
        return codec.decode_cloud(
            job.payload.to_bytes(), robot_id=job.robot_id, limits=self._limits, pose_at=self.poses.at
        )
