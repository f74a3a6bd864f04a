"""Our Zenoh node: a peer with one loopback listener and no multicast, unless told otherwise.

Four sources make the configuration, and later ones win: built-in values, the Zenoh configuration file, `--cfg KEY:VALUE`, and
the flags `-m -e -l`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import resource
import socket
import threading
from collections.abc import Mapping
from typing import Annotated, Any

import zenoh

from potclient import diagnosis, zenoh_config
from potclient.errors import UsageError
from potclient.zenoh_config import DEFAULT_ENDPOINT
from potserver.errors import SettingsError
from potserver.log import get_logger

log = get_logger("potserver.session")

MAX_MESSAGE_BYTES = 64 * 2**20  # of one reassembled message; the library's default is 1 GiB
MAX_SESSIONS = (
    1_000  # of others at once, a file descriptor each; `--cfg transport/unicast/max_sessions:N` changes it
)
_FREE_PORT_TRIES = 5
_OTHER_FILES = 256  # descriptors beside those of sessions: stores, logs, listeners, libraries


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ZenohSettings:
    """How our node joins a Zenoh network: the usual flags, by their usual names."""

    mode: Annotated[str | None, "`peer`, `client` or `router`; unset: peer"] = None
    connect: Annotated[tuple[str, ...], "endpoints of routers or peers to join"] = ()
    listen: Annotated[tuple[str, ...], "endpoints; none: tcp/127.0.0.1:7447. Port 0 picks a free one"] = ()
    config: Annotated[str | None, "a Zenoh configuration file; unset: `$ZENOH_CONFIG`"] = None
    cfg: Annotated[Mapping[str, Any], "single keys of it, as `--cfg KEY:VALUE`"] = dataclasses.field(
        default_factory=dict
    )
    shared_memory: Annotated[
        bool | None,
        "puts between processes of one host go through /dev/shm: fast, but every session leaves 18 MB; unset: off",
    ] = None


def build_config(settings: ZenohSettings, *, root: str, wire_guard_bytes: int) -> zenoh.Config:
    """The Zenoh configuration of a server.

    A built-in value holds where the file leaves the library's own value.

    Args:
        settings: From the settings tree.
        root: Key prefix that the size guard covers.
        wire_guard_bytes: Zenoh drops larger puts and queries without a word, so this lies far above our own
            limits.
    Raises:
        SettingsError: the file cannot be read, or Zenoh refuses a key or value.
    """
    flags = {
        "mode": settings.mode,
        "connect/endpoints": settings.connect,
        "listen/endpoints": settings.listen,
        zenoh_config.SHM_ENABLED: settings.shared_memory,
    }
    try:
        config = zenoh_config.build(
            settings.config,
            _built_in(root, wire_guard_bytes),
            settings.cfg.items(),
            flags,
        )
    except UsageError as error:
        raise SettingsError(str(error)) from error
    listens_by_default = json.loads(config.get_json("listen/endpoints")) == [DEFAULT_ENDPOINT]
    if _mode(config) == "client" and not settings.listen and listens_by_default:
        config.insert_json5("listen/endpoints", "[]")
    if json.loads(config.get_json("transport/unicast/lowlatency")):
        # such a transport does not fragment: every message above 64 KiB would be lost
        raise SettingsError("transport/unicast/lowlatency loses every message above 64 KiB: leave it off")
    return config


def _built_in(root: str, wire_guard_bytes: int) -> dict[str, object]:
    return {
        "transport/unicast/max_sessions": MAX_SESSIONS,
        "mode": "peer",
        "listen/endpoints": [DEFAULT_ENDPOINT],
        "timestamping/enabled": True,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # shared memory does not heed max_message_size; this filter does its work there too
        "low_pass_filter": [
            {
                "id": "potserver_guard",
                "flows": ["ingress"],
                "messages": ["put", "query"],
                "key_exprs": [f"{root}/**"],
                "size_limit": wire_guard_bytes,
            }
        ],
    }


def open_session(config: zenoh.Config) -> tuple[zenoh.Session, list[str]]:
    """Open the node; a listener on port 0 gets a free port.

    Returns:
        The session, and the endpoints it listens on.
    Raises:
        SettingsError: an endpoint cannot be opened; the message is one line with a hint.
    """
    if (problem := diagnosis.missing_file(config)) is not None:
        raise SettingsError(problem)
    wanted = _endpoints(config)
    tries = _FREE_PORT_TRIES if any(_wants_free_port(endpoint) for endpoint in wanted) else 1
    for attempt in range(1, tries + 1):
        endpoints = [_with_free_port(endpoint) for endpoint in wanted]
        if endpoints != wanted:
            config.insert_json5("listen/endpoints", json.dumps(endpoints))
        try:
            return zenoh.open(config), endpoints
        except zenoh.ZError as error:
            if attempt == tries:  # else somebody took the free port between the look and the use
                raise SettingsError(_explain(error, endpoints)) from error
    raise AssertionError("unreachable")


def max_sessions_of(config: zenoh.Config) -> int:
    """How many others may be connected at once, after the file and `--cfg`."""
    return int(json.loads(config.get_json("transport/unicast/max_sessions")))


def raise_file_limit(n_sessions: int) -> int:
    """Let this process have a file descriptor a session, as far as the system allows; how many sessions fit.

    With none left, Zenoh lets nobody in and logs nothing.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = n_sessions + _OTHER_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    fit = n_sessions if soft == resource.RLIM_INFINITY else min(n_sessions, soft - _OTHER_FILES)
    if fit < n_sessions:
        log.warning("file_limit_low", files=soft, sessions=fit, wanted=n_sessions)
    return fit


def close_session(session: zenoh.Session, timeout_s: float) -> bool:
    """Close the node without ever hanging.

    Returns:
        False if Zenoh did not finish in time; the process must then leave by `os._exit`.
    """

    def close() -> None:
        with contextlib.suppress(zenoh.ZError):
            session.close()

    thread = threading.Thread(target=close, name="zenoh-close", daemon=True)
    thread.start()
    thread.join(timeout_s)
    if thread.is_alive():
        log.error("session_close_timed_out", timeout_s=timeout_s)
    return not thread.is_alive()


def _mode(config: zenoh.Config) -> str:
    return str(json.loads(config.get_json("mode")) or "peer")


def _endpoints(config: zenoh.Config) -> list[str]:
    listed = json.loads(config.get_json("listen/endpoints"))
    if isinstance(listed, dict):  # by mode
        listed = listed.get(_mode(config)) or []
    return [str(endpoint) for endpoint in listed]


def _wants_free_port(endpoint: str) -> bool:
    return endpoint.split("#", 1)[0].endswith(":0")


def _with_free_port(endpoint: str) -> str:
    if not _wants_free_port(endpoint):
        return endpoint
    address, hash_mark, options = endpoint.partition("#")
    protocol, _, location = address.partition("/")
    host = location[: -len(":0")].strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    kind = socket.SOCK_DGRAM if protocol in ("udp", "quic") else socket.SOCK_STREAM
    with socket.socket(family, kind) as probe:
        probe.bind((host, 0))
        port = probe.getsockname()[1]
    return f"{address[:-1]}{port}{hash_mark}{options}"


def _explain(error: zenoh.ZError, endpoints: list[str]) -> str:
    text = str(error)
    if "Address already in use" in text:
        where = next((e for e in endpoints if e in text), ", ".join(endpoints))
        return (
            f"cannot listen on {where}: the port is taken, perhaps by another potserver or a Zenoh router."
            " Hint: choose a port with --listen tcp/127.0.0.1:PORT, port 0 for any free one,"
            " or join the router with --connect and listen elsewhere"
        )
    return f"cannot open Zenoh: {zenoh_config.reason_of(error)}"
