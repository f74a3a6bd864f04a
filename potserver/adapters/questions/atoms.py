"""`q/atoms`: list the dictionary, or fetch one atom whole. `ctl/atoms`: change the dictionary."""

from __future__ import annotations

from potschemas import messages
from potschemas.messages import AtomsAction
from potserver.adapters.questions.question import Asked, Question, Single, the_part
from potserver.codec.atoms import decode_atom, encode_atom, encode_atom_info
from potserver.errors import BadMessageError, PotserverError, UnsupportedError


def check_reads(query: messages.AtomsQuery) -> None:
    """Refuse what does not only read.

    Raises:
        UnsupportedError: it asks for a change. BadMessageError: it brings an atom.
    """
    if query.action not in (messages.ABSENT, AtomsAction.READ):
        raise UnsupportedError(
            f"q/atoms only reads: to {query.action.value} an atom, ask ctl/atoms, which is for operators"
        )
    if query.atom is not messages.ABSENT:
        raise BadMessageError("pot.atoms_query.v1: to read takes no field `atom`")


def check_changes(query: messages.AtomsQuery) -> None:
    """Refuse what is no change, or not a whole one.

    Raises:
        UnsupportedError: it only reads. BadMessageError: the other fields do not fit the action.
    """
    if query.action in (messages.ABSENT, AtomsAction.READ):
        raise UnsupportedError(
            "ctl/atoms changes the dictionary (`action` add or remove): to read it, ask q/atoms"
        )
    if query.action is AtomsAction.ADD:
        if query.atom is messages.ABSENT or query.atom_id not in (None, query.atom.info.atom_id):
            raise BadMessageError(
                "pot.atoms_query.v1: to add needs the field `atom`, and no other id beside it"
            )
    elif query.atom is not messages.ABSENT:
        raise BadMessageError("pot.atoms_query.v1: to remove takes no field `atom`")
    elif query.atom_id is None:
        raise BadMessageError("pot.atoms_query.v1: to remove needs the field `atom_id`")


def _plan_read(asked: Asked, query: messages.AtomsQuery) -> Single:
    check_reads(query)
    mapper = asked.served.mapper
    dictionary, usage = mapper.dictionary, mapper.atom_usage
    atom_id = query.atom_id
    if atom_id is None:
        return Single(
            lambda: messages.AtomList(
                atoms=[encode_atom_info(atom, usage) for atom in dictionary],
                places=[
                    messages.PlaceInfo(name=one.name, times_used=usage[one.name], provenance=one.provenance)
                    for one in dictionary.grown
                ],
            ),
            is_short=True,
        )
    return Single(lambda: encode_atom(dictionary.get(atom_id), usage, asked.snapshot.rule), is_short=True)


def _plan_change(asked: Asked, query: messages.AtomsQuery) -> Single:
    check_changes(query)
    return Single(lambda: _change(asked, query), is_short=False)


def _change(asked: Asked, query: messages.AtomsQuery) -> messages.AtomsChanged:
    """Add or remove an atom, and count what became of it."""
    served = asked.served
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
    served.audit.changed("control.atoms", asked.asker, result=verb, **change._asdict())
    return messages.AtomsChanged(**change._asdict())


QUESTION = Question(op="atoms", query=messages.AtomsQuery, plan=_plan_read, each=the_part, reads_tiles=False)
# the newcomer is compared with the whole dictionary
CHANGE = Question(
    op="atoms",
    query=messages.AtomsQuery,
    plan=_plan_change,
    each=the_part,
    is_quick=False,
    reads_tiles=False,
)
