"""`q/atoms` and `ctl/atoms`: the server's dictionary, read and changed."""

from __future__ import annotations

from potclient.atoms import Atom
from potclient.link import Link
from potschemas.keys import CHANGE_ATOMS
from potschemas.messages import ABSENT, AtomInfo, AtomList, AtomsAction, AtomsChanged, AtomsQuery, PlaceInfo
from potschemas.messages import Atom as AtomMessage


def atoms(link: Link, timeout_s: float | None) -> list[AtomInfo]:
    """See `MapClient.atoms`."""
    return link.ask(link.keys.query("atoms"), AtomsQuery(), AtomList, timeout_s).atoms


def places(link: Link, timeout_s: float | None) -> list[PlaceInfo]:
    """See `MapClient.places`."""
    told = link.ask(link.keys.query("atoms"), AtomsQuery(), AtomList, timeout_s).places
    return [] if told is ABSENT else told


def atom(link: Link, atom_id: str, timeout_s: float | None) -> Atom:
    """See `MapClient.atom`."""
    return Atom.from_message(
        link.ask(link.keys.query("atoms"), AtomsQuery(atom_id=atom_id), AtomMessage, timeout_s)
    )


def add_atom(link: Link, new: Atom, timeout_s: float | None) -> AtomsChanged:
    """See `MapClient.add_atom`."""
    query = AtomsQuery(action=AtomsAction.ADD, atom=new.to_message())
    return link.ask(link.keys.control(CHANGE_ATOMS), query, AtomsChanged, timeout_s)


def remove_atom(link: Link, atom_id: str, timeout_s: float | None) -> AtomsChanged:
    """See `MapClient.remove_atom`."""
    query = AtomsQuery(action=AtomsAction.REMOVE, atom_id=atom_id)
    return link.ask(link.keys.control(CHANGE_ATOMS), query, AtomsChanged, timeout_s)
