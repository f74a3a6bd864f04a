"""What each identity can do under a Zenoh configuration: measured, because what is denied is dropped without a word.

A node of our own stands in for the server, on loopback, under the server's configuration; each identity logs in with its own
and tries everything. No map is touched.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import zenoh

from potclient import zenoh_config
from potclient.errors import UsageError
from potschemas.keys import MapKeys, stats_key
from potserver.adapters.access import CONFIG, SERVER, Auth, Bounds, Roles
from potserver.adapters.session import open_session
from potserver.errors import SettingsError

STRANGER = "(nobody)"  # somebody without a certificate or a password
_MAP = "acl-check"
_OTHERS = zenoh.Locality.REMOTE  # what one session says to itself is no finding
_SETTLE_S = 0.5  # for declarations to travel, and for what should be denied to arrive all the same
_PATIENCE_S = 10.0  # for what is allowed
_PACE_S = 0.03  # between two tries: faster clouds or poses would be thinned, whatever else holds for them
_BURST = 1000  # poses at once
_SIZES = {"clouds": 32 * 2**20, "poses": 16 * 2**10, "questions": 16 * 2**20}  # where nothing is bounded


class Finding(NamedTuple):
    """Whether somebody can do something."""

    deed: str
    who: str
    may: bool  # by the roles
    can: bool  # measured


class _Deed:
    """Something that one identity tries."""

    def __init__(self, name: str, may: bool) -> None:
        self.name, self.may = name, may
        self.tries: list[Callable[[], object]] = []
        self._done = threading.Event()

    def note(self, *_: object) -> None:
        """It had its effect."""
        self._done.set()

    def is_done(self, timeout_s: float = 0.0) -> bool:
        """Whether it had."""
        return self._done.wait(timeout_s)


def measure(roles: Roles, folder: Path) -> list[Finding]:
    """Log in as everybody, and as nobody, and try everything.

    Args:
        roles: Who there is.
        folder: With the configurations that `potserver acl` wrote.
    Raises:
        SettingsError: a configuration or a certificate is missing, or Zenoh does not take it.
    """
    found = []
    with _stand_in(roles, folder) as (server, endpoint):
        bounds = Bounds.of((folder / CONFIG.format(name=SERVER)).read_text(encoding="utf-8"))
        for name in roles.everybody:
            client = _log_in(_config(folder, name, "connect", endpoint))
            found.append(Finding("log in", name, may=True, can=client is not None))
            if client is not None:
                with client:
                    found += _tried(name, _Attempts(server, client, roles, bounds, name).deeds)
        stranger = _config(folder, roles.everybody[0], "connect", endpoint)
        _take_proof(stranger, roles.auth)
        client = _log_in(stranger)
        found.append(Finding("log in", STRANGER, may=False, can=client is not None))
        if client is not None:
            client.close()
    return found


class _Attempts:
    """Everything that one identity tries; what it and the server declare for that is declared now."""

    def __init__(
        self, server: zenoh.Session, client: zenoh.Session, roles: Roles, bounds: Bounds, name: str
    ) -> None:
        self.deeds: list[_Deed] = []
        self._server, self._client = server, client
        keys, root = MapKeys(roles.root, _MAP), roles.root
        is_robot, is_operator = name in roles.robots, name in roles.operators
        other = next((robot for robot in roles.robots if robot != name), "another")
        self._asks("ask", True, keys.query("points"))
        self._asks("read the statistics", True, stats_key(root, SERVER))
        self._hears("follow the map's changes", True, keys.revision)
        self._sees("see that the server is there", True, keys.server_token("*"))
        self._puts("send clouds as itself", is_robot, keys.cloud(name))
        self._asks("integrate as itself", is_robot, keys.integrate(name))
        self._hears("hear its own receipts", is_robot, keys.receipt(name))
        self._says("announce itself as a robot", is_robot, keys.robot_token(name))
        self._puts("send clouds as another", False, keys.cloud(other))
        self._asks("integrate as another", False, keys.integrate(other))
        self._hears("hear another's receipts", False, keys.receipt(other))
        self._hears("hear another's clouds", False, keys.cloud(other))
        self._says("announce another robot", False, keys.robot_token(other))
        self._puts("forge receipts", False, keys.receipt(other))
        self._puts("forge changes", False, keys.revision)
        self._answers("answer for the server", False, keys.query("points"))
        self._asks("clear, load, merge a map", is_operator, keys.control("clear"))
        self._asks("change the dictionary", is_operator, keys.control("atoms"))
        sizes = _SIZES | bounds.sizes
        self._asks("ask up to the size", True, keys.query("points"), sizes["questions"])
        self._asks("ask beyond the size", False, keys.query("points"), sizes["questions"] + 1)
        for what, key in (("clouds", keys.cloud(name)), ("poses", keys.pose(name))):
            self._puts(f"send {what} up to the size", is_robot, key, sizes[what])
            self._puts(f"send {what} beyond the size", False, key, sizes[what] + 1)
        self._floods("send poses beyond the rate", keys.pose(name), bounds.poses_hz)

    def _deed(self, name: str, may: bool) -> _Deed:
        self.deeds.append(_Deed(name, may))
        return self.deeds[-1]

    def _puts(self, name: str, may: bool, key: str, n_bytes: int = 0) -> None:
        deed = self._deed(name, may)

        def noted(sample: zenoh.Sample) -> None:
            if len(sample.payload) == n_bytes:
                deed.note()

        self._server.declare_subscriber(key, noted, allowed_origin=_OTHERS)
        publisher = self._client.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        deed.tries.append(lambda: publisher.put(bytes(n_bytes)))

    def _floods(self, name: str, key: str, most_hz: float) -> None:
        """Twice as fast as it may counts as faster: what is thinned keeps the rate on average alone."""
        deed = self._deed(name, False)
        arrived_s: list[float] = []

        def noted(sample: zenoh.Sample) -> None:
            if len(sample.payload) == 1:
                arrived_s.append(time.monotonic())
                if len(arrived_s) > 10 and len(arrived_s) - 1 > 2 * most_hz * (arrived_s[-1] - arrived_s[0]):
                    deed.note()

        self._server.declare_subscriber(key, noted, allowed_origin=_OTHERS)
        publisher = self._client.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)

        def flood() -> None:
            for _ in range(_BURST):
                publisher.put(b"x")

        deed.tries.append(flood)

    def _hears(self, name: str, may: bool, key: str) -> None:
        deed = self._deed(name, may)
        self._client.declare_subscriber(key, deed.note, allowed_origin=_OTHERS)
        deed.tries.append(lambda: self._server.put(key, b""))

    def _asks(self, name: str, may: bool, key: str, n_bytes: int = 0) -> None:
        deed = self._deed(name, may)

        def noted(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                deed.note()

        deed.tries.append(lambda: self._client.get(key, noted, payload=bytes(n_bytes), timeout=_PATIENCE_S))

    def _answers(self, name: str, may: bool, key: str) -> None:
        deed = self._deed(name, may)
        self._client.declare_queryable(key, deed.note, allowed_origin=_OTHERS)
        deed.tries.append(
            lambda: self._server.get(
                key,
                target=zenoh.QueryTarget.ALL,
                timeout=_SETTLE_S,
                allowed_destination=_OTHERS,
            )
        )

    def _says(self, name: str, may: bool, key: str) -> None:
        deed = self._deed(name, may)
        self._server.liveliness().declare_subscriber(key, deed.note)
        deed.tries.append(lambda: self._client.liveliness().declare_token(key))

    def _sees(self, name: str, may: bool, key: str) -> None:
        deed = self._deed(name, may)
        self._client.liveliness().declare_subscriber(key, deed.note, history=True)


def _tried(name: str, deeds: list[_Deed]) -> list[Finding]:
    """Try all of them at once: what is allowed has its effect soon, what is denied has none for a while after that."""
    time.sleep(_SETTLE_S)
    kept = []  # tokens live as long as their objects
    for attempt in (attempt for deed in deeds for attempt in deed.tries):
        kept.append(attempt())
        time.sleep(_PACE_S)
    until = time.monotonic() + _PATIENCE_S
    for deed in deeds:
        if deed.may:
            deed.is_done(max(0.0, until - time.monotonic()))
    time.sleep(_SETTLE_S)
    found = [Finding(deed.name, name, deed.may, deed.is_done()) for deed in deeds]
    kept.clear()
    return found


@contextmanager
def _stand_in(roles: Roles, folder: Path) -> Iterator[tuple[zenoh.Session, str]]:
    """A node that declares what a server does, and where it listens."""
    protocol = "tls" if roles.auth is Auth.MTLS else "tcp"
    session, (endpoint,) = open_session(_config(folder, SERVER, "listen", f"{protocol}/127.0.0.1:0"))
    keys = MapKeys(roles.root, _MAP)

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"")

    with session:
        for key in (keys.cloud("*"), keys.pose("*")):
            session.declare_subscriber(key, lambda _: None)
        for key in (
            keys.integrate("*"),
            keys.query("*"),
            keys.control("*"),
            stats_key(roles.root, SERVER),
        ):
            session.declare_queryable(key, answer, complete=True)
        token = session.liveliness().declare_token(keys.server_token(SERVER))
        yield session, endpoint.replace("127.0.0.1", "localhost")
        token.undeclare()


def _config(folder: Path, name: str, side: str, endpoint: str) -> zenoh.Config:
    """What was written for somebody, with another endpoint."""
    path = folder / CONFIG.format(name=name)
    try:
        return zenoh_config.build(path, {}, [(f"{side}/endpoints", [endpoint])], {})
    except UsageError as error:
        raise SettingsError(str(error)) from error


def _take_proof(config: zenoh.Config, auth: Auth) -> None:
    """Leave nothing in a client's configuration that says who it is."""
    keys = (
        ("link/tls/connect_certificate", "link/tls/connect_private_key")
        if auth is Auth.MTLS
        else ("auth/usrpwd/user", "auth/usrpwd/password")
    )
    for key in keys:
        config.insert_json5(f"transport/{key}", json.dumps(None))


def _log_in(config: zenoh.Config) -> zenoh.Session | None:
    try:
        return zenoh.open(config)
    except zenoh.ZError:
        return None
