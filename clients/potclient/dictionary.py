"""What a client may do with the server's dictionary."""

from __future__ import annotations

from potclient.atoms import Atom
from potclient.link import Link
from potclient.questions import atoms, control
from potschemas import messages
from potschemas.keys import LEARN


class DictionaryMethods:
    """The part of a `MapClient` that is about the dictionary, which all maps of a server share."""

    _link: Link

    def atoms(self, *, timeout_s: float | None = None) -> list[messages.AtomInfo]:
        """The server's dictionary, one line an atom."""
        return atoms.atoms(self._link, timeout_s)

    def atom(self, atom_id: str, *, timeout_s: float | None = None) -> Atom:
        """One atom whole.

        Raises:
            UnknownAtomError: there is none of this id.
        """
        return atoms.atom(self._link, atom_id, timeout_s)

    def add_atom(self, atom: Atom, *, timeout_s: float | None = None) -> messages.AtomsChanged:
        """Put an atom into the server's dictionary, for all its maps: scans that are integrated from now on may use it.

        Returns:
            How many atoms there are now, and whether the change outlives the server (`persisted`).
        Raises:
            AtomRefusedError: it may not join; `reason` says which rule it breaks.
            ReadOnlyError: the server takes no changes.
            ShapeError, BadPointsError, EmptyError, TooLargeError: its arrays are unsound.
            QueryTimeoutError, LostReplyError: see there; the atom may or may not have joined, `atoms` tells.
        """
        return atoms.add_atom(self._link, atom, timeout_s)

    def remove_atom(self, atom_id: str, *, timeout_s: float | None = None) -> messages.AtomsChanged:
        """Take an atom out of the server's dictionary; maps keep the kernels that were carried from it.

        Returns, and raises beside UnknownAtomError: as `add_atom`.
        """
        return atoms.remove_atom(self._link, atom_id, timeout_s)

    def places(self, *, timeout_s: float | None = None) -> list[messages.PlaceInfo]:
        """What places have taught the server's dictionary, and how often it is used; see `learn`."""
        return atoms.places(self._link, timeout_s)

    def learn(self, name: str, *, timeout_s: float | None = None) -> messages.ControlReply:
        """Let the server's dictionary grow by what this map's scans have taught: maps lean on it where little was seen.

        Args:
            name: Of the place; what was learned under it before goes on learning. `remove_atom` takes it out.
            timeout_s: As for `control`.
        Raises:
            AtomRefusedError: it may not join; `reason` says why, e.g. `duplicate`: what is known does as well.
            ReadOnlyError: the server takes no changes. UnsupportedError: it cannot learn.
            OverloadedError: it is learning already.
        """
        return control.control(
            self._link, LEARN, name=name, robot=None, T_map_saved=None, timeout_s=timeout_s
        )
