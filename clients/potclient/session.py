"""Zenoh sessions for clients, and the command line flags that Zenoh users expect."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import zenoh

from potclient import diagnosis, zenoh_config
from potclient.errors import AccessError, NoServerError, UsageError
from potclient.zenoh_config import DEFAULT_ENDPOINT
from potschemas.redaction import holds_secret, is_secret, redacted

_NO_SECRETS = (
    "a secret in the command line can be read by every user of this machine. Write it into a Zenoh configuration file that only"
    " you may read (chmod 600), and name that with --config or ZENOH_CONFIG"
)


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

    Unless a file or an override says otherwise: mode `client` (Zenoh no longer relays for peers that do not listen),
    `DEFAULT_ENDPOINT`, and what `zenoh_config.COMMON_DEFAULTS` says.

    Raises:
        UsageError: the file, a key or a value is not one that Zenoh takes.
    """
    waits = options.connect_timeout_s > 0
    flags = {
        "mode": options.mode,
        "connect/endpoints": options.connect,
        "listen/endpoints": options.listen,
        "scouting/multicast/enabled": options.multicast_scouting,
        "transport/shared_memory/enabled": options.shared_memory,
        "connect/timeout_ms": round(options.connect_timeout_s * 1000) if waits else None,
        "connect/exit_on_failure": True if waits else None,
    }
    return zenoh_config.build(
        options.config_file,
        {"mode": "client", "connect/endpoints": [DEFAULT_ENDPOINT]},
        options.overrides,
        flags,
    )


def open_session(options: SessionOptions) -> zenoh.Session:
    """Open a session.

    Raises:
        UsageError: the configuration is not one that Zenoh takes.
        NoServerError: nobody listens at the endpoints (within `connect_timeout_s`).
        AccessError: somebody does, and does not let us in.
    """
    config = build_config(options)
    if (problem := diagnosis.missing_file(config)) is not None:
        raise UsageError(problem)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        endpoints = list(diagnosis.endpoints_of(config))
        where = ", ".join(endpoints) or "any endpoint"
        text = zenoh_config.reason_of(error)
        if "nable to connect" in text:
            causes = [diagnosis.cause_of(config, endpoint) for endpoint in endpoints]
            said = "; ".join(cause.text for cause in causes)
            if any(cause.is_refused for cause in causes):
                raise AccessError(said) from error
            waited = f" within {options.connect_timeout_s:g} s" if options.connect_timeout_s > 0 else ""
            raise NoServerError(
                f"nobody listens at {where}{waited} ({said}); start one with `potserver serve`, or name the right endpoint"
                " with -e"
            ) from error
        raise UsageError(f"Zenoh cannot open a session to {where}: {text}") from error


def add_zenoh_arguments(parser: argparse.ArgumentParser) -> None:
    """Zenoh's usual flags, as in its own examples. A parser with `argument_default` gets no other defaults."""
    if parser.argument_default is None:
        parser.set_defaults(cfg=[], multicast_scouting=None, shm=None, wait=0.0)
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
        metavar="KEY:VALUE",
        help="one configuration value as JSON5, e.g. --cfg 'transport/link/tx/lease:5000'; may be repeated",
    )
    group.add_argument(
        "--multicast-scouting",
        action=argparse.BooleanOptionalAction,
        help="look for servers by multicast (default: off)",
    )
    group.add_argument(
        "--shm",
        action=argparse.BooleanOptionalAction,
        help="clouds through shared memory, if the server has it on too: 4 to 8 times as fast, without a bound (default: off)",
    )
    group.add_argument(
        "--wait",
        type=float,
        metavar="SECONDS",
        help="wait this long for the server to come up and be ready (default 0)",
    )


def options_from_arguments(arguments: argparse.Namespace) -> SessionOptions:
    """The options that `add_zenoh_arguments` parsed.

    Raises:
        UsageError: a `--cfg` is not KEY:VALUE, or a flag holds a secret.
    """
    for endpoint in (*(arguments.connect or ()), *(arguments.listen or ())):
        if holds_secret(endpoint):
            raise UsageError(f"{redacted(endpoint)}: {_NO_SECRETS}")
    return SessionOptions(
        connect=tuple(arguments.connect or ()),
        listen=tuple(arguments.listen or ()),
        mode=arguments.mode,
        config_file=arguments.config,
        overrides=parse_overrides(arguments.cfg),
        multicast_scouting=arguments.multicast_scouting,
        shared_memory=arguments.shm,
        connect_timeout_s=arguments.wait,
    )


def parse_overrides(values: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Split `KEY:VALUE` at the first colon.

    Raises:
        UsageError: there is no colon, or no key before it; or the value is a secret.
    """
    pairs = []
    for value in values:
        key, colon, json5 = value.partition(":")
        if not colon or not key.strip():
            raise UsageError(f"--cfg {value!r}: need KEY:VALUE, e.g. transport/link/tx/lease:5000")
        if holds_secret(value) or is_secret(key.strip()):
            raise UsageError(f"--cfg {key}: {_NO_SECRETS}")
        pairs.append((key.strip(), json5.strip()))
    return tuple(pairs)
