"""Zenoh sessions for clients: the configuration, and the command line flags that Zenoh users expect.

Precedence: flags > `--cfg` > the file of `--config` or ZENOH_CONFIG > what is set here.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path

import zenoh

from potclient.errors import NoServerError, UsageError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream")  # what the wheel is built with
_SHM_MESSAGES = "transport/shared_memory/transport_optimization/messages"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class SessionOptions:
    """What a client session is opened with; None leaves the choice to the file, or else to the defaults of `build_config`."""

    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    mode: str | None = None  # client | peer | router
    config_file: Path | None = None
    overrides: tuple[tuple[str, str], ...] = ()  # (key, JSON5 value), as given to --cfg
    multicast_scouting: bool | None = None
    shared_memory: bool | None = None
    connect_timeout_s: float = 0.0  # how long to wait for somebody to listen; 0 tries once


def build_config(options: SessionOptions) -> zenoh.Config:
    """The Zenoh configuration of a client.

    Unless a file or an override says otherwise: mode `client` (Zenoh no longer relays for peers that do not listen), no
    multicast scouting, `DEFAULT_ENDPOINT`, and shared memory for puts only (clouds gain 4-8x from it; queries may be lost on it
    when the receiver stalls).

    Raises:
        UsageError: the file, a key or a value is not one that Zenoh takes.
    """
    path = options.config_file or (
        Path(os.environ["ZENOH_CONFIG"]) if os.environ.get("ZENOH_CONFIG") else None
    )
    try:
        config: zenoh.Config = zenoh.Config.from_file(path) if path else zenoh.Config()
    except zenoh.ZError as error:
        raise UsageError(f"Zenoh configuration {path}: {_first_line(error)}") from error
    overridden = {key.strip("/") for key, _ in options.overrides}

    def default(key: str, value: object, unset: tuple[str, ...] = ("null",)) -> None:
        if key not in overridden and config.get_json(key) in unset:
            config.insert_json5(key, json.dumps(value))

    default("mode", "client")
    default("scouting/multicast/enabled", False)
    default("connect/endpoints", [DEFAULT_ENDPOINT], unset=("null", "[]"))
    default(_SHM_MESSAGES, ["put"], unset=("null", '["put","query","reply"]'))
    for key, value in options.overrides:
        try:
            _insert(config, key, value)
        except zenoh.ZError as error:
            raise UsageError(f"--cfg {key}:{value}: {_first_line(error)}") from error
    for endpoint in (*options.connect, *options.listen):
        protocol, slash, address = endpoint.partition("/")
        if protocol not in _PROTOCOLS or not slash or not address:
            raise UsageError(
                f"endpoint {endpoint!r}: need PROTOCOL/ADDRESS, with {', '.join(_PROTOCOLS)}; e.g. {DEFAULT_ENDPOINT}"
            )
    flags: list[tuple[str, object]] = []  # they win over everything
    if options.mode is not None:
        flags.append(("mode", options.mode))
    if options.connect:
        flags.append(("connect/endpoints", list(options.connect)))
    if options.listen:
        flags.append(("listen/endpoints", list(options.listen)))
    if options.multicast_scouting is not None:
        flags.append(("scouting/multicast/enabled", options.multicast_scouting))
    if options.shared_memory is not None:
        flags.append(("transport/shared_memory/enabled", options.shared_memory))
    if options.connect_timeout_s > 0:
        flags.append(("connect/timeout_ms", round(options.connect_timeout_s * 1000)))
        flags.append(("connect/exit_on_failure", True))
    for key, flag in flags:
        try:
            config.insert_json5(key, json.dumps(flag))
        except zenoh.ZError as error:
            raise UsageError(f"{key} = {flag}: {_first_line(error)}") from error
    return config


def open_session(options: SessionOptions) -> zenoh.Session:
    """Open a session.

    Raises:
        UsageError: the configuration is not one that Zenoh takes.
        NoServerError: nobody listens at the endpoints (within `connect_timeout_s`).
    """
    config = build_config(options)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        endpoints = json.loads(config.get_json("connect/endpoints") or "[]")
        where = ", ".join(str(e) for e in endpoints) or "any endpoint"
        text = _first_line(error)
        if "nable to connect" in text:
            waited = f" within {options.connect_timeout_s:g} s" if options.connect_timeout_s > 0 else ""
            raise NoServerError(
                f"nobody listens at {where}{waited}; start one with `potserver serve`, or name the right endpoint with -e"
            ) from error
        raise UsageError(f"Zenoh cannot open a session to {where}: {text}") from error


def add_zenoh_arguments(parser: argparse.ArgumentParser) -> None:
    """Zenoh's usual flags, as in its own examples."""
    group = parser.add_argument_group("Zenoh session")
    group.add_argument(
        "-e",
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help=f"endpoint to connect to; may be repeated (default {DEFAULT_ENDPOINT})",
    )
    group.add_argument(
        "-l", "--listen", action="append", metavar="ENDPOINT", help="endpoint to listen on; may be repeated"
    )
    group.add_argument(
        "-m", "--mode", choices=("client", "peer", "router"), help="session mode (default client)"
    )
    group.add_argument(
        "-c",
        "--config",
        type=Path,
        metavar="FILE",
        help="Zenoh configuration, JSON5 (default: $ZENOH_CONFIG)",
    )
    group.add_argument(
        "--cfg",
        action="append",
        default=[],
        metavar="KEY:VALUE",
        help="one configuration value as JSON5, e.g. --cfg 'transport/link/tx/lease:5000'; may be repeated",
    )
    group.add_argument(
        "--multicast-scouting",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="look for servers by multicast (default: off)",
    )
    group.add_argument(
        "--no-shm",
        action="store_true",
        help="no shared memory between processes of this host (small /dev/shm, containers)",
    )
    group.add_argument(
        "--wait",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="wait this long for the server to come up and be ready (default 0)",
    )


def options_from_arguments(arguments: argparse.Namespace) -> SessionOptions:
    """The options that `add_zenoh_arguments` parsed.

    Raises:
        UsageError: a `--cfg` is not KEY:VALUE.
    """
    return SessionOptions(
        connect=tuple(arguments.connect or ()),
        listen=tuple(arguments.listen or ()),
        mode=arguments.mode,
        config_file=arguments.config,
        overrides=parse_overrides(arguments.cfg),
        multicast_scouting=arguments.multicast_scouting,
        shared_memory=False if arguments.no_shm else None,
        connect_timeout_s=arguments.wait,
    )


def parse_overrides(values: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Split `KEY:VALUE` at the first colon.

    Raises:
        UsageError: there is no colon, or no key before it.
    """
    pairs = []
    for value in values:
        key, colon, json5 = value.partition(":")
        if not colon or not key.strip():
            raise UsageError(f"--cfg {value!r}: need KEY:VALUE, e.g. transport/link/tx/lease:5000")
        pairs.append((key.strip(), json5.strip()))
    return tuple(pairs)


def _insert(config: zenoh.Config, key: str, value: str) -> None:
    """Set a JSON5 value; a word that is none is taken as a string, so that `mode:peer` works without quotes."""
    try:
        config.insert_json5(key, value)
    except zenoh.ZError:
        config.insert_json5(key, json.dumps(value))


def _first_line(error: BaseException) -> str:
    """Zenoh's message without its source location."""
    text = str(error).split(" at /")[0].strip()
    found = re.search(r'msg: "((?:[^"\\]|\\.)*)', text)
    return (found.group(1) if found else text).strip().splitlines()[0]
