"""`potserver config show`: the effective settings, what each means, and which differ from the default."""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

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
    show.add_argument("--json", action="store_true", help="JSON in place of TOML")


def _show(options: argparse.Namespace) -> int:
    from potserver.config import as_tree, describe

    settings = settings_of(options)
    say(json.dumps(as_tree(settings), indent=2) if options.json else to_toml(describe(settings)))
    return EXIT_OK


def to_toml(leaves: Iterable[Leaf]) -> str:
    """The settings as a TOML file that `--settings` takes; what it says about them stands in comments."""
    tables: dict[str, list[str]] = {"": []}
    for leaf in leaves:
        table, _, key = leaf.path.rpartition(".")
        lines = tables.setdefault(table, [])
        lines.append(f"# {leaf.text} ({leaf.type_text})" if leaf.text else f"# {leaf.type_text}")
        line = f"# {key} =" if leaf.value is None else f"{key} = {_value(leaf.value)}"
        if leaf.value != leaf.default:
            default = "none" if leaf.default is None else _value(leaf.default)
            line += f"  # changed; the default is {default}"
        lines.append(line)
    return "\n\n".join("\n".join([f"[{name}]"] * bool(name) + lines) for name, lines in tables.items())


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
