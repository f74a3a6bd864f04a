"""The composition root: builds the parts of a server, starts and stops them in order.

    with MapServer(Settings(), listen="tcp/127.0.0.1:0") as server:
        client = MapClient(server.endpoint)

Threads, besides Zenoh's own and those of `MapNode`: the query workers, one that learns what is new, the stats publisher and
its queryable, one a store for snapshots, and, with `web.listen`, those of HTTP.
"""

from __future__ import annotations

import atexit
import dataclasses
import functools
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import zenoh

from potclient.client import MapClient
from potschemas import __version__, keys, messages
from potserver.adapters.presence import OtherServers, SessionWatch
from potserver.adapters.proposer import Proposer
from potserver.adapters.query_pool import QueryPool
from potserver.adapters.session import (
    build_config,
    close_session,
    max_sessions_of,
    open_session,
    raise_file_limit,
)
from potserver.adapters.stats import StatsPublisher, stats_now
from potserver.atoms.store import AtomStore
from potserver.compiling import Helper, warm_up
from potserver.config import Settings, as_tree
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.order import Heard
from potserver.errors import MapDamagedError
from potserver.health import Health
from potserver.log import get_logger
from potserver.mapping.service import MappingService
from potserver.node import FLUSH_S, QUEUE_MESSAGES, MapNode, Shared
from potserver.numerics.threads import default_threads
from potserver.ros.bridge import Bridge
from potserver.storage.map_store import MapStore, MemoryOnly
from potserver.storage.read_only import ReadOnlyStore
from potserver.web.listener import Served, WebListener

log = get_logger("potserver.server")

_CLOSE_S = 5.0  # for Zenoh to close

MakeMap = Callable[[str], MappingService]  # of a map id


class MapServer:
    """A map server in this process.

    Args:
        settings: The settings tree; all defaults if left out.
        listen: An endpoint that takes the place of `settings.zenoh.listen`; port 0 picks a free one.
        make_map: Makes the mapper of a map id, for tests and for other mappers. Default: a `MappingService` on the
            dictionary that the settings name.
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
        self.nodes: dict[str, MapNode] = {}  # by map id; to look at
        self.pool: QueryPool | None = None
        self._proposer = Proposer(self.health)
        self._stats: StatsPublisher | None = None
        self._sessions: SessionWatch | None = None
        self._helper: Helper | None = None  # compiles beside us
        self._max_sessions = 0
        self._stores: dict[str, MapStore | ReadOnlyStore] = {}
        self.web: WebListener | None = None
        self._ros: tuple[Bridge, MapClient] | None = None
        self._stopping = threading.Event()
        self._lock = threading.Lock()  # start and stop, one at a time
        self._stopped_clean: bool | None = None

    # --- life -----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Listen, warm up, declare, and only then say that we are there.

        Raises:
            SettingsError: an endpoint is taken, the Zenoh configuration is illegal, or another server on the network serves one
                of the maps.
            DictionaryError: the dictionary file is missing or damaged.
            StorageError: another server has the store, or the disk refuses.
            MapFileError: a kept map is damaged, of another version, or does not fit the settings.
        """
        with self._lock:
            if self._session is not None or self._stopped_clean is not None:
                raise RuntimeError("a MapServer starts once")
            s = self.settings
            log.info("server_starting", version=__version__)
            log.debug("settings_in_use", settings=as_tree(s))
            if s.web.listen is not None:  # first: who asks whether we are ready hears "starting" until we are
                self.web = WebListener(s.web.listen, self._served())
            try:
                self._start(s)
            except BaseException:
                self._close_web()
                raise

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
        """`starting`, `serving`, `damaged` when the disk cannot read back a part of a map, or `draining` when no map takes
        clouds any more."""
        if not self.nodes and not self._stopping.is_set():
            return "starting"
        try:
            for store in list(self._stores.values()):
                store.check_readable()
        except MapDamagedError:
            return "damaged"
        serving = any(node.intake.is_admitting for node in self.nodes.values())
        return "serving" if serving and not self._stopping.is_set() else "draining"

    def stats(self) -> messages.Stats:
        """The counters now, as `pot.stats.v1` has them."""
        nodes = list(self.nodes.values())
        pool = self.pool
        return stats_now(
            self.health,
            server_id=self.settings.server_id,
            state=self.state,
            n_robots=sum(node.robots.n_alive for node in nodes),
            queues={
                "clouds.depth": sum(node.intake.depth for node in nodes),
                "clouds.bytes": sum(node.intake.n_bytes for node in nodes),
                "queries.depth": pool.depth if pool else 0,
                "queries.bytes": pool.n_bytes if pool else 0,
                "outbox.prompt": sum(node.prompt.depth for node in nodes),
                "outbox.bulk": sum(node.bulk.depth for node in nodes),
                "sessions": self._sessions.n_open if self._sessions else 0,
            },
            maps={node.map_id: node.mapper.state for node in nodes},
        )

    def mapper(self, map_id: str) -> MappingService:
        """The mapper of one map, for programs that embed the server. Only read from it."""
        return self.nodes[map_id].mapper

    # --- parts ----------------------------------------------------------------------------------------------

    def _start(self, s: Settings) -> None:
        mappers = [self._make_map(map_id) for map_id in s.maps]
        if s.atoms.writable and not s.store.read_only:
            for mapper in mappers:
                mapper.keep_looks(functools.partial(self._proposer.propose, mapper))
        config = build_config(s.zenoh, root=s.root, wire_guard_bytes=s.limits.wire_guard_bytes)
        self._max_sessions = raise_file_limit(max_sessions_of(config))
        try:
            heard = [self._open_store(mapper) for mapper in mappers]
            self._session, self._endpoints = open_session(config)
        except BaseException:
            self._close_stores()
            raise
        atexit.register(self.stop)  # leaving with Zenoh open would abort the process
        try:
            served = [keys.MapKeys(s.root, map_id) for map_id in s.maps]
            with OtherServers(self._session, served) as others:
                others.refuse()
                self._helper = _warm_up(mappers[0])  # all maps share the compiled numerics
                others.refuse()  # one that was warming up beside us
            self._serve(self._session, mappers, heard)
        except BaseException:
            self._teardown(0.0)
            raise
        log.info(
            "server_started",
            server_id=s.server_id,
            endpoints=self._endpoints,
            maps={mapper.map_id: mapper.n_scans for mapper in mappers},
            store=s.store.directory or "memory only",
        )

    def _serve(self, session: zenoh.Session, mappers: list[MappingService], heard: list[Heard]) -> None:
        """Declare everything, and last say that the maps are there."""
        s = self.settings
        self.pool = QueryPool(
            threads=s.queries.threads,
            max_queued=s.queries.max_queued,
            max_queued_bytes=QUEUE_MESSAGES * s.limits.max_query_bytes,
            max_rate_hz=s.queries.max_rate_hz,
        )
        self._sessions = SessionWatch(session, self.pool.give_up, self._max_sessions)
        atoms = _atom_store(mappers, s)
        self._proposer.start(atoms)
        shared = Shared(s, session, self.pool, atoms, self.health)
        for mapper, numbers in zip(mappers, heard, strict=True):
            keeper = self._stores.get(mapper.map_id, MemoryOnly())
            self.nodes[mapper.map_id] = MapNode(mapper, keeper, numbers, shared)
        self._stats = StatsPublisher(session, keys.stats_key(s.root, s.server_id), self.stats, s.limits)
        for node in self.nodes.values():
            node.announce(s.server_id)
        if s.ros.clouds:
            client = MapClient(map=s.ros.map or s.maps[0], root=s.root, session=session)
            self._ros = Bridge(session, client, s.ros, self.health), client

    def _open_store(self, mapper: MappingService) -> Heard:
        """Give a map what was kept of it; the last numbers of its robots."""
        s, max_resident_bytes = self.settings.store, self.settings.limits.max_resident_bytes
        if not s.directory:
            return {}
        folder, map_id = Path(s.directory).expanduser(), mapper.map_id
        store: MapStore | ReadOnlyStore
        if s.read_only:
            store = ReadOnlyStore(
                folder,
                map_id,
                keeps_evidence=mapper.keeps_evidence,
                health=self.health,
                max_resident_bytes=max_resident_bytes,
            )
        else:
            store = MapStore(
                folder,
                map_id,
                keeps_evidence=mapper.keeps_evidence,
                health=self.health,
                fsync=s.fsync,
                max_resident_bytes=max_resident_bytes,
            )
        self._stores[mapper.map_id] = store
        return store.restore(mapper).heard

    def _close_ros(self) -> bool:
        """Take no more clouds from ROS, and withdraw our topics; those on their way to a map count as unknown."""
        ros, self._ros = self._ros, None
        if ros is None:
            return True
        bridge, client = ros
        ended = bridge.close()
        client.close()
        return ended

    def _close_stores(self) -> bool:
        stores, self._stores = self._stores, {}
        closed = [store.close() for store in stores.values()]  # all of them, whatever the first says
        return all(closed)

    def _served(self) -> Served:
        """What is told over HTTP."""

        def endpoint() -> str | None:
            return self._endpoints[0] if self._endpoints and self.state == "serving" else None

        return Served(lambda: self.state, self.stats, endpoint, self.settings.maps, self.settings.root)

    def _close_web(self) -> bool:
        return self.web is None or self.web.close()

    def _teardown(self, drain_timeout_s: float) -> bool:
        session = self._session
        if session is None:
            return True
        self._stopping.set()
        if self._helper is not None:
            self._helper.end()
        nodes = list(self.nodes.values())
        log.info(
            "server_draining", clouds=sum(node.intake.depth for node in nodes), timeout_s=drain_timeout_s
        )
        ros_ended = self._close_ros()
        deadline = time.monotonic() + drain_timeout_s
        for node in nodes:
            node.withdraw()
        # subscribers live on through the drain, so that whoever still sends is told
        drained = [node.drain(deadline) for node in nodes]
        answered = self.pool is None or self.pool.close(FLUSH_S)
        for part in (self._stats, self._sessions):
            if part is not None:
                part.close()
        ended = [node.close() for node in nodes]
        ended.append(self._proposer.close(FLUSH_S))
        kept = self._close_stores()  # after the writers: a last snapshot of what they made
        clean = all(
            [ros_ended, *drained, answered, *ended, kept, close_session(session, _CLOSE_S), self._close_web()]
        )
        self._session = None
        log.info("server_stopped", clean=clean, counters=self.health.counters())
        return clean


def _warm_up(mapper: MappingService) -> Helper | None:
    started_s = time.perf_counter()
    helper = warm_up(mapper)
    log.info("server_warmed_up", elapsed_ms=round((time.perf_counter() - started_s) * 1e3, 1))
    return helper


def _atom_store(mappers: list[MappingService], settings: Settings) -> AtomStore:
    """One for all maps of the server, whose dictionary is the same."""

    def use(dictionary: AtomDictionary) -> None:
        for mapper in mappers:
            mapper.use_dictionary(dictionary)

    is_saved = settings.atoms.save and settings.dictionary is not None
    return AtomStore(
        mappers[0].dictionary,
        use,
        writable=settings.atoms.writable and not settings.store.read_only,
        file=Path(str(settings.dictionary)) if is_saved else None,
        threads=settings.threads or default_threads(),
    )


def _default_maps(settings: Settings) -> MakeMap:
    dictionary: list[AtomDictionary] = []  # loaded once, when the first map is made

    def make(map_id: str) -> MappingService:
        if not dictionary:
            dictionary.append(
                AtomDictionary.builtin()
                if settings.dictionary is None
                else AtomDictionary.load(settings.dictionary)
            )
        return MappingService(dictionary[0], settings.mapping, map_id=map_id, threads=settings.threads)

    return make
