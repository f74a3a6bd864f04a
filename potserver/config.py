"""The settings tree: defaults < TOML file < `POTSERVER_*` < flags. Read by the composition root, handed down
as plain arguments.

Every table is a frozen dataclass; unknown keys are refused with the nearest known one. A variable names its
key with double underscores between tables: `POTSERVER_LIMITS__MAX_CLOUD_BYTES=1000000`,
`POTSERVER_MAPS=ground,first_floor`.
"""

from __future__ import annotations

import dataclasses
import difflib
import importlib
import json
import math
import re
import sys
import typing
from collections.abc import Mapping
from enum import Enum
from pathlib import Path
from typing import Any

import msgspec

from potschemas import keys
from potschemas.messages import MAX_PART_KERNELS
from potserver.adapters.session import ZenohSettings
from potserver.errors import SettingsError
from potserver.limits import Limits
from potserver.mapping.settings import MappingSettings

tomllib: Any = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")

ENV_PREFIX = "POTSERVER_"
# POTSERVER_SETTINGS names the file; Kubernetes injects POTSERVER_PORT... for a service of our name
_NOT_SETTINGS = re.compile(r"(SETTINGS|SERVICE_(HOST|PORT)(_.*)?|PORT(_\d+_.*)?)\Z")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class IntakeSettings:
    """Clouds on their way to the mapper."""

    max_queued: int = 16  # clouds waiting, each map
    max_queued_bytes: int = 64 * 2**20
    retry_after_s: float = 0.5  # advice to senders that were refused for load
    robots: tuple[str, ...] = ()  # allow list; empty allows every legal id
    allow_old_stamps: bool = False  # take clouds that are not newer than the robot's last accepted one
    max_future_s: float = 5.0  # clouds and poses stamped further ahead of our clock are refused


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class QuerySettings:
    """Questions to the maps."""

    threads: int = 2  # queries in work at once
    max_queued: int = 64
    max_queued_bytes: int = 32 * 2**20
    retry_after_s: float = 0.2
    grid_part_cells: int = 65_536
    params_part_kernels: int = 20_000
    tiles_part_kernels: int = 20_000


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PoseSettings:
    """The optional pose streams of robots whose clouds bring no pose."""

    max_per_robot: int = 1024
    max_gap_s: float = 0.5  # between two poses that are interpolated
    wait_s: float = 0.2  # for the stream to reach a cloud's stamp; the mapper waits that long


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class AtomSettings:
    """Changes of the atom dictionary over `q/atoms`."""

    writable: bool = True  # whoever reaches the server may change it, as they may send clouds and clear maps
    save: bool = False  # write each change to the file `dictionary` before it is acknowledged; else a restart forgets it


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class StoreSettings:
    """Where the maps survive a restart."""

    directory: str | None = (
        None  # a folder for all maps; none or "": in memory only. `potserver serve` has a default
    )
    fsync: bool = True  # wait for the disk with each cloud; else a power cut, though no crash of ours, takes the last ones
    max_saved: int = 100  # copies with a name (`potclient map save NAME`); one more is refused


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class LogSettings:
    """What goes to stderr."""

    level: str = "info"  # debug, info, warning or error
    format: str = "auto"  # json, console, or auto: console on a terminal


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Everything a server may be told."""

    server_id: str = "potserver"
    root: str = keys.DEFAULT_ROOT
    maps: tuple[str, ...] = ("default",)
    dictionary: str | None = None  # an atom dictionary file; default: the built-in atoms
    threads: int | None = None  # for integrating one scan; default: all processors
    seed: int = 0
    stats_period_s: float = 1.0
    drain_timeout_s: float = 10.0  # at SIGTERM, for the clouds that wait
    zenoh: ZenohSettings = dataclasses.field(default_factory=ZenohSettings)
    limits: Limits = dataclasses.field(default_factory=Limits)
    intake: IntakeSettings = dataclasses.field(default_factory=IntakeSettings)
    queries: QuerySettings = dataclasses.field(default_factory=QuerySettings)
    poses: PoseSettings = dataclasses.field(default_factory=PoseSettings)
    atoms: AtomSettings = dataclasses.field(default_factory=AtomSettings)
    store: StoreSettings = dataclasses.field(default_factory=StoreSettings)
    log: LogSettings = dataclasses.field(default_factory=LogSettings)
    # `mapping.profile` sets what the other keys of the table start from
    mapping: MappingSettings = dataclasses.field(default_factory=MappingSettings)

    def __post_init__(self) -> None:
        _check(self)


def load_settings(
    *,
    file: str | Path | None = None,
    environ: Mapping[str, str] | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Settings:
    """Put the settings together.

    Args:
        file: A TOML file; default `$POTSERVER_SETTINGS`, else none.
        environ: `os.environ`, or nothing.
        overrides: From flags: dotted key to value; a string value is parsed as TOML where its key is not a
            string.
    Raises:
        SettingsError: no such file, not TOML, an unknown key, or an illegal value; the message says where it
            came from.
    """
    environ = environ or {}
    path = file or environ.get(f"{ENV_PREFIX}SETTINGS")
    tree: dict[str, Any] = {}
    if path:
        _merge(tree, _read_toml(Path(path)), str(path))
    for name, text in sorted(environ.items()):
        if name.startswith(ENV_PREFIX) and not _NOT_SETTINGS.match(name.removeprefix(ENV_PREFIX)):
            _set(tree, name.removeprefix(ENV_PREFIX).lower().split("__"), text, name)
    for key, value in (overrides or {}).items():
        _set(tree, key.split("."), value, f"flag {key}")
    try:
        return typing.cast(Settings, _build(Settings, tree, ""))
    except TypeError as error:
        raise SettingsError(str(error)) from error


def as_tree(settings: Any) -> dict[str, Any]:
    """The effective settings as plain nested dicts, lists and scalars."""
    tree: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            tree[field.name] = as_tree(value)
        elif isinstance(value, Enum):
            tree[field.name] = value.value
        elif isinstance(value, tuple):
            tree[field.name] = list(value)
        else:
            tree[field.name] = dict(value) if isinstance(value, Mapping) else value
    return tree


def to_toml(settings: Settings) -> str:
    """The effective settings as a TOML file that `--settings` takes; keys without a value are comments."""
    lines: list[str] = []

    def write(tree: Mapping[str, Any], prefix: str) -> None:
        for key, value in tree.items():
            if value is None:
                lines.append(f"# {key} =")
            elif not isinstance(value, Mapping):
                lines.append(f"{_toml_key(key)} = {_toml_value(value)}")
        for key, value in tree.items():
            if isinstance(value, Mapping):
                lines.extend(["", f"[{prefix}{_toml_key(key)}]"])
                write(value, f"{prefix}{_toml_key(key)}.")

    write(as_tree(settings), "")
    return "\n".join(lines) + "\n"


# --- reading ------------------------------------------------------------------------------------------------


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        tree: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f"cannot read settings file {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path} is not TOML: {error}") from error
    return tree


def _merge(into: dict[str, Any], tree: Mapping[str, Any], source: str, prefix: str = "") -> None:
    """Check the keys of a table against the settings, and lay it over another."""
    for key, value in tree.items():
        path = f"{prefix}{key}"
        kind = _kind_of(path.split("."), source)
        if dataclasses.is_dataclass(kind):
            if not isinstance(value, Mapping):
                raise SettingsError(f"{source}: {path} is a table")
            _merge(into.setdefault(key, {}), value, source, f"{path}.")
        else:
            into[key] = value


def _set(tree: dict[str, Any], path: list[str], value: Any, source: str) -> None:
    kind = _kind_of(path, source)
    if dataclasses.is_dataclass(kind):
        raise SettingsError(f"{source}: {'.'.join(path)} is a table; name one of its keys")
    for key in path[:-1]:
        tree = tree.setdefault(key, {})
    tree[path[-1]] = _parse(value, kind) if isinstance(value, str) else value


def _kind_of(path: list[str], source: str) -> Any:
    """The type of a dotted key.

    Raises:
        SettingsError: there is no such key; the nearest one is suggested.
    """
    kind: Any = Settings
    for depth, key in enumerate(path):
        known = _types(kind) if dataclasses.is_dataclass(kind) else {}
        if key not in known:
            name = ".".join(path[: depth + 1])
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"; did you mean {'.'.join([*path[:depth], near[0]])}?" if near else ""
            raise SettingsError(f"{source}: no setting {name!r}{hint}")
        kind = known[key]
    return kind


def _types(kind: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def _parse(text: str, kind: Any) -> Any:
    """A string from a variable or flag, as its key's type wants it."""
    if typing.get_origin(kind) is tuple:
        if not text.lstrip().startswith("["):
            item = typing.get_args(kind)[0]
            return [_parse(part.strip(), item) for part in text.split(",") if part.strip()]
    elif typing.get_origin(kind) is not Mapping:
        accepted = typing.get_args(kind) or (kind,)
        if str in accepted or (isinstance(kind, type) and issubclass(kind, Enum)):
            return text
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text  # the type check will say what is wrong


# --- checking -----------------------------------------------------------------------------------------------


def _build(kind: Any, tree: Mapping[str, Any], prefix: str) -> Any:
    """One table of the tree; its keys are known already."""
    types = _types(kind)
    values: dict[str, Any] = {}
    for key, value in tree.items():
        path = f"{prefix}{key}"
        if dataclasses.is_dataclass(types[key]):
            values[key] = _build(types[key], value, f"{path}.")
        else:
            values[key] = _convert(value, types[key], path)
    if kind is MappingSettings:
        base = MappingSettings.of_profile(values.get("profile", "default"))
        return dataclasses.replace(base, **values)
    return kind(**values)


def _convert(value: Any, kind: Any, path: str) -> Any:
    if typing.get_origin(kind) is Mapping:
        kind = dict[str, Any]
    try:
        return msgspec.convert(value, kind, strict=True)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{path} = {value!r}: {str(error)[0].lower()}{str(error)[1:]}") from error


def _check(s: Settings) -> None:
    def need(path: str, ok: bool, what: str) -> None:
        if not ok:
            value: Any = s
            for key in path.split("."):
                value = getattr(value, key)
            raise SettingsError(f"{path} is {value!r}, need {what}")

    for what, ids in (("server_id", (s.server_id,)), ("maps", s.maps), ("intake.robots", s.intake.robots)):
        for value in ids:
            try:
                keys.check_id(value, what)
            except ValueError as error:
                raise SettingsError(str(error)) from error
    need(
        "root",
        bool(re.fullmatch(r"[a-z0-9_.-]+(/[a-z0-9_.-]+)*", s.root)),
        "chunks of a-z 0-9 _ . - between slashes",
    )
    need("maps", 0 < len(s.maps) == len(set(s.maps)), "at least one map, each once")
    need("maps", "srv" not in s.maps, "another name: srv/<server>/stats is the server's own key")
    for table in ("limits", "intake", "queries", "poses"):
        for field in dataclasses.fields(getattr(s, table)):
            value = getattr(getattr(s, table), field.name)
            if isinstance(value, bool | tuple):
                continue
            least = 0 if field.name in ("wait_s", "retry_after_s") else 1e-9
            need(f"{table}.{field.name}", math.isfinite(value) and value >= least, "a positive number")
    need("store.max_saved", s.store.max_saved >= 0, "at least 0")
    need("seed", s.seed >= 0, "at least 0")
    need("threads", s.threads is None or s.threads > 0, "at least 1")
    need("stats_period_s", 0.01 <= s.stats_period_s < math.inf, "at least 0.01 s")
    need("drain_timeout_s", 0 <= s.drain_timeout_s < math.inf, "a number of seconds")
    need("zenoh.mode", s.zenoh.mode in (None, "peer", "client", "router"), "peer, client or router")
    need(
        "atoms.save",
        not s.atoms.save or s.dictionary is not None,
        "the setting `dictionary` beside it: the built-in atoms belong to the program",
    )
    need("log.level", s.log.level in ("debug", "info", "warning", "error"), "debug, info, warning or error")
    need("log.format", s.log.format in ("auto", "json", "console"), "auto, json or console")
    need(
        "intake.max_queued_bytes",
        s.intake.max_queued_bytes >= s.limits.max_cloud_bytes,
        "at least limits.max_cloud_bytes",
    )
    need(
        "queries.max_queued_bytes",
        s.queries.max_queued_bytes >= s.limits.max_query_bytes,
        "at least limits.max_query_bytes",
    )
    need(
        "queries.tiles_part_kernels",
        s.queries.tiles_part_kernels <= MAX_PART_KERNELS,
        f"at most {MAX_PART_KERNELS}, which is all that askers take",
    )


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return "[" + ", ".join(_toml_value(v) for v in value) + "]"
    return json.dumps(value) if isinstance(value, str) else repr(value)


class Leaf(typing.NamedTuple):
    """One setting, for people."""

    path: str  # dotted
    value: Any  # plain: str, number, bool, list, dict or None
    default: Any
    type_text: str
    text: str  # one line; empty where there is none


def describe(settings: Settings) -> list[Leaf]:
    """All settings, table by table, in the order of the records."""

    def leaves(record: Any, tree: Mapping[str, Any], default: Mapping[str, Any], prefix: str) -> list[Leaf]:
        found: list[Leaf] = []
        for key, kind in _types(record).items():
            path = f"{prefix}{key}"
            if dataclasses.is_dataclass(kind):
                found += leaves(kind, tree[key], default[key], f"{path}.")
            else:
                name = kind.__name__ if isinstance(kind, type) else str(kind)
                found.append(Leaf(path, tree[key], default[key], name.replace("typing.", ""), ""))
        return found

    return leaves(Settings, as_tree(settings), as_tree(Settings()), "")
