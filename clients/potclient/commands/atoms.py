"""`potclient atoms`: the dictionary of atoms."""

from __future__ import annotations

import argparse
import math
from typing import Any

from potclient.atoms import Atom
from potclient.commands.output_files import output_file
from potclient.commands.shared import (
    EXIT_OK,
    add_command,
    add_json_argument,
    add_verb,
    client_of,
    plain,
    say,
    table,
    write_json,
)
from potclient.questions.control import CONTROL_TIMEOUT_S
from potschemas import messages


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "atoms",
        run,
        help="the dictionary of atoms: list, get, add, remove, learn",
        description="""List the dictionary's atoms with how often each has served, fetch one whole, or change the dictionary.

A change counts for all maps of the server, from their next scan on. The server refuses atoms that are unsound or that it has
already, and says why. A file holds one atom; `potserver atoms export` takes them out of a dictionary.""",
        epilog="""examples:
  potclient atoms
  potclient atoms get terraces-180-s4 -o terraces-180-s4.atom
  potclient atoms add terraces-180-s4.atom corner.atom
  potclient atoms remove terraces-180-s4
  potclient atoms learn yard""",
    )
    add_json_argument(parser)
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", dest="verb")
    listing = add_verb(
        verbs, "list", run, help="all atoms; the default",
        description="List the dictionary's atoms with how often each has served.",
    )  # fmt: skip
    get = add_verb(
        verbs,
        "get",
        run,
        help="one atom whole",
        description="Fetch one atom whole, and show where it comes from.",
    )
    get.add_argument("atom_id", metavar="ID")
    get.add_argument(
        "-o",
        "--out",
        type=output_file,
        default=None,
        metavar="FILE",
        help="save it (`potclient.Atom.load` reads it)",
    )
    put = add_verb(
        verbs, "add", _change_atoms, help="put atoms into the dictionary",
        description="Put atoms into the dictionary; each file holds one.",
    )  # fmt: skip
    put.add_argument("names", nargs="+", metavar="FILE", help="*.atom")
    remove = add_verb(
        verbs, "remove", _change_atoms, help="take atoms out of the dictionary",
        description="Take atoms out of the dictionary. The kernels that maps have from them stay.",
    )  # fmt: skip
    remove.add_argument("names", nargs="+", metavar="ID")
    learn = add_verb(
        verbs, "learn", _learn, timeout_s=CONTROL_TIMEOUT_S, help="from the scans that a map has taken",
        description="Let the dictionary grow by what a map's scans have taught. It is refused if what is known does as well.",
    )  # fmt: skip
    learn.add_argument(
        "name", metavar="NAME", help="of the place; what was learned under it goes on learning"
    )
    for verb in (listing, get, put, remove):
        add_json_argument(verb)


def run(arguments: argparse.Namespace) -> int:
    with client_of(arguments) as client:
        if arguments.verb == "get":
            atom = client.atom(arguments.atom_id)
            atoms, places = [atom.info], []
            if arguments.out is not None:
                atom.save(arguments.out)
        else:
            atoms, places = client.atoms(), client.places()
    write_json(arguments.json, [plain(atom) for atom in atoms])
    if arguments.json != "-":
        _say_atoms(atoms)
        for place in places:
            noted = ", ".join(f"{key} {value}" for key, value in sorted(place.provenance.items()))
            say(f"learned from {place.name}, used by {place.times_used} scans: {noted}")
        if arguments.verb == "get":
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


def _learn(arguments: argparse.Namespace) -> int:
    with client_of(arguments) as client:
        reply = client.learn(arguments.name, timeout_s=arguments.timeout)
    say(reply.message)
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
