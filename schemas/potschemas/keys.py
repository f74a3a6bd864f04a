"""The key space, in one place.

Ids match `[a-z0-9][a-z0-9_.-]{0,62}`; the root (`pot/v1`) is configurable. The builders do not check, because
a server puts the wildcard `*` where a robot's id stands: what comes from people goes through `check_id`,
`check_map_id` and `check_root`.
"""

from __future__ import annotations

import re
from typing import NamedTuple

DEFAULT_ROOT = "pot/v1"
CONTROL_VERBS = ("save", "load", "clear", "drain", "merge", "forget")
CHANGE_ATOMS = "atoms"  # `ctl/atoms`: not a verb of a map, but of the server's one dictionary
LEARN = "learn"  # `ctl/learn`: likewise, from what a map's scans have taught
RESERVED_MAP_IDS = ("srv",)  # `<root>/srv/...` belongs to the servers
_ID = re.compile(r"[a-z0-9][a-z0-9_.-]{0,62}\Z")
_ROOT_CHUNK = re.compile(r"[^/*$#?@\s][^/*$#?\s]*\Z")


def check_id(value: str, what: str) -> str:
    """Return `value` if it is a legal id.

    Raises:
        ValueError: it is not; `what` says which id.
    """
    if not _ID.match(value):
        raise ValueError(f"{what} {value!r} is not an id: need [a-z0-9][a-z0-9_.-]{{0,62}}")
    return value


def check_map_id(value: str) -> str:
    """Return `value` if a map may be called so.

    Raises:
        ValueError: not a legal id, or one that the key space needs itself.
    """
    if check_id(value, "map") in RESERVED_MAP_IDS:
        raise ValueError(f"a map cannot be called {value!r}: the key space needs that word itself")
    return value


def check_root(value: str) -> str:
    """Return `value` if keys can start with it.

    Raises:
        ValueError: an empty chunk, a wildcard, a space, or a verbatim chunk (`@...`).
    """
    if not all(_ROOT_CHUNK.match(chunk) for chunk in value.split("/")):
        raise ValueError(f"root {value!r}: need chunks between single slashes, without * $ # ? or spaces")
    return value


class MapKeys(NamedTuple):
    """Keys of one map under one root."""

    root: str
    map_id: str

    def cloud(self, robot: str) -> str:
        """PUT, robot to server: one scan."""
        return f"{self.root}/{self.map_id}/in/{robot}/cloud"

    def pose(self, robot: str) -> str:
        """PUT, robot to server: the optional pose stream."""
        return f"{self.root}/{self.map_id}/in/{robot}/pose"

    def integrate(self, robot: str) -> str:
        """QUERY, robot to server: one scan, whose receipt is the answer."""
        return f"{self.root}/{self.map_id}/in/{robot}/integrate"

    def receipt(self, robot: str) -> str:
        """PUT, server to robot: what became of each cloud."""
        return f"{self.root}/{self.map_id}/out/{robot}/receipt"

    def params(self, robot: str) -> str:
        """PUT, server to robot: the transported parameters of each cloud."""
        return f"{self.root}/{self.map_id}/out/{robot}/params"

    @property
    def revision(self) -> str:
        """PUT, server to all: the map changed."""
        return f"{self.root}/{self.map_id}/ev/revision"

    def query(self, op: str) -> str:
        """QUERY: a question, which changes nothing."""
        return f"{self.root}/{self.map_id}/q/{op}"

    def control(self, verb: str) -> str:
        """QUERY: one of `CONTROL_VERBS`, `CHANGE_ATOMS` or `LEARN`."""
        return f"{self.root}/{self.map_id}/ctl/{verb}"

    def robot_token(self, robot: str) -> str:
        """Liveliness: this robot feeds this map."""
        return f"@{self.root}/robot/{robot}/{self.map_id}"

    def server_token(self, server: str) -> str:
        """Liveliness: this server serves this map and is warm."""
        return f"@{self.root}/srv/{server}/{self.map_id}"


def stats_key(root: str, server: str) -> str:
    """QUERY, and PUT once a second: the server's counters."""
    return f"{root}/srv/{server}/stats"


def robot_of(key: str) -> str:
    """The robot of `.../in/<robot>/...`, `.../out/<robot>/...` or of a token `.../robot/<robot>/...`.

    The root may have any depth. The chunk is as it came: it may not be a legal id.

    Raises:
        ValueError: the key is not of that form.
    """
    chunks = key.split("/")
    if len(chunks) < 4 or chunks[-3] not in ("in", "out", "robot"):
        raise ValueError(f"key {key!r} is not of a robot")
    return chunks[-2]


def server_of(token: str) -> tuple[str, str]:
    """The server and the map of a token that `MapKeys.server_token` made.

    Raises:
        ValueError: the key is not of that form.
    """
    chunks = token.split("/")
    if len(chunks) < 4 or chunks[-3] != "srv":
        raise ValueError(f"key {token!r} is not a server's token")
    return chunks[-2], chunks[-1]
