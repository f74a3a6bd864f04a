"""What is new to the dictionary joins it without being asked: proposed here, admitted as anything else."""

from __future__ import annotations

import queue
import threading

from potserver.adapters.audit import Audit
from potserver.atoms.store import AtomStore
from potserver.domain.dictionary import AtomDictionary
from potserver.errors import PotserverError
from potserver.health import Health
from potserver.log import get_logger
from potserver.mapping.service import MappingService
from potserver.threads import spawn

log = get_logger("potserver.proposer")

_NAME = 59  # characters of a map's name in that of a place: 63 are legal


class Proposer:
    """Learns from the maps that are due, one after the other, on a thread of its own."""

    def __init__(self, health: Health) -> None:
        self._health = health
        self._due: queue.SimpleQueue[MappingService | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def propose(self, mapper: MappingService) -> None:
        """What a map has seen is new; from any thread, at once."""
        self._due.put(mapper)

    def start(self, atoms: AtomStore) -> None:
        """Begin to work on what is due."""
        self._thread = spawn("proposer", lambda: self._run(atoms))

    def close(self, timeout_s: float) -> bool:
        """Begin nothing more. False if something is still being learned at the deadline."""
        self._due.put(None)
        if self._thread is None:
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self, atoms: AtomStore) -> None:
        while (mapper := self._due.get()) is not None:
            self._health.count("atoms.proposed")
            name = _free_name(mapper.map_id, atoms.dictionary)
            try:
                done = atoms.learn(name, mapper.learned_from, max_range_m=mapper.settings.max_range_m)
            except PotserverError as error:
                reason = error.reason or error.code
                self._health.count(f"atoms.refused.{reason}")
                log.info(
                    "proposal_refused", map_id=mapper.map_id, name=name, reason=reason, detail=str(error)
                )
                continue
            self._health.count("atoms.learned")
            Audit(mapper.map_id).changed("atoms.proposed", "the server", **done._asdict())


def _free_name(map_id: str, dictionary: AtomDictionary) -> str:
    taken = {one.name for one in dictionary.grown}
    number = 1
    while (name := f"{map_id[:_NAME]}-{number}") in taken or name in dictionary:
        number += 1
    return name
