"""Who is there: our own tokens, and the robots'."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable

import zenoh

from potschemas import keys
from potserver.adapters.key_exprs import sender_of
from potserver.errors import SettingsError
from potserver.health import Health
from potserver.log import get_logger
from potserver.threads import spawn

log = get_logger("potserver.presence")


# The token of a process that ended vanishes with its connection: at once, or after Zenoh's lease of 10 s where the
# machine or the network went away.
GONE_S = 12.0
_POLL_S = 0.25
_ASK_S = 2.0  # for the tokens that routers know


class OtherServers:
    """Who else serves our maps. A context: it listens from its entry on.

    It asks and listens too: only an answered question says that all tokens of now were heard of, but a question to a
    peer that is reached both directly and over a router sometimes comes back empty (Zenoh 1.10).
    """

    def __init__(self, session: zenoh.Session, maps: Iterable[keys.MapKeys]) -> None:
        self._session, self._maps = session, tuple(maps)
        self._lock = threading.Lock()
        self._heard: set[str] = set()  # keys of tokens
        self._subscribers: list[zenoh.Subscriber[None]] = []

    def __enter__(self) -> OtherServers:
        for map_keys in self._maps:
            self._subscribers.append(
                self._session.liveliness().declare_subscriber(
                    map_keys.server_token("*"), self._note, history=True
                )
            )
        return self

    def __exit__(self, *_: object) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()

    def refuse(self) -> None:
        """Wait until nobody else serves our maps: two writers of one map would each give every cloud a receipt.

        A token may be that of a server that has just crashed, so it gets `GONE_S` to vanish.

        Raises:
            SettingsError: another server still serves one of them.
        """
        until = time.monotonic() + GONE_S
        for map_keys in self._maps:
            waited = False
            while others := self._servers(map_keys):
                names = ", ".join(others)
                if time.monotonic() >= until:
                    raise SettingsError(
                        f"map {map_keys.map_id!r} under the root {map_keys.root!r} is served already, by {names}: serve"
                        " another map (--map ID), take another root (--root KEY), or stop that server"
                    )
                if not waited:
                    waited = True
                    log.warning("map_served_already", map_id=map_keys.map_id, server_id=names, wait_s=GONE_S)
                time.sleep(_POLL_S)

    def _servers(self, map_keys: keys.MapKeys) -> list[str]:
        """Ids of the servers of a map that others have announced."""
        replies = self._session.liveliness().get(map_keys.server_token("*"), timeout=_ASK_S)
        tokens = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        with self._lock:
            tokens |= self._heard
        served = map(keys.server_of, tokens)
        return sorted(server_id for server_id, map_id in served if map_id == map_keys.map_id)

    def _note(self, sample: zenoh.Sample) -> None:
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                self._heard.discard(str(sample.key_expr))
            else:
                self._heard.add(str(sample.key_expr))


class ServerToken:
    """Says that this server serves a map and is warm, until undeclared or until the process dies."""

    def __init__(self, session: zenoh.Session, map_keys: keys.MapKeys, server_id: str) -> None:
        self._token = session.liveliness().declare_token(map_keys.server_token(server_id))

    def undeclare(self) -> None:
        """Say that no more work should come here."""
        self._token.undeclare()


class SessionWatch:
    """Counts the sessions that are connected to us, and gives up the questions of those whose connection ended.

    Of sessions behind a router we do not hear: deadlines end their questions. A token of the asker would travel through
    routers, but anybody could undeclare another's.

    Args:
        session: Ours.
        give_up: Ends the questions of a session, by its Zenoh id; how many there were.
        max_sessions: How many may be there. Zenoh lets no more in, and tells nobody: so the log says when it is full.
    """

    def __init__(self, session: zenoh.Session, give_up: Callable[[str], int], max_sessions: int) -> None:
        self._give_up, self._max_sessions = give_up, max_sessions
        self._open: set[str] = set()
        self._events = session.info.declare_transport_events_listener(
            zenoh.handlers.FifoChannel(64), history=True
        )
        self._thread = spawn("session-watch", self._run)

    @property
    def n_open(self) -> int:
        """Sessions that are connected now."""
        return len(self._open)

    def close(self) -> None:
        """Follow no more."""
        self._events.undeclare()
        self._thread.join(1.0)

    def _run(self) -> None:
        for event in self._events:
            zid = str(event.transport.zid)
            if event.kind == zenoh.SampleKind.DELETE:
                self._open.discard(zid)
                n = self._give_up(zid)
                if n:
                    log.info("asker_gone", zid=zid, n_questions=n)
            else:
                self._open.add(zid)
                if len(self._open) == self._max_sessions:
                    log.warning("sessions_full", n_sessions=self._max_sessions)


class RobotWatch:
    """Which robots hold a token for a map."""

    def __init__(
        self, session: zenoh.Session, map_keys: keys.MapKeys, *, health: Health, max_robots: int
    ) -> None:
        self._map_id, self._health, self._max_robots = map_keys.map_id, health, max_robots
        self._lock = threading.Lock()
        self._alive: set[str] = set()
        self._subscriber = session.liveliness().declare_subscriber(
            map_keys.robot_token("*"), zenoh.handlers.FifoChannel(64), history=True
        )

    @property
    def n_alive(self) -> int:
        """Robots with a token now."""
        with self._lock:
            return len(self._alive)

    def run(self) -> None:
        """Follow the tokens until undeclared, on a thread of our own."""
        for sample in self._subscriber:
            try:
                robot_id = keys.check_id(sender_of(sample.key_expr) or "", "robot")
            except ValueError as error:
                self._health.count("presence.rejected.bad_key")
                log.debug("robot_token_ignored", key=str(sample.key_expr), detail=str(error))
            else:
                self._note(robot_id, sample)

    def undeclare(self) -> None:
        """Follow no more; ends `run`."""
        self._subscriber.undeclare()

    def _note(self, robot_id: str, sample: zenoh.Sample) -> None:
        with self._lock:
            if sample.kind == zenoh.SampleKind.DELETE:
                is_news = robot_id in self._alive
                self._alive.discard(robot_id)
            else:
                is_news = robot_id not in self._alive and len(self._alive) < self._max_robots
                if is_news:
                    self._alive.add(robot_id)
        if is_news:
            event = "robot_left" if sample.kind == zenoh.SampleKind.DELETE else "robot_joined"
            log.info(event, map_id=self._map_id, robot_id=robot_id)
