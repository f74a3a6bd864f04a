"""The composition root: builds the parts of a server, starts and stops them in order.

    with MapServer(Settings(), listen="tcp/127.0.0.1:0") as server:
        client = MapClient(server.endpoint)

Threads, besides Zenoh's own: per map a writer (the only one that changes the map), two outboxes, one for snapshots, and one
reader for each of clouds, poses, queries, control and robots' tokens; per server the query workers, the stats
publisher and its queryable.
"""

from __future__ import annotations

import atexit
import collections
import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Protocol

import zenoh

from potschemas import __version__, keys
from potserver.adapters import codec
from potserver.adapters.cloud_subscriber import CloudSubscriber
from potserver.adapters.intake import IntakeQueue
from potserver.adapters.log import get_logger
from potserver.adapters.outbox import Outbox
from potserver.adapters.ports import Asker, Keeper, Mapper
from potserver.adapters.pose_subscriber import PoseSubscriber
from potserver.adapters.poses import PoseBuffer
from potserver.adapters.presence import RobotWatch, ServerToken
from potserver.adapters.query_pool import QueryPool
from potserver.adapters.queryables import ControlQueryable, MapQueryable, StatsQueryable
from potserver.adapters.receipts import ReceiptSender
from potserver.adapters.session import build_config, close_session, open_session
from potserver.adapters.threads import spawn
from potserver.adapters.writer import MapWriter
from potserver.asking.service import QueryService
from potserver.atoms.store import AtomStore
from potserver.config import Settings, as_tree
from potserver.domain.dictionary import AtomDictionary
from potserver.errors import ShuttingDownError
from potserver.health import Health, rss_bytes
from potserver.mapping.service import MappingService
from potserver.numerics.threads import default_threads
from potserver.storage.map_store import MapStore, MemoryOnly

log = get_logger("potserver.server")

_FLUSH_S = 3.0  # for what waits in the outboxes, after the drain
_CLOSE_S = 5.0  # for Zenoh to close

MakeMap = Callable[[str], tuple[Mapper, Asker]]


class _Declaration(Protocol):
    def run(self) -> None: ...
    def undeclare(self) -> None: ...


class MapServer:
    """A map server in this process.

    Args:
        settings: The settings tree; all defaults if left out.
        listen: An endpoint that takes the place of `settings.zenoh.listen`; port 0 picks a free one.
        make_map: Makes the mapper and the asker of a map id; for tests and for other mappers. Default:
            `MappingService` and `QueryService` on the dictionary that the settings name.
    """

    def __init__(
        self,
        settings: Settings | None = None,
        *,
        listen: str | None = None,
        make_map: MakeMap | None = None,
    ) -> None:
        settings = settings or Settings()
        if listen is not None:
            settings = dataclasses.replace(
                settings, zenoh=dataclasses.replace(settings.zenoh, listen=(listen,))
            )
        self.settings = settings
        self.health = Health()
        self._make_map = make_map or _default_maps(settings)
        self._session: zenoh.Session | None = None
        self._endpoints: list[str] = []
        self._nodes: dict[str, _MapNode] = {}
        self._pool: QueryPool | None = None
        self._stats: _StatsPublisher | None = None
        self._stores: dict[str, MapStore] = {}
        self._stopping = threading.Event()
        self._lock = threading.Lock()  # start and stop, one at a time
        self._stopped_clean: bool | None = None

    # --- life -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Listen, warm up, declare, and only then say that we are there.

        Raises:
            SettingsError: an endpoint is taken, or the Zenoh configuration is illegal.
            DictionaryError: the dictionary file is missing or damaged.
            StorageError: another server has the store, or the disk refuses.
            MapFileError: a kept map is damaged, of another version, or does not fit the settings.
        """
        with self._lock:
            if self._session is not None or self._stopped_clean is not None:
                raise RuntimeError("a MapServer starts once")
            s = self.settings
            log.info("server_starting", version=__version__, settings=as_tree(s))
            services = {map_id: self._make_map(map_id) for map_id in s.maps}
            config = build_config(s.zenoh, root=s.root, wire_guard_bytes=s.limits.wire_guard_bytes)
            try:
                stamps = {
                    map_id: self._open_store(map_id, mapper) for map_id, (mapper, _) in services.items()
                }
                self._session, self._endpoints = open_session(config)
            except BaseException:
                self._close_stores()
                raise
            atexit.register(self.stop)  # leaving with Zenoh open would abort the process
            try:
                started_s = time.perf_counter()
                mapper, asker = next(iter(services.values()))  # all maps share the compiled numerics
                mapper.warm_up()
                asker.warm_up()
                log.info("server_warmed_up", elapsed_ms=round((time.perf_counter() - started_s) * 1e3, 1))
                self._pool = QueryPool(
                    threads=s.queries.threads,
                    max_queued=s.queries.max_queued,
                    max_queued_bytes=8 * s.limits.max_query_bytes,
                    retry_after_s=0.2,
                )
                atoms = _atom_store([mapper for mapper, _ in services.values()], s)
                for map_id, (mapper, asker) in services.items():
                    self._nodes[map_id] = _MapNode(
                        map_id,
                        mapper,
                        asker,
                        atoms,
                        keeper=self._stores.get(map_id, MemoryOnly()),
                        last_stamps=stamps[map_id],
                        session=self._session,
                        pool=self._pool,
                        health=self.health,
                        settings=s,
                    )
                self._stats = _StatsPublisher(self._session, self._encode_stats, settings=s)
                for node in self._nodes.values():
                    node.announce(s.server_id)
            except BaseException:
                self._teardown(0.0)
                raise
            log.info(
                "server_started",
                server_id=s.server_id,
                endpoints=self._endpoints,
                maps={map_id: mapper.n_scans for map_id, (mapper, _) in services.items()},
                store=s.store.directory or "memory only",
            )

    def stop(self, drain_timeout_s: float | None = None) -> bool:
        """Take no more clouds, map those that wait, answer everybody, and close. Never hangs; may be called
        twice.

        Args:
            drain_timeout_s: For the clouds that wait; those left get a receipt `shutting_down`. Default: the
                setting.
        Returns:
            Whether all clouds were mapped and everything closed in time.
        """
        with self._lock:
            if self._stopped_clean is None:
                timeout_s = self.settings.drain_timeout_s if drain_timeout_s is None else drain_timeout_s
                self._stopped_clean = self._teardown(timeout_s)
                atexit.unregister(self.stop)
            return self._stopped_clean

    def __enter__(self) -> MapServer:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()

    # --- state ----------------------------------------------------------------------------------------------

    @property
    def endpoint(self) -> str:
        """Where clients connect, e.g. `tcp/127.0.0.1:7447`; the first, if there are several."""
        if not self._endpoints:
            raise RuntimeError("the server does not listen: it is not started, or a client of a router")
        return self._endpoints[0]

    @property
    def endpoints(self) -> list[str]:
        """All endpoints that we listen on."""
        return list(self._endpoints)

    @property
    def state(self) -> str:
        """`serving`, or `draining` when no map takes clouds any more."""
        serving = any(node.intake.is_admitting for node in self._nodes.values())
        return "serving" if serving and not self._stopping.is_set() else "draining"

    def mapper(self, map_id: str) -> Mapper:
        """The mapper of one map, for programs that embed the server. Only read from it."""
        return self._nodes[map_id].mapper

    # --- parts ----------------------------------------------------------------------------------------------

    def _encode_stats(self) -> codec.Wire:
        nodes = list(self._nodes.values())
        pool = self._pool
        return codec.encode_stats(
            server_id=self.settings.server_id,
            stamp_ns=time.time_ns(),
            uptime_s=self.health.uptime_s,
            state=self.state,
            counters=self.health.counters() | {"robots.alive": sum(node.robots.n_alive for node in nodes)},
            queues={
                "clouds.depth": sum(node.intake.depth for node in nodes),
                "clouds.bytes": sum(node.intake.n_bytes for node in nodes),
                "queries.depth": pool.depth if pool else 0,
                "queries.bytes": pool.n_bytes if pool else 0,
                "outbox.prompt": sum(node.prompt.depth for node in nodes),
                "outbox.bulk": sum(node.bulk.depth for node in nodes),
            },
            latencies=self.health.latencies(),
            rss_bytes=rss_bytes(),
            map_kernels={node.map_id: len(node.mapper.snapshot) for node in nodes},
            map_scores={
                node.map_id: (node.mapper.scores, node.mapper.snapshot.rule.mean_moderation) for node in nodes
            },
        )

    def _open_store(self, map_id: str, mapper: Mapper) -> dict[str, int]:
        """Give a map what was kept of it; the newest stamps of its robots."""
        s = self.settings.store
        if not s.directory:
            return {}
        store = MapStore(
            Path(s.directory).expanduser(),
            map_id,
            keeps_evidence=mapper.keeps_evidence,
            health=self.health,
            fsync=s.fsync,
        )
        self._stores[map_id] = store
        return store.restore(mapper).stamps

    def _close_stores(self) -> bool:
        stores, self._stores = self._stores, {}
        closed = [store.close() for store in stores.values()]  # all of them, whatever the first says
        return all(closed)

    def _teardown(self, drain_timeout_s: float) -> bool:
        session = self._session
        if session is None:
            return True
        self._stopping.set()
        nodes = list(self._nodes.values())
        log.info(
            "server_draining", clouds=sum(node.intake.depth for node in nodes), timeout_s=drain_timeout_s
        )
        deadline = time.monotonic() + drain_timeout_s
        for node in nodes:
            node.withdraw()
        # subscribers live on through the drain, so that whoever still sends is told
        drained = [node.drain(deadline) for node in nodes]
        answered = self._pool is None or self._pool.close(_FLUSH_S)
        if self._stats is not None:
            self._stats.close()
        ended = [node.close() for node in nodes]
        kept = self._close_stores()  # after the writers: a last snapshot of what they made
        clean = all([*drained, answered, *ended, kept, close_session(session, _CLOSE_S)])
        self._session = None
        log.info("server_stopped", clean=clean, counters=self.health.counters())
        return clean


class _MapNode:
    """Everything of one map."""

    def __init__(
        self,
        map_id: str,
        mapper: Mapper,
        asker: Asker,
        atoms: AtomStore,
        *,
        keeper: Keeper,
        last_stamps: Mapping[str, int],
        session: zenoh.Session,
        pool: QueryPool,
        health: Health,
        settings: Settings,
    ) -> None:
        s = settings
        self.map_id, self.mapper = map_id, mapper
        self._session = session
        self._keys = keys.MapKeys(s.root, map_id)
        self._tokens: collections.deque[ServerToken] = collections.deque()
        allowed = frozenset(s.intake.robots)
        self.intake = IntakeQueue(
            max_queued=s.intake.max_queued,
            max_queued_bytes=8 * s.limits.max_cloud_bytes,
            retry_after_s=0.5,
        )
        self.prompt = Outbox(
            f"{map_id}-prompt", max_pending=4096, max_pending_bytes=8 * s.limits.max_cloud_bytes
        )
        self.bulk = Outbox(f"{map_id}-bulk", max_pending=64, max_pending_bytes=8 * s.limits.max_cloud_bytes)
        self._receipts = ReceiptSender(
            session,
            self._keys,
            mapper=mapper,
            intake=self.intake,
            health=health,
            limits=s.limits,
            prompt=self.prompt,
            bulk=self.bulk,
        )
        poses = PoseBuffer(
            max_robots=s.limits.max_robots,
            max_gap_s=s.poses.max_gap_s,
            max_future_s=s.intake.max_future_s,
        )
        self._writer = MapWriter(
            map_id,
            mapper=mapper,
            keeper=keeper,
            last_stamps=last_stamps,
            intake=self.intake,
            receipts=self._receipts,
            poses=poses,
            health=health,
            limits=s.limits,
            allowed_robots=allowed,
            allow_old_stamps=s.intake.allow_old_stamps,
            max_future_s=s.intake.max_future_s,
            pose_wait_s=0.2,
        )
        self._writer_thread = spawn(f"{map_id}-writer", self._writer.run)

        def encode_info() -> codec.Wire:
            return codec.encode_info(
                server_id=s.server_id,
                version=__version__,
                map_id=map_id,
                maps=s.maps,
                profile=mapper.settings.profile,
                snapshot=mapper.snapshot,
                n_atoms=len(mapper.dictionary),
                n_scans=mapper.n_scans,
                tile_size_m=mapper.settings.tile_size_m,
                max_range_m=mapper.settings.max_range_m,
                limits=s.limits,
                started_ns=health.started_ns,
                durable=keeper.durable,
            )

        self.robots = RobotWatch(session, self._keys, health=health, max_robots=s.limits.max_robots)
        self._declarations: list[_Declaration] = [
            self.robots,
            PoseSubscriber(session, self._keys, poses=poses, health=health, allowed_robots=allowed),
            CloudSubscriber(
                session,
                self._keys,
                intake=self.intake,
                receipts=self._receipts,
                health=health,
                limits=s.limits,
                allowed_robots=allowed,
            ),
            MapQueryable(
                session,
                self._keys,
                mapper=mapper,
                asker=asker,
                atoms=atoms,
                intake=self.intake,
                receipts=self._receipts,
                pool=pool,
                health=health,
                limits=s.limits,
                grid_part_cells=65_536,
                params_part_kernels=20_000,
                tiles_part_kernels=20_000,
                encode_info=encode_info,
            ),
            ControlQueryable(
                session,
                self._keys,
                mapper=mapper,
                intake=self.intake,
                writer=self._writer,
                withdraw=self.withdraw,
                prompt=self.prompt,
                health=health,
                limits=s.limits,
            ),
        ]
        self._threads = [spawn(f"{map_id}-{type(d).__name__}", d.run) for d in self._declarations]

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
        deadline = time.monotonic() + _FLUSH_S
        for declaration in self._declarations:
            declaration.undeclare()
        for thread in [*self._threads, self._writer_thread]:
            thread.join(max(0.0, deadline - time.monotonic()))
        # an outbox flushes last: the threads above were filling it
        flushed = [outbox.close(_FLUSH_S) for outbox in (self.prompt, self.bulk)]
        alive = [thread.name for thread in [*self._threads, self._writer_thread] if thread.is_alive()]
        if alive:
            log.warning("threads_left_behind", threads=alive)
        return all(flushed) and not alive


class _StatsPublisher:
    """`srv/<server>/stats`: once a second, and when asked."""

    def __init__(
        self, session: zenoh.Session, encode: Callable[[], codec.Wire], *, settings: Settings
    ) -> None:
        key = keys.stats_key(settings.root, settings.server_id)
        self._encode, self._period_s = encode, 1.0
        self._stop = threading.Event()
        # background: the first to go when a link is full
        self._publisher = session.declare_publisher(
            key, priority=zenoh.Priority.BACKGROUND, congestion_control=zenoh.CongestionControl.DROP
        )
        self._queryable = StatsQueryable(session, key, encode_stats=encode, limits=settings.limits)
        self._threads = [spawn("stats-publisher", self._run), spawn("stats-queryable", self._queryable.run)]

    def close(self) -> None:
        self._stop.set()
        self._queryable.undeclare()
        for thread in self._threads:
            thread.join(1.0)
        self._publisher.undeclare()

    def _run(self) -> None:
        next_s = time.monotonic()
        while not self._stop.wait(max(0.0, next_s - time.monotonic())):
            next_s = max(next_s + self._period_s, time.monotonic())
            try:
                wire = self._encode()
                self._publisher.put(wire.payload, encoding=wire.encoding)
            except Exception:
                log.exception("stats_failed")


def _atom_store(mappers: list[Mapper], settings: Settings) -> AtomStore:
    """One for all maps of the server, whose dictionary is the same."""

    def use(dictionary: AtomDictionary) -> None:
        for mapper in mappers:
            mapper.use_dictionary(dictionary)

    is_saved = settings.atoms.save and settings.dictionary is not None
    return AtomStore(
        mappers[0].dictionary,
        use,
        writable=settings.atoms.writable,
        file=Path(str(settings.dictionary)) if is_saved else None,
        threads=settings.threads or default_threads(),
    )


def _default_maps(settings: Settings) -> MakeMap:
    dictionary: list[AtomDictionary] = []  # loaded once, when the first map is made

    def make(map_id: str) -> tuple[Mapper, Asker]:
        if not dictionary:
            dictionary.append(
                AtomDictionary.builtin()
                if settings.dictionary is None
                else AtomDictionary.load(settings.dictionary)
            )
        mapping = MappingService(dictionary[0], settings.mapping, map_id=map_id, threads=settings.threads)
        asker = QueryService(
            mapping,
            max_points=settings.limits.max_query_points,
            max_grid_cells=settings.limits.max_grid_cells,
            max_samples=settings.limits.max_query_samples,
            max_rays=settings.limits.max_query_rays,
            max_poses=settings.limits.max_query_poses,
            max_spheres=settings.limits.max_query_spheres,
            max_known_tiles=settings.limits.max_query_tiles,
            max_coordinate_m=settings.limits.max_coordinate_m,
        )
        return mapping, asker

    return make
