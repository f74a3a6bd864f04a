"""Stamps against our own clock, and against those before them."""

from __future__ import annotations

import collections
import time
from collections.abc import Mapping

from potserver.errors import OldStampError


def check_not_future(stamp_ns: int, max_future_s: float) -> None:
    """Refuse a stamp that the clock will not reach soon.

    Raises:
        OldStampError: it is more than `max_future_s` ahead; the code stands for every stamp out of order.
    """
    ahead_s = (stamp_ns - time.time_ns()) / 1e9
    if ahead_s > max_future_s:
        raise OldStampError(
            f"the stamp is {ahead_s:.3f} s ahead of the server's clock, the limit is {max_future_s} s"
        )


class StampOrder:
    """The newest accepted stamp of each robot of a map; the robot that has been silent longest is forgotten first.

    Args:
        newest: From before, ns.
        allow_old: Take stamps that are not newer than the robot's last.
        max_future_s: How far stamps may be ahead of our clock.
        max_robots: How many robots are remembered.
    """

    def __init__(
        self,
        newest: Mapping[str, int] | None = None,
        *,
        allow_old: bool = False,
        max_future_s: float = 5.0,
        max_robots: int = 1024,
    ) -> None:
        self._newest: collections.OrderedDict[str, int] = collections.OrderedDict(newest or {})
        self._allow_old, self._max_future_s, self._max_robots = allow_old, max_future_s, max_robots

    @property
    def newest(self) -> Mapping[str, int]:
        """Robot to stamp, ns."""
        return self._newest

    def check(self, robot_id: str, stamp_ns: int) -> None:
        """Refuse a stamp out of order.

        Raises:
            OldStampError: it is not newer than the robot's last, or too far in the future.
        """
        # one wild stamp that we remembered would shut its robot out until the clock reaches it
        check_not_future(stamp_ns, self._max_future_s)
        last = self._newest.get(robot_id)
        if last is not None and stamp_ns <= last and not self._allow_old:
            behind_ms = (last - stamp_ns) / 1e6
            raise OldStampError(
                f"the stamp is {behind_ms:.3f} ms before the last accepted cloud of {robot_id}"
            )

    def remember(self, robot_id: str, stamp_ns: int) -> None:
        """A cloud of this stamp is in the map."""
        self._newest[robot_id] = max(stamp_ns, self._newest.get(robot_id, 0))
        self._newest.move_to_end(robot_id)
        if len(self._newest) > self._max_robots:
            self._newest.popitem(last=False)

    def replace(self, newest: Mapping[str, int]) -> None:
        """The map is another one now, with these stamps."""
        self._newest = collections.OrderedDict(newest)
