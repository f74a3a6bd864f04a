"""AtomStore: the one dictionary of a server, which may change while maps are built from it."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from potserver.atoms.admission import admit
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom, Scan
from potserver.errors import OverloadedError, ReadOnlyError, UnsupportedError

MAX_ADDED = 100  # atoms: every scan is compared with each, which takes it about 5 ms on one core


class AtomChange(NamedTuple):
    """A change that was made."""

    atom_id: str
    n_atoms: int  # in the dictionary now
    persisted: bool  # it is on the disk, and outlives the server


class PlaceLearned(NamedTuple):
    """What a place taught, and that the dictionary has it."""

    name: str
    n_scans: int  # that it was learned from, those that judged included
    nll: float  # of what the held-out scans tell, nats
    nll_before: float  # of the best of what was known
    persisted: bool  # it is on the disk, and outlives the server


class AtomStore:
    """Changes come one at a time, from any thread: checked, written, then used from each map's next scan on."""

    def __init__(
        self,
        dictionary: AtomDictionary,
        use: Callable[[AtomDictionary], None],
        *,
        writable: bool = True,
        file: Path | None = None,
        max_atoms: int = MAX_ADDED,
        threads: int = 1,
    ) -> None:
        """Hold a dictionary.

        Args:
            dictionary: What the maps use already.
            use: Called with the new dictionary after each change.
            writable: Whether changes are taken at all.
            file: Where each change is written before it counts; None keeps changes in memory.
            max_atoms: That additions may lead to; a dictionary that begins with more only shrinks.
            threads: Threads that one change may use.
        """
        self._dictionary, self._use = dictionary, use
        self._writable, self._file, self._threads = writable, file, threads
        self._max_atoms = max_atoms
        self._lock, self._learning = threading.Lock(), threading.Lock()

    @property
    def dictionary(self) -> AtomDictionary:
        """The dictionary now."""
        return self._dictionary

    def add(self, atom: Atom) -> AtomChange:
        """Let an atom join.

        Raises:
            ReadOnlyError: no changes are taken. AtomRefusedError: it breaks a rule. DictionaryError: the disk refuses.
            In all cases the dictionary is as before.
        """
        self._check_writable()
        with self._lock:
            admit(atom, self._dictionary, max_atoms=self._max_atoms, threads=self._threads)
            return self._change(atom.atom_id, self._dictionary.add(atom))

    def remove(self, atom_id: str) -> AtomChange:
        """Let an atom go; maps keep the kernels that were carried from it.

        Raises:
            ReadOnlyError: no changes are taken. UnknownAtomError: there is none of that id. DictionaryError: the disk refuses.
        """
        self._check_writable()
        with self._lock:
            return self._change(atom_id, self._dictionary.remove(atom_id))

    def learn(self, name: str, scans: Sequence[Scan], *, max_range_m: float) -> PlaceLearned:
        """Let the dictionary grow by what scans of a place teach, see `growth.grow`; takes seconds to a minute of one thread.

        Raises:
            ReadOnlyError, AtomRefusedError, DictionaryError: as `add`. OverloadedError: it is learning already.
            UnsupportedError: torch is not installed.
        """
        self._check_writable()
        if importlib.util.find_spec("torch") is None:
            raise UnsupportedError("this server cannot learn: it was installed without the extra `learn`")
        from potserver.atoms.growth import grow  # torch takes seconds, and most servers never learn

        if not self._learning.acquire(blocking=False):
            raise OverloadedError("the dictionary is learning already", retry_after_s=10.0)
        try:
            growth = grow(self._dictionary, name, scans, max_range_m=max_range_m)
            with self._lock:  # atoms may have come and gone meanwhile; only one learns
                change = self._change(name, self._dictionary.grow(growth.learned))
        finally:
            self._learning.release()
        return PlaceLearned(name, len(scans), growth.nll, growth.nll_before, change.persisted)

    def _change(self, atom_id: str, changed: AtomDictionary) -> AtomChange:
        if self._file is not None:
            changed.save(self._file)
        self._use(changed)
        self._dictionary = changed
        return AtomChange(atom_id, len(changed), persisted=self._file is not None)

    def _check_writable(self) -> None:
        if not self._writable:
            raise ReadOnlyError(
                "this server takes no changes of its dictionary (atoms.writable is false, or store.read_only true); its"
                " operator may start it with --set atoms.writable=true"
            )
