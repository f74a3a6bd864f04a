"""When a map's scans are new to the dictionary: enough of them are worth learning from."""

from __future__ import annotations

from collections.abc import Callable

from potserver.domain.types import MapUpdate
from potserver.mapping.leaning import NO_MODEL, NOVEL

FIRST = 16  # new scans
_KNOWN = 0.7  # share of its certainty that a scan's own beams bear out, from which the scan is not new


class Novelty:
    """Counts scans that nothing known foretells. Each time it calls it waits for twice as many."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call = call
        self._n, self._wanted = 0, FIRST

    def note(self, update: MapUpdate) -> None:
        """A scan was mapped."""
        is_weak = update.foretold is not None and update.foretold < _KNOWN
        self._n += is_weak or update.not_leaning in (NOVEL, NO_MODEL)
        if self._n >= self._wanted:
            self._n, self._wanted = 0, 2 * self._wanted
            self._call()
