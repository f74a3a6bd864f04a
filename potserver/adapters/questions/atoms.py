"""`q/atoms`: list the dictionary, fetch one atom whole, or change the dictionary."""

from __future__ import annotations

from collections.abc import Iterator

from potschemas import messages
from potschemas.messages import AtomsAction
from potserver.adapters.questions.question import Asked, Question, Served
from potserver.codec.atoms import decode_atom, encode_atom, encode_atom_info
from potserver.errors import BadMessageError, PotserverError
from potserver.log import get_logger

log = get_logger("potserver.queries")


def action_of(query: messages.AtomsQuery) -> AtomsAction:
    """What is asked for.

    Raises:
        BadMessageError: the other fields do not fit the action.
    """
    action = AtomsAction.READ if query.action is messages.ABSENT else query.action
    if action is AtomsAction.ADD:
        if query.atom is messages.ABSENT or query.atom_id not in (None, query.atom.info.atom_id):
            raise BadMessageError(
                "pot.atoms_query.v1: to add needs the field `atom`, and no other id beside it"
            )
    elif query.atom is not messages.ABSENT:
        raise BadMessageError(f"pot.atoms_query.v1: to {action.value} takes no field `atom`")
    elif action is AtomsAction.REMOVE and query.atom_id is None:
        raise BadMessageError("pot.atoms_query.v1: to remove needs the field `atom_id`")
    return action


def _answer(asked: Asked, query: messages.AtomsQuery) -> Iterator[messages.Message]:
    if action_of(query) is not AtomsAction.READ:
        yield _changed(asked.served, query)
        return
    mapper = asked.served.mapper
    dictionary, usage = mapper.dictionary, mapper.atom_usage
    if query.atom_id is None:
        yield messages.AtomList(atoms=[encode_atom_info(atom, usage) for atom in dictionary])
    else:
        yield encode_atom(dictionary.get(query.atom_id), usage, asked.snapshot.rule)


def _changed(served: Served, query: messages.AtomsQuery) -> messages.AtomsChanged:
    """Add or remove an atom, and count what became of it."""
    if query.atom is not messages.ABSENT:
        atom = decode_atom(query.atom, max_points=served.limits.max_query_points)
        verb, change_dictionary = "added", lambda: served.atoms.add(atom)
    else:
        verb, change_dictionary = "removed", lambda: served.atoms.remove(str(query.atom_id))
    try:
        change = change_dictionary()
    except PotserverError as error:
        served.health.count(f"atoms.refused.{error.reason or error.code}")
        raise
    served.health.count(f"atoms.{verb}")
    log.info(f"atom_{verb}", **change._asdict())
    return messages.AtomsChanged(**change._asdict())


# a change of the dictionary is rare, and short beside a grid
QUESTION = Question(op="atoms", query=messages.AtomsQuery, answer=_answer, is_short=True)
