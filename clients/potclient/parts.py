"""Replies that come in parts, in any order."""

from __future__ import annotations

from typing import Any

from potclient.errors import IncompleteReplyError


class PartCheck:
    """Which parts of one reply have come; refuses parts that cannot be of one answer of one server.

    Args:
        what: The question, for people.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._came: set[int] = set()
        self._same: dict[str, Any] = {}

    @property
    def n_came(self) -> int:
        """Parts so far."""
        return len(self._came)

    def add(self, part: int, n_parts: int, **same: Any) -> None:
        """Book a part.

        Args:
            part: Its number, from 0.
            n_parts: How many it says there are.
            same: What all parts must agree on.
        Raises:
            IncompleteReplyError: it differs from the first part, came twice, or has no place.
        """
        same["n_parts"] = n_parts
        first = self._same = self._same or same
        for name, value in same.items():
            if value != first[name]:
                raise IncompleteReplyError(
                    f"{self._what}: parts of {name} {first[name]} and {value}; do two servers serve this map?"
                )
        if part in self._came or not 0 <= part < n_parts:
            raise IncompleteReplyError(
                f"{self._what}: part {part} of {n_parts} came twice or has no place; do two servers serve this map?"
            )
        self._came.add(part)

    def finish(self) -> None:
        """Check that all parts came.

        Raises:
            IncompleteReplyError: some are missing.
        """
        n_parts = self._same.get("n_parts", 0)
        if not self._came or self.n_came != n_parts:
            raise IncompleteReplyError(f"{self._what}: {self.n_came} of {n_parts} parts came")
