"""Which clouds of a robot are new: a robot's program counts them, and each of its runs counts for itself.

Clocks say nothing here. They go back, jump ahead and are set by others; a number that its sender draws and counts up does not.
"""

from __future__ import annotations

from collections.abc import Mapping

from potserver.errors import MapFullError, OldSequenceError

Heard = Mapping[str, Mapping[str, int]]  # robot to session to its last number; of sessions the newest is last

MAX_ROBOTS = 2**15  # that a map can tell apart
MAX_SEQ = 2**63 - 1  # of a message
_SESSIONS = 8  # remembered of a robot: its programs that run side by side, and some that ran before


class CloudOrder:
    """The last number of every session of every robot of a map.

    Args:
        heard: From before.
        allow_repeats: Take clouds whose number is not above the last one of their session.
        max_robots: How many robots are remembered. None is ever forgotten for another, whose clouds could then come in twice.
    """

    def __init__(
        self, heard: Heard | None = None, *, allow_repeats: bool = False, max_robots: int = MAX_ROBOTS
    ) -> None:
        self._heard = {robot: dict(sessions) for robot, sessions in (heard or {}).items()}
        self._allow_repeats, self._max_robots = allow_repeats, max_robots

    @property
    def heard(self) -> Heard:
        """What is remembered; a copy that never changes."""
        return dict(self._heard)  # `remember` exchanges the sessions of a robot, and never changes them

    def next_seq(self, robot: str, session: str) -> int:
        """The least number that would be taken."""
        return 0 if self._allow_repeats else self._heard.get(robot, {}).get(session, -1) + 1

    def check(self, robot: str, session: str, seq: int) -> None:
        """Refuse a cloud that has been taken, or was overtaken by one that has.

        Raises:
            OldSequenceError: its number is not above the last one of its session; the error says what would be taken.
            MapFullError: a robot more than can be remembered.
        """
        if robot not in self._heard and len(self._heard) >= self._max_robots:
            raise MapFullError(
                f"the map remembers {len(self._heard)} robots and has no room for {robot}: forget one of them"
            )
        wanted = self.next_seq(robot, session)
        if seq < wanted:
            is_full = wanted > MAX_SEQ
            raise OldSequenceError(
                f"cloud {seq} of {robot} is not above {wanted - 1}, the last one taken of its session"
                f" {session or '(none named)'}: "
                + ("" if is_full else f"{wanted} or more would be taken, or ")
                + "any number in a new session",
                next_seq=None if is_full else wanted,
            )

    def remember(self, robot: str, session: str, seq: int) -> None:
        """A cloud is in the map."""
        sessions = self._heard.get(robot, {})
        last = max(seq, sessions.get(session, -1))
        kept = {name: number for name, number in sessions.items() if name != session} | {session: last}
        for name in list(kept)[:-_SESSIONS]:
            del kept[name]
        self._heard[robot] = kept

    def without(self, robot: str) -> Heard:
        """What is remembered of the others."""
        return {name: sessions for name, sessions in self._heard.items() if name != robot}

    def replace(self, heard: Heard) -> None:
        """The map is another one now, with these numbers."""
        self._heard = {robot: dict(sessions) for robot, sessions in heard.items()}


def joined(ours: Heard, theirs: Heard) -> Heard:
    """What both have heard: for a map that is made of two."""
    order = CloudOrder(ours)
    for robot, sessions in theirs.items():
        for session, seq in sessions.items():
            order.remember(robot, session, seq)
    return order.heard
