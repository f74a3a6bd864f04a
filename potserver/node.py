"""MapNode: everything of one map that a server runs. Its queues, its writer, and what is declared for it."""

from __future__ import annotations

import collections
import contextlib
import time
from typing import NamedTuple, Protocol

import zenoh

from potschemas import keys
from potserver.adapters.answers import Answers
from potserver.adapters.audit import Audit
from potserver.adapters.clouds import CloudDoor, CloudReader, CloudSubscriber, IntegrateQueryable
from potserver.adapters.intake import IntakeQueue
from potserver.adapters.outbox import Outbox
from potserver.adapters.poses import PoseBuffer, PoseSubscriber
from potserver.adapters.presence import RobotWatch, ServerToken
from potserver.adapters.query_pool import QueryPool
from potserver.adapters.queryable import MapQueryable
from potserver.adapters.questions.control import ControlQueryable
from potserver.adapters.questions.question import Served
from potserver.adapters.questions.registry import QUESTIONS
from potserver.adapters.receipts import ReceiptSender
from potserver.adapters.writer import Bounds, Keeper, MapWriter
from potserver.atoms.store import AtomStore
from potserver.config import Settings
from potserver.domain.order import CloudOrder, Heard
from potserver.errors import ShuttingDownError
from potserver.health import Health
from potserver.log import get_logger
from potserver.mapping.service import MappingService
from potserver.threads import spawn

log = get_logger("potserver.server")

FLUSH_S = 3.0  # for what waits in the outboxes, after the drain
QUEUE_MESSAGES = 8  # of the largest size: so many bytes may wait in one queue
_PROMPT_TASKS = 4096  # receipts and ticks: small, and never dropped
_BULK_TASKS = 64  # parameters: large, and dropped beyond this


class _Declaration(Protocol):
    def run(self) -> None: ...
    def undeclare(self) -> None: ...


class Shared(NamedTuple):
    """What all maps of a server share."""

    settings: Settings
    session: zenoh.Session
    pool: QueryPool
    atoms: AtomStore
    health: Health


class MapNode:
    """One map of a server.

    Threads: a writer (the only one that changes the map), two outboxes, and one reader for each of clouds, poses, queries,
    control and robots' tokens.
    """

    def __init__(self, mapper: MappingService, keeper: Keeper, heard: Heard, shared: Shared) -> None:
        """Declare everything, and begin to work.

        Args:
            mapper: Of the map.
            keeper: Where the map survives.
            heard: The last numbers of its robots, from before.
            shared: With the other maps of the server.
        """
        settings, limits, health = shared.settings, shared.settings.limits, shared.health
        self.map_id, self.mapper = mapper.map_id, mapper
        self._session, self._keys = shared.session, keys.MapKeys(settings.root, mapper.map_id)
        self._tokens: collections.deque[ServerToken] = collections.deque()
        n_bytes = QUEUE_MESSAGES * limits.max_cloud_bytes
        self.intake = IntakeQueue(max_queued=settings.intake.max_queued, max_queued_bytes=n_bytes)
        self.prompt = Outbox(f"{self.map_id}-prompt", max_pending=_PROMPT_TASKS, max_pending_bytes=n_bytes)
        self.bulk = Outbox(f"{self.map_id}-bulk", max_pending=_BULK_TASKS, max_pending_bytes=n_bytes)
        self._receipts = ReceiptSender(
            self._session,
            self._keys,
            mapper=mapper,
            intake=self.intake,
            health=health,
            limits=limits,
            prompt=self.prompt,
            bulk=self.bulk,
        )
        poses = PoseBuffer(
            max_gap_s=settings.poses.max_gap_s,
            max_future_s=settings.intake.max_future_s,
            max_robots=limits.max_robots,
        )
        writer = MapWriter(
            mapper,
            keeper,
            order=CloudOrder(heard, allow_repeats=settings.intake.allow_repeats),
            bounds=Bounds(
                settings.intake.max_future_s,
                limits.max_coordinate_m,
                limits.max_map_bytes,
                limits.max_robot_bytes,
            ),
            intake=self.intake,
            reader=CloudReader(limits, poses),
            receipts=self._receipts,
            health=health,
        )
        self.robots = RobotWatch(self._session, self._keys, health=health, max_robots=limits.max_robots)
        self._declarations = [self.robots, *self._declare(poses, writer, keeper, shared)]
        self._threads = [
            spawn(f"{self.map_id}-writer", writer.run),
            *(spawn(f"{self.map_id}-{type(d).__name__}", d.run) for d in self._declarations),
        ]

    def _declare(
        self, poses: PoseBuffer, writer: MapWriter, keeper: Keeper, shared: Shared
    ) -> list[_Declaration]:
        """The ways in, for poses, clouds, questions and control."""
        settings, limits, health = shared.settings, shared.settings.limits, shared.health
        session, map_keys, allowed = self._session, self._keys, frozenset(settings.intake.robots)
        door = CloudDoor(self.intake, self._receipts, health, limits, allowed)
        served = Served(
            server_id=settings.server_id,
            map_id=self.map_id,
            maps=settings.maps,
            mapper=self.mapper,
            atoms=shared.atoms,
            health=health,
            audit=Audit(self.map_id),
            limits=limits,
            durable=keeper.durable,
            check_readable=keeper.check_readable,
        )
        answers = Answers(served, shared.pool)
        return [
            PoseSubscriber(session, map_keys, poses=poses, health=health, allowed_robots=allowed),
            CloudSubscriber(session, map_keys, door),
            IntegrateQueryable(session, map_keys, door, health),
            MapQueryable(session, map_keys, questions=QUESTIONS, answers=answers, health=health),
            ControlQueryable(
                session,
                map_keys,
                served=served,
                answers=answers,
                intake=self.intake,
                writer=writer,
                withdraw=self.withdraw,
                prompt=self.prompt,
            ),
        ]

    def announce(self, server_id: str) -> None:
        """Say that the map is served."""
        self._tokens.append(ServerToken(self._session, self._keys, server_id))

    def withdraw(self) -> None:
        """Say that it is not, and take no more clouds; from any thread, any number of times."""
        self.intake.stop_admitting()
        with contextlib.suppress(IndexError):
            while True:
                self._tokens.pop().undeclare()

    def drain(self, deadline: float) -> bool:
        """Map the clouds that wait; refuse those left at the deadline. False if any were left."""
        idle = self.intake.wait_idle(max(0.0, deadline - time.monotonic()))
        clouds, barriers = self.intake.close()
        closing = ShuttingDownError("the server is closing")
        for job in clouds:
            self._receipts.refuse(job, closing)
        for barrier in barriers:
            barrier.refuse(closing)
        return idle and not clouds and not barriers

    def close(self) -> bool:
        """Undeclare, send what waits, end the threads. False if something did not end in time."""
        deadline = time.monotonic() + FLUSH_S
        for declaration in self._declarations:
            declaration.undeclare()
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        # an outbox flushes last: the threads above were filling it
        flushed = [outbox.close(FLUSH_S) for outbox in (self.prompt, self.bulk)]
        alive = [thread.name for thread in self._threads if thread.is_alive()]
        if alive:
            log.warning("threads_left_behind", threads=alive)
        return all(flushed) and not alive
