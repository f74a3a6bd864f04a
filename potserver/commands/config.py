"""`potserver config show`: the effective settings, what each means, and which differ from the default."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from potschemas.redaction import redacted
from potserver.commands.shared import EXIT_OK, add_group, add_settings_flags, add_verb, say, settings_of

if TYPE_CHECKING:
    from potserver.config import Leaf

_ABOUT = """\
Print the effective settings, after file, variables and flags, as a TOML file that --settings takes.

Above each setting stands what it is. A setting that is not at its default is marked `# changed`, with the default.
A variable names its key with double underscores: POTSERVER_LIMITS__MAX_CLOUD_BYTES=1000000."""


def add(commands: Any) -> None:
    """Add the verb."""
    verbs = add_group(commands, "config", "see the settings")
    show = add_verb(verbs, "show", _show, help="print the effective settings", description=_ABOUT)
    add_settings_flags(show)
    form = show.add_mutually_exclusive_group()
    form.add_argument("--json", action="store_true", help="JSON in place of TOML")
    form.add_argument(
        "--markdown", action="store_true", help="a page that explains all settings, with their defaults"
    )


def _show(options: argparse.Namespace) -> int:
    from potserver.config import Settings, as_tree, describe

    if options.markdown:
        say(to_markdown(describe(Settings())))
    else:
        settings = settings_of(options)
        if options.json:
            say(json.dumps(redacted(as_tree(settings)), indent=2))
        else:
            say(to_toml(leaf._replace(value=redacted(leaf.value)) for leaf in describe(settings)))
    return EXIT_OK


def to_toml(leaves: Iterable[Leaf]) -> str:
    """The settings as a TOML file that `--settings` takes; what it says about them stands in comments."""
    tables: dict[str, list[str]] = {"": []}
    for leaf in leaves:
        table, _, key = leaf.path.rpartition(".")
        lines = tables.setdefault(table, [])
        lines.append(f"# {leaf.text} ({leaf.kind})" if leaf.text else f"# {leaf.kind}")
        line = f"# {key} =" if leaf.value is None else f"{key} = {_value(leaf.value)}"
        if leaf.value != leaf.default:
            default = "none" if leaf.default is None else _value(leaf.default)
            line += f"  # changed; the default is {default}"
        lines.append(line)
    return "\n\n".join("\n".join([f"[{name}]"] * bool(name) + lines) for name, lines in tables.items())


def to_markdown(leaves: Iterable[Leaf]) -> str:
    """The settings as a page of tables, one for each table of the TOML file."""
    from potserver.mapping.settings import MappingSettings

    tables: dict[str, list[str]] = {}
    for leaf in leaves:
        table, _, key = leaf.path.rpartition(".")
        value = "unset" if leaf.value is None else f"`{_value(leaf.value)}`"
        tables.setdefault(table, []).append(f"| `{key}` ({leaf.kind}) | {value} | {leaf.text} |")
    parts = [_PAGE_HEAD]
    for table, rows in tables.items():
        title = f"`[{table}]`" if table else "Top level"
        parts.append(
            "\n".join([f"## {title}\n", "| key | default | what it is |", "| --- | --- | --- |", *rows])
        )
    paper, ours = MappingSettings.of_profile("paper"), MappingSettings()
    other = [
        f"`{f.name} = {_value(getattr(paper, f.name))}`"
        for f in dataclasses.fields(ours)
        if f.name != "profile" and getattr(paper, f.name) != getattr(ours, f.name)
    ]
    parts.append(f"Profile `paper` starts from {', '.join(other)}.")
    return "\n\n".join(parts)


_PAGE_HEAD = """\
# Settings

Every setting of a server. Defaults < TOML file (`--settings FILE`) < variables (`POTSERVER_LIMITS__MAX_CLOUD_BYTES=1000000`) <
flags (`--set limits.max_cloud_bytes=1000000`). `potserver config show` prints those in force and marks what is not at
its default. An unknown name is an error. This page is what `potserver config show --markdown` prints; `make fix` writes it."""


def _value(value: Any) -> str:
    """As TOML writes it, on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items()) + "}"
    return json.dumps(value) if isinstance(value, str) else repr(value)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key)
