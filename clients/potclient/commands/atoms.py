"""`potclient atoms`: the dictionary of atoms."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from potclient.atoms import Atom
from potclient.commands.shared import (
    EXIT_OK,
    add_command,
    add_json_argument,
    client_of,
    plain,
    say,
    table,
    write_json,
)
from potclient.errors import UsageError
from potschemas import messages


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "atoms",
        run,
        help="the dictionary of atoms: list, get, add, remove",
        description="""List the dictionary's atoms with how often each has served, fetch one whole, or change the dictionary.

A change counts for all maps of the server, from their next scan on. The server refuses atoms that are unsound or that it has
already, and says why. A file holds one atom; `potserver atoms export` takes them out of a dictionary.""",
        epilog="""examples:
  potclient atoms
  potclient atoms get terraces-180-s4 -o terraces-180-s4.atom
  potclient atoms add terraces-180-s4.atom corner.atom
  potclient atoms remove terraces-180-s4""",
    )
    parser.add_argument(
        "verb", nargs="?", choices=("list", "get", "add", "remove"), default="list", help="default: list"
    )
    parser.add_argument(
        "names", nargs="*", metavar="ID|FILE", help="an ID to get; FILEs to add; IDs to remove"
    )
    parser.add_argument(
        "-o", "--out", type=Path, metavar="FILE", help="get: save the atom (`potclient.Atom.load` reads it)"
    )
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    verb, names = arguments.verb, arguments.names
    if verb == "list" and names:
        raise UsageError(f"atoms: list takes no names; `potclient atoms get {names[0]}` shows one")
    if verb == "get" and len(names) != 1:
        raise UsageError("atoms: get needs one ID")
    if verb in ("add", "remove") and not names:
        raise UsageError(f"atoms: {verb} what? name {'FILEs' if verb == 'add' else 'IDs'}")
    if arguments.out is not None and verb != "get":
        raise UsageError("atoms: -o saves the atom that `get ID` fetches")
    if verb in ("add", "remove"):
        return _change_atoms(arguments)
    with client_of(arguments) as client:
        if verb == "list":
            atoms = client.atoms()
        else:
            atom = client.atom(names[0])
            atoms = [atom.info]
            if arguments.out is not None:
                atom.save(arguments.out)
    write_json(arguments.json, [plain(atom) for atom in atoms])
    if arguments.json != "-":
        _say_atoms(atoms)
        if verb == "get":
            say("\n".join(f"{key}: {value}" for key, value in sorted(atoms[0].provenance.items())))
    return EXIT_OK


def _change_atoms(arguments: argparse.Namespace) -> int:
    """Every file is read before the first atom is sent; the first refusal ends the command."""
    adds = arguments.verb == "add"
    done = "added" if adds else "removed"
    atoms = [Atom.load(name) for name in arguments.names] if adds else []
    changes = []
    with client_of(arguments) as client:
        try:
            for change in map(client.add_atom, atoms) if adds else map(client.remove_atom, arguments.names):
                changes.append(change)
                kept = "saved" if change.persisted else "until the server restarts"
                if arguments.json != "-":
                    say(f"{change.atom_id} {done}, {change.n_atoms} atoms, {kept}")
        finally:
            write_json(arguments.json, [plain(change) for change in changes])
    return EXIT_OK


def _say_atoms(atoms: list[messages.AtomInfo]) -> None:
    heads = ["atom", "dims", "hits", "free", "kernels", "radius m", "width deg", "used", "source"]
    rows = [
        [
            a.atom_id,
            str(a.dims),
            str(a.n_hits),
            str(a.n_free),
            str(a.n_kernels),
            f"{a.radius_m:.1f}",
            f"{math.degrees(a.azimuth_width_rad):.0f}",
            str(a.times_used),
            a.provenance.get("source", ""),
        ]
        for a in atoms
    ]
    say(table(heads, rows))
