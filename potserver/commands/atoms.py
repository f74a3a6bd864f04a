"""`potserver atoms`: see the atom dictionary, take atoms out of it and put atoms into it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from potclient.commands.output_files import output_file, output_folder, picture_file
from potserver.commands import atoms_build, atoms_learn
from potserver.commands.shared import (
    EXIT_OK,
    add_group,
    add_settings_flags,
    add_verb,
    dictionary_of,
    file_errors,
    results_console,
    say,
    settings_of,
    table,
)
from potserver.errors import PotserverError, SettingsError

if TYPE_CHECKING:
    from potserver.domain.dictionary import AtomDictionary
    from potserver.domain.types import Atom

_INFO = """\
List the atoms of a dictionary: the learned pieces of scans that are carried to each new cloud.

The scores are those of beams that were held out while learning, where the builder noted them. --picture
draws each atom's points, its kernels, and what they predict, with the uncertainty."""

_EXPORT = """\
Take atoms out of a dictionary, one *.atom file each: the form in which `potclient atoms add` sends them to
a server."""

_IMPORT = """\
Put *.atom files into a dictionary file. Each is judged as a server would judge it; if one is refused,
nothing changes."""

_TEXTS = ("source", "scan", "sector", "learner", "licence")
_HEADS = ("atom", "dims", "hits", "free", "kernels", "AUC", "NLL", "ECE", *_TEXTS)
_TEXT_CHARS = 24
_LIST_COLUMNS = 240  # of the list in a pipe: enough that no line is cut


def add(commands: Any) -> None:
    """Add the verb."""
    verbs = add_group(commands, "atoms", "see the atom dictionary")

    info = add_verb(verbs, "info", _info, help="list the atoms", description=_INFO)
    info.add_argument("file", nargs="?", help="a dictionary file; default: the one that the settings name")
    info.add_argument("--json", action="store_true", help="everything, with provenance")
    info.add_argument("--picture", type=picture_file, metavar="FILE", help="draw atoms to this file")
    info.add_argument("--atom", action="append", default=[], metavar="ID", help="draw this one; repeatable")
    info.add_argument(
        "--limit", type=int, default=8, metavar="N", help="draw N at most, spread over the dictionary [8]"
    )
    add_settings_flags(info)

    export = add_verb(verbs, "export", _export, help="write atoms as single files", description=_EXPORT)
    export.add_argument("atom_id", nargs="*", metavar="ID", help="which ones [all]")
    export.add_argument(
        "-o", "--out", type=output_folder, required=True, metavar="FOLDER", help="where the *.atom files go"
    )
    add_settings_flags(export)

    import_ = add_verb(
        verbs, "import", _import, help="put single files into a dictionary", description=_IMPORT
    )
    import_.add_argument("file", nargs="+", metavar="FILE", help="*.atom files")
    import_.add_argument(
        "-o",
        "--out",
        type=output_file,
        required=True,
        metavar="FILE",
        help="the dictionary; made if there is none",
    )
    add_settings_flags(import_)

    atoms_build.add(verbs)
    atoms_learn.add(verbs)


# --- info ---------------------------------------------------------------------------------------------------


def _info(options: argparse.Namespace) -> int:
    path = options.file or settings_of(options).dictionary
    dictionary = dictionary_of(path)
    if options.json:
        say(json.dumps([_record(atom) for atom in dictionary], indent=2))
        return EXIT_OK
    drawn = _draw(dictionary, options, title=str(path or "built-in atoms")) if options.picture else ""
    left = [_HEADS.index(name) for name in ("atom", *_TEXTS)]
    results_console(_LIST_COLUMNS).print(table(_HEADS, map(_cells, dictionary), left=left))
    say(f"{len(dictionary)} atoms, {sum(len(a.kernels) for a in dictionary)} kernels, {path or 'built in'}")
    for learned in dictionary.grown:
        noted = ", ".join(f"{key} {value}" for key, value in sorted(learned.provenance.items()))
        say(f"grown by {learned.name}: {noted}")
    if drawn:
        say(drawn)
    return EXIT_OK


def _record(atom: Atom) -> dict[str, Any]:
    """What a server would say of it, but for how often it has served."""
    from potserver.codec.atoms import encode_atom_info

    record = msgspec.structs.asdict(encode_atom_info(atom, {}))
    del record["times_used"]
    return record


def _cells(atom: Atom) -> list[str]:
    counts = (atom.dims, len(atom.hit_points), len(atom.free_points), len(atom.kernels))
    noted = [atom.provenance.get(f"held_out_{name}", "-") for name in ("auc", "nll", "ece")]
    texts = [atom.provenance.get(name, "-") for name in _TEXTS]
    short = [text if len(text) <= _TEXT_CHARS else f"{text[: _TEXT_CHARS - 1]}…" for text in texts]
    return [atom.atom_id, *map(str, counts), *noted, *short]


def _draw(dictionary: AtomDictionary, options: argparse.Namespace, *, title: str) -> str:
    """Draw the picture; returns what to say of it."""
    from potserver.commands.atom_sheet import choose, draw_sheet

    atoms = choose(dictionary, options.atom, options.limit)
    with file_errors(f"write {options.picture}"):
        draw_sheet(atoms, options.picture, title=f"{title}: {len(atoms)} of {len(dictionary)} atoms")
    hint = "" if options.atom or len(atoms) == len(dictionary) else " (--atom ID or --limit N choose others)"
    return f"{len(atoms)} atoms drawn to {options.picture}{hint}"


# --- single files -------------------------------------------------------------------------------------------


def _export(options: argparse.Namespace) -> int:
    from potschemas import wire
    from potserver.codec.atoms import encode_atom
    from potserver.mapping.service import method_of

    settings = settings_of(options)
    dictionary = dictionary_of(settings.dictionary)
    atoms = [dictionary.get(atom_id) for atom_id in options.atom_id] or list(dictionary)
    rule = method_of(settings.mapping.profile).rule
    folder = options.out
    with file_errors(f"write to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
        for atom in atoms:
            (folder / f"{atom.atom_id}.atom").write_bytes(wire.encode(encode_atom(atom, {}, rule)))
    say(f"{len(atoms)} atoms written to {folder}")
    return EXIT_OK


def _import(options: argparse.Namespace) -> int:
    from potserver.atoms.admission import admit
    from potserver.codec.atoms import read_atom_file
    from potserver.domain.dictionary import AtomDictionary

    out = options.out
    dictionary = AtomDictionary.load(out) if out.exists() else AtomDictionary()
    for name in options.file:
        with file_errors(f"read {name}"):
            content = Path(name).read_bytes()
        try:
            atom = read_atom_file(content)
            admit(atom, dictionary)
        except PotserverError as error:
            raise SettingsError(f"{name}: {error}") from error
        dictionary = dictionary.add(atom)
    dictionary.save(out)
    say(f"{len(options.file)} atoms added, {len(dictionary)} in {out}")
    return EXIT_OK
