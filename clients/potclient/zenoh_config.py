"""The Zenoh configuration of a node, client or server, from four sources.

Later ones win: the defaults that are given, the file of `path` or ZENOH_CONFIG, single keys (`--cfg`), flags.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import zenoh

from potclient.errors import UsageError

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # where a server listens, and a client connects
SHM_ENABLED = "transport/shared_memory/enabled"
SHM_MESSAGES = "transport/shared_memory/transport_optimization/messages"
COMMON_DEFAULTS: dict[str, object] = {
    "scouting/multicast/enabled": False,
    # Clouds travel 4 to 8 times as fast through shared memory, but nobody bounds it: every session that ever used it leaves
    # 18 MB in the server, closed or killed.
    SHM_ENABLED: False,
    # Where it is on: queries and replies can be lost on it when a receiver stalls; puts have receipts.
    SHM_MESSAGES: ["put"],
}
_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream")  # what the wheel is built with


def build(
    path: Path | str | None,
    defaults: Mapping[str, object],
    keys: Iterable[tuple[str, Any]],
    flags: Mapping[str, object],
) -> zenoh.Config:
    """Put a configuration together.

    Args:
        path: A JSON5 file; None = the one that ZENOH_CONFIG names, if it names one.
        defaults: Hold where the file leaves the library's own value.
        keys: In order. A string is JSON5, or else taken as a word, so that `mode:peer` works without quotes.
        flags: Values that win; None and () are none. Endpoints among them are checked.
    Raises:
        UsageError: the file, a key or a value is not one that Zenoh takes.
    """
    untouched: zenoh.Config = zenoh.Config()
    config: zenoh.Config = _from_file(path or os.environ.get("ZENOH_CONFIG"))
    for key, value in (COMMON_DEFAULTS | dict(defaults)).items():
        if config.get_json(key) == untouched.get_json(key):
            insert(config, key, json.dumps(value))
    for key, value in keys:
        insert(config, key, value if isinstance(value, str) else json.dumps(value))
    for key, flag in flags.items():
        if flag in (None, ()):
            continue
        if key.endswith("/endpoints"):
            _check_endpoints(flag)
        insert(config, key, json.dumps(flag))
    return config


def insert(config: zenoh.Config, key: str, value: str) -> None:
    """Set one key to a JSON5 value, or to a word.

    Raises:
        UsageError: Zenoh refuses the key or the value.
    """
    try:
        config.insert_json5(key, value)
    except zenoh.ZError:
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise UsageError(f"Zenoh refuses {key} = {value}: {reason_of(error)}") from error


def reason_of(error: Exception) -> str:
    """Zenoh's message in one line, without its source location."""
    text = str(error).split(" at /")[0].strip()
    found = re.search(r'msg: "((?:[^"\\]|\\.)*)', text)
    return (found.group(1) if found else text).strip().splitlines()[0][:300]


def _from_file(path: Path | str | None) -> zenoh.Config:
    if not path:
        config: zenoh.Config = zenoh.Config()
        return config
    if not Path(path).is_file():
        raise UsageError(f"no Zenoh configuration file {path}")
    try:
        config = zenoh.Config.from_file(path)
    except zenoh.ZError as error:
        raise UsageError(f"{path} is not a Zenoh configuration: {reason_of(error)}") from error
    return config


def _check_endpoints(endpoints: Any) -> None:
    for endpoint in endpoints:
        protocol, slash, address = endpoint.partition("/")
        if protocol not in _PROTOCOLS or not slash or not address:
            raise UsageError(
                f"endpoint {endpoint!r}: need PROTOCOL/ADDRESS, with {', '.join(_PROTOCOLS)}; e.g. {DEFAULT_ENDPOINT}"
            )
