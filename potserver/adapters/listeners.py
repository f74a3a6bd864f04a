"""Who listens to the parameters of clouds: what nobody would read is not computed.

Zenoh tells a publisher whether any subscriber matches its key, by the declarations that it routes puts by. A publisher of all
robots' keys is declared from the start, so that those declarations are here before a robot's own publisher is asked.
"""

from __future__ import annotations

import collections
from typing import Any

import zenoh

from potschemas.keys import MapKeys


class Listeners:
    """The subscribers of `out/<robot>/params` of one map; for one thread.

    Args:
        session: Of the server.
        keys: Of the map.
        most_robots: Remembered at once.
    """

    def __init__(self, session: zenoh.Session, keys: MapKeys, most_robots: int) -> None:
        self._session, self._keys, self._most = session, keys, most_robots
        self._all = session.declare_publisher(keys.params("*"))
        self._of_robot: collections.OrderedDict[str, zenoh.Publisher] = collections.OrderedDict()

    def listen_to(self, robot_id: str) -> bool:
        """Whether anybody listens to a robot's parameters now."""
        if not _is_matching(self._all):
            return False
        publisher = self._of_robot.pop(robot_id, None)
        if publisher is None:
            publisher = self._session.declare_publisher(self._keys.params(robot_id))
        self._of_robot[robot_id] = publisher  # to the back
        while len(self._of_robot) > self._most:
            _, oldest = self._of_robot.popitem(last=False)
            oldest.undeclare()
        return _is_matching(publisher)


def _is_matching(publisher: zenoh.Publisher) -> bool:
    status: Any = publisher.matching_status  # an object that is always true; the stub says bool
    return bool(status.matching)
