"""Who may do what, as Zenoh's access control: one rule a branch of the key space and direction, one subject an identity.

Zenoh checks on our node what comes in and what goes out. A rule holds for messages whose key expressions it includes as a
whole. What no rule allows is dropped without a word to its sender.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

from potschemas import keys
from potserver.codec.base import MAX_SMALL_BYTES
from potserver.errors import SettingsError
from potserver.limits import Limits

SERVER = "server"  # the common name of our own certificate, and our own user
CONFIG = "{name}.json5"  # what each identity opens its session with, and our own
USERS = "users"  # the file of passwords: `user:password` a line, as Zenoh wants it
POSES_HZ = 200.0  # of one session; faster streams are thinned
CLOUDS_HZ = 100.0  # the same; a server maps some tens a second


class Auth(str, Enum):
    """How identities are proved."""

    MTLS = "mtls"  # by the common name of a certificate, encrypted
    PASSWORD = "password"  # by user and password, in clear text: for networks that are trusted


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Roles:
    """The identities of a site.

    Raises (on construction):
        SettingsError: an id is not legal or stands twice, or nobody is named.
    """

    robots: tuple[str, ...] = ()  # each sends as itself and hears its own receipts; all may ask
    planners: tuple[str, ...] = ()  # may ask and follow the map's changes
    operators: tuple[str, ...] = ()  # may do what planners may, and change maps and dictionary
    auth: Auth = Auth.MTLS
    root: str = keys.DEFAULT_ROOT

    def __post_init__(self) -> None:
        try:
            keys.check_root(self.root)
            for name in self.everybody:
                keys.check_id(name, "identity")
        except ValueError as error:
            raise SettingsError(str(error)) from error
        if not self.everybody:
            raise SettingsError("name at least one robot, planner or operator")
        if len({*self.everybody, SERVER}) <= len(self.everybody):
            raise SettingsError(f"every identity stands once, in one role, and none is called {SERVER!r}")

    @property
    def everybody(self) -> tuple[str, ...]:
        """All identities but the server's own."""
        return (*self.robots, *self.planners, *self.operators)

    def to_json(self) -> str:
        """For `from_json`."""
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"

    @staticmethod
    def from_json(text: str) -> Roles:
        """The roles that `to_json` wrote.

        Raises:
            SettingsError: it is something else.
        """
        try:
            tree = json.loads(text)
            names = {kind: tuple(tree[kind]) for kind in ("robots", "planners", "operators")}
            return Roles(**names, auth=Auth(tree["auth"]), root=tree["root"])
        except (ValueError, KeyError, TypeError) as error:
            raise SettingsError(f"not the roles of `potserver acl`: {error}") from error


class Rule(NamedTuple):
    """What may pass in one direction."""

    name: str
    flow: str  # ingress: to us, egress: from us
    messages: tuple[str, ...]
    key_exprs: tuple[str, ...]

    def to_config(self) -> dict[str, Any]:
        """As Zenoh has it."""
        return {
            "id": self.name,
            "permission": "allow",
            "flows": [self.flow],
            "messages": list(self.messages),
            "key_exprs": list(self.key_exprs),
        }


def rules_of(roles: Roles) -> dict[str, list[Rule]]:
    """The rules of every identity."""
    root = roles.root
    reads = [
        *_service("ask", f"{root}/*/q/**", f"{root}/srv/*/stats"),
        *_stream("follow", f"{root}/*/ev/**", f"{root}/srv/*/stats"),
        Rule("look", "ingress", ("liveliness_query", "declare_liveliness_subscriber"), (f"@{root}/srv/**",)),
        Rule("tell", "egress", ("liveliness_token",), (f"@{root}/srv/**",)),
    ]
    changes = _service("change", f"{root}/*/ctl/**")
    found = dict.fromkeys(roles.planners, reads)
    found |= {name: [*reads, *changes] for name in roles.operators}
    intake = Rule("intake", "egress", ("declare_subscriber", "declare_queryable"), (f"{root}/*/in/**",))
    for robot in roles.robots:
        mine = f"{root}/*/in/{robot}/**"
        found[robot] = [
            *reads,
            intake,
            Rule(f"{robot}-send", "ingress", ("put", "query"), (mine,)),
            Rule(f"{robot}-receipt", "egress", ("reply",), (mine,)),
            *_stream(f"{robot}-hear", f"{root}/*/out/{robot}/**"),
            Rule(f"{robot}-alive", "ingress", ("liveliness_token",), (f"@{root}/robot/{robot}/**",)),
        ]
    return found


def server_config(roles: Roles, folder: Path, listen: str, limits: Limits) -> dict[str, Any]:
    """The Zenoh configuration of the server.

    Args:
        roles: Who there is.
        folder: Where certificates or passwords lie.
        listen: `HOST:PORT`.
        limits: Sizes beyond four times these are dropped before they are put together; up to that the sender is told.
    """
    per_identity = rules_of(roles)
    distinct = {rule.name: rule for rules in per_identity.values() for rule in rules}
    subject = "cert_common_names" if roles.auth is Auth.MTLS else "usernames"
    return {
        "mode": "peer",
        "listen": {"endpoints": [f"{_protocol(roles)}/{listen}"]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": _transport(roles, folder, SERVER, listens=True),
        "access_control": {
            "enabled": True,
            "default_permission": "deny",
            "rules": [rule.to_config() for rule in distinct.values()],
            "subjects": [{"id": name, subject: [name]} for name in per_identity],
            "policies": [
                {"subjects": [name], "rules": [rule.name for rule in rules]}
                for name, rules in per_identity.items()
            ],
        },
        "low_pass_filter": [
            _size("clouds", ("put", "query"), (f"{roles.root}/*/in/*/*",), 4 * limits.max_cloud_bytes),
            _size("poses", ("put",), (f"{roles.root}/*/in/*/pose",), 4 * MAX_SMALL_BYTES),
            _size(
                "questions",
                ("query",),
                (f"{roles.root}/*/q/**", f"{roles.root}/*/ctl/**", f"{roles.root}/srv/**"),
                4 * limits.max_query_bytes,
            ),
        ],
        "downsampling": [
            {
                "id": "streams",
                "flows": ["ingress"],
                "messages": ["put"],
                "rules": [
                    {"key_expr": f"{roles.root}/*/in/*/pose", "freq": POSES_HZ},
                    {"key_expr": f"{roles.root}/*/in/*/cloud", "freq": CLOUDS_HZ},
                ],
            }
        ],
    }


class Bounds(NamedTuple):
    """What a server's configuration lets in."""

    sizes: dict[str, int]  # bytes of `clouds`, `poses` and `questions`
    poses_hz: float

    @staticmethod
    def of(config: str) -> Bounds:
        """Of a configuration that `server_config` made, or one where limits are missing: then nothing is bounded.

        Raises:
            SettingsError: it is something else.
        """
        try:
            tree = json.loads(config)
            sizes = {rule["id"]: int(rule["size_limit"]) for rule in tree.get("low_pass_filter", [])}
            rates = [rule for group in tree.get("downsampling", []) for rule in group["rules"]]
            hz = [float(rule["freq"]) for rule in rates if rule["key_expr"].endswith("/pose")]
        except (ValueError, KeyError, TypeError) as error:
            raise SettingsError(f"not a configuration of `potserver acl`: {error}") from error
        return Bounds(sizes, min(hz, default=POSES_HZ))


def client_config(
    roles: Roles, folder: Path, name: str, connect: str, password: str | None
) -> dict[str, Any]:
    """The Zenoh configuration of one identity.

    Args:
        roles: Who there is.
        folder: Where certificates lie.
        name: Whose.
        connect: `HOST:PORT` of the server.
        password: Its own, if passwords prove identities.
    """
    return {
        "mode": "client",
        "connect": {"endpoints": [f"{_protocol(roles)}/{connect}"]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": _transport(roles, folder, name, listens=False, password=password),
    }


def _service(name: str, *key_exprs: str) -> list[Rule]:
    """May be asked, and answers."""
    return [
        Rule(name, "ingress", ("query",), key_exprs),
        Rule(f"{name}-answers", "egress", ("reply", "declare_queryable"), key_exprs),
    ]


def _stream(name: str, *key_exprs: str) -> list[Rule]:
    """May be subscribed to, and is published."""
    return [
        Rule(name, "ingress", ("declare_subscriber",), key_exprs),
        Rule(f"{name}-puts", "egress", ("put",), key_exprs),
    ]


def _size(name: str, messages: Iterable[str], key_exprs: Iterable[str], limit: int) -> dict[str, Any]:
    return {
        "id": name,
        "flows": ["ingress"],
        "messages": list(messages),
        "key_exprs": list(key_exprs),
        "size_limit": limit,
    }


def _protocol(roles: Roles) -> str:
    return "tls" if roles.auth is Auth.MTLS else "tcp"


def _transport(
    roles: Roles, folder: Path, name: str, *, listens: bool, password: str | None = None
) -> dict[str, Any]:
    if roles.auth is Auth.PASSWORD:
        mine = {"dictionary_file": str(folder / USERS)} if listens else {"user": name, "password": password}
        return {"auth": {"usrpwd": mine}}
    side = "listen" if listens else "connect"
    return {
        "link": {
            "tls": {
                "root_ca_certificate": str(folder / "ca.pem"),
                "enable_mtls": True,
                f"{side}_certificate": str(folder / f"{name}.pem"),
                f"{side}_private_key": str(folder / f"{name}.key"),
            }
        }
    }
