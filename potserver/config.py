"""The settings tree: defaults < TOML file < `POTSERVER_*` < flags. Read by the composition root, handed down
as plain arguments.

Every table is a frozen dataclass; unknown keys are refused with the nearest known one. A variable names its
key with double underscores between tables: `POTSERVER_LIMITS__MAX_CLOUD_BYTES=1000000`,
`POTSERVER_MAPS=ground,first_floor`.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import typing
from collections.abc import Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec

from potschemas import keys
from potserver.adapters.session import ZenohSettings
from potserver.errors import SettingsError
from potserver.limits import Limits
from potserver.mapping.settings import MappingSettings
from potserver.ros.settings import RosSettings
from potserver.toml import read_toml, toml_value

ENV_PREFIX = "POTSERVER_"
# POTSERVER_SETTINGS names the file; Kubernetes injects POTSERVER_PORT... for a service of our name
_NOT_SETTINGS = re.compile(r"(SETTINGS|SERVICE_(HOST|PORT)(_.*)?|PORT(_\d+_.*)?)\Z")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class IntakeSettings:
    """Clouds on their way to the mapper."""

    max_queued: Annotated[int, "clouds that may wait, each map; one more is refused at once"] = 16
    robots: Annotated[tuple[str, ...], "robots that may send; none named: every legal id"] = ()
    allow_repeats: Annotated[bool, "take clouds whose number is not above the last one of their session"] = (
        False
    )
    max_future_s: Annotated[
        float, "clouds and poses stamped further ahead of the server's clock are refused"
    ] = 5.0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class QuerySettings:
    """Questions to the maps."""

    threads: Annotated[int, "questions in work at once"] = 2
    max_queued: Annotated[int, "questions that may wait, all maps; one more is refused at once"] = 64
    max_rate_hz: Annotated[
        float, "questions a second of one client, on average over one; more are refused `too_many`"
    ] = 500.0


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PoseSettings:
    """The optional pose streams of robots whose clouds bring no pose."""

    max_gap_s: Annotated[float, "longest time between two poses that are interpolated"] = 0.5


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class AtomSettings:
    """Changes of the atom dictionary over `ctl/atoms`."""

    writable: Annotated[
        bool,
        "who may ask `ctl/atoms` or `ctl/learn` changes the dictionary, and the server learns what is new to it",
    ] = False
    save: Annotated[bool, "write each change to the file `dictionary`; else a restart forgets it"] = False


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class StoreSettings:
    """Where the maps survive a restart."""

    directory: Annotated[
        str | None, 'folder for all maps; `""`: in memory only. `potserver serve` has a default'
    ] = None
    fsync: Annotated[bool, "wait for the disk with each cloud; else a power cut may take the last ones"] = (
        True
    )
    read_only: Annotated[bool, "answer from what is kept, write nothing, and take no clouds"] = False


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class WebSettings:
    """What is told over HTTP: a page with the map, `/live`, `/ready` and `/metrics` for Prometheus."""

    listen: Annotated[
        str | None, "HOST:PORT; unset: nothing is told. Whoever reaches it may read the maps"
    ] = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class LogSettings:
    """What goes to stderr."""

    level: Annotated[str, "`debug`, `info`, `warning` or `error`"] = "info"
    format: Annotated[str, "`json`, `console`, or `auto`: console on a terminal"] = "auto"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Everything a server may be told."""

    server_id: Annotated[str, "id of the server in its keys"] = "potserver"
    root: Annotated[str, "first chunks of all keys"] = keys.DEFAULT_ROOT
    maps: Annotated[tuple[str, ...], "ids of the maps that are served"] = ("default",)
    dictionary: Annotated[str | None, "file of an atom dictionary; unset: the built-in atoms"] = None
    threads: Annotated[int | None, "threads for integrating one scan; unset: all processors"] = None
    drain_timeout_s: Annotated[float, "at SIGTERM, time for the clouds that wait"] = 10.0
    zenoh: ZenohSettings = dataclasses.field(default_factory=ZenohSettings)
    limits: Limits = dataclasses.field(default_factory=Limits)
    intake: IntakeSettings = dataclasses.field(default_factory=IntakeSettings)
    queries: QuerySettings = dataclasses.field(default_factory=QuerySettings)
    poses: PoseSettings = dataclasses.field(default_factory=PoseSettings)
    atoms: AtomSettings = dataclasses.field(default_factory=AtomSettings)
    store: StoreSettings = dataclasses.field(default_factory=StoreSettings)
    web: WebSettings = dataclasses.field(default_factory=WebSettings)
    ros: RosSettings = dataclasses.field(default_factory=RosSettings)
    log: LogSettings = dataclasses.field(default_factory=LogSettings)
    # `mapping.profile` sets what the other keys of the table start from
    mapping: MappingSettings = dataclasses.field(default_factory=MappingSettings)

    def __post_init__(self) -> None:
        _check(self)


# Names of earlier versions, refused with the new name or the reason why there is none.
_RENAMED = {
    "mapping.fade_rate": "mapping.gone_odds",
    "mapping.fine_m": "mapping.resolution_m",
    "mapping.gap_m": "mapping.free_gap_m",
    "intake.allow_old_stamps": "intake.allow_repeats",
}
_NOW_FIXED = {
    "": ("seed", "stats_period_s"),
    "zenoh": ("shared_memory_queries",),
    "limits": ("max_query_rays", "max_query_poses", "max_query_spheres", "max_query_tiles"),
    "intake": ("max_queued_bytes", "retry_after_s"),
    "queries": (
        "max_queued_bytes", "retry_after_s", "grid_part_cells", "params_part_kernels", "tiles_part_kernels",
    ),
    "poses": ("max_per_robot", "wait_s"),
    "atoms": ("admission",),
    "store": ("snapshot_scans", "snapshot_bytes", "max_saved"),
    "mapping": (
        "free_per_beam", "match_beams", "n_sectors", "align_sectors", "keep_in_sector",
        "rank_hits", "rank_free", "rank_voxel_m", "rank_reg_m2", "rank_tolerance", "rank_iterations", "rank_score",
        "rotations_deg", "couple_points", "couple_voxel_m", "couple_reg", "couple_tolerance", "couple_iterations",
        "label_aware", "out_of_sample", "refine", "prior_var", "borrowed_var_per_m2", "borrow_weights", "feature_cut",
        "instant_newton_steps", "instant_gradient_steps", "newton_steps", "gradient_steps", "cheap_values",
        "saturation", "memory", "carry_into_map", "observed_activation", "residual_var", "mean_moderation", "calibrate",
    ),
}  # fmt: skip


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
        _merge(tree, read_toml(Path(path), "settings file"), str(path))
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


class Leaf(NamedTuple):
    """One setting, for people."""

    path: str  # dotted key
    value: Any  # plain, as in `as_tree`
    default: Any  # of the profile, for the table `mapping`
    kind: str  # of its values
    text: str  # what it does


def describe(settings: Settings) -> list[Leaf]:
    """Every setting, in the order of the tree."""
    base = Settings(mapping=MappingSettings.of_profile(settings.mapping.profile))
    return list(_leaves(Settings, as_tree(settings), as_tree(base), ""))


def _leaves(kind: Any, tree: Mapping[str, Any], base: Mapping[str, Any], prefix: str) -> Iterator[Leaf]:
    hints = typing.get_type_hints(kind, include_extras=True)
    tables = []
    for field in dataclasses.fields(kind):
        name, hint = field.name, hints[field.name]
        if dataclasses.is_dataclass(hint):
            tables.append((name, hint))
            continue
        plain, text = typing.get_args(hint)
        yield Leaf(f"{prefix}{name}", tree[name], base[name], _kind_text(plain), text)
    for name, hint in tables:
        yield from _leaves(hint, tree[name], base[name], f"{prefix}{name}.")


def _kind_text(kind: Any) -> str:
    if typing.get_origin(kind) is tuple:
        return "list of numbers" if typing.get_args(kind)[0] is float else "list of text"
    if typing.get_origin(kind) is Mapping:
        return "table"
    accepted = [k for k in typing.get_args(kind) or (kind,) if k is not type(None)]
    names = {str: "text", int: "integer", float: "number", bool: "true or false"}
    return " or ".join(names[k] for k in accepted)


# --- reading ------------------------------------------------------------------------------------------------


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
            if name in _RENAMED:
                raise SettingsError(f"{source}: {name} is called {_RENAMED[name]} now")
            if key in _NOW_FIXED.get(".".join(path[:depth]), ()):
                raise SettingsError(f"{source}: {name} is no setting any more, it is fixed: leave it out")
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
        return toml_value(text)
    except ValueError:
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
    if kind is MappingSettings:  # a bad profile is named by its own check
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

    try:
        keys.check_root(s.root)
        keys.check_id(s.server_id, "server_id")
        for map_id in s.maps:
            keys.check_map_id(map_id)
        keys.check_id(s.ros.robot, "ros.robot")
        for robot_id in s.intake.robots:
            keys.check_id(robot_id, "intake.robots")
    except ValueError as error:
        raise SettingsError(str(error)) from error
    need("maps", 0 < len(s.maps) == len(set(s.maps)), "at least one map, each once")
    for table in ("limits", "intake", "queries", "poses"):
        for field in dataclasses.fields(getattr(s, table)):
            value = getattr(getattr(s, table), field.name)
            if isinstance(value, bool | tuple):
                continue
            need(f"{table}.{field.name}", math.isfinite(value) and value > 0, "a positive number")
    need("ros.map", s.ros.map is None or s.ros.map in s.maps, "one of `maps`")
    need("threads", s.threads is None or s.threads > 0, "at least 1")
    need("drain_timeout_s", 0 <= s.drain_timeout_s < math.inf, "a number of seconds")
    need("zenoh.mode", s.zenoh.mode in (None, "peer", "client", "router"), "peer, client or router")
    need(
        "atoms.save",
        not s.atoms.save or s.dictionary is not None,
        "the setting `dictionary` beside it: the built-in atoms belong to the program",
    )
    need("store.read_only", not (s.store.read_only and s.store.directory == ""), "a store to read from")
    need("log.level", s.log.level in ("debug", "info", "warning", "error"), "debug, info, warning or error")
    need("log.format", s.log.format in ("auto", "json", "console"), "auto, json or console")
