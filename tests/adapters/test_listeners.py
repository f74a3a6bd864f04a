"""Who listens to parameters."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

from potschemas.keys import MapKeys
from potserver.adapters.listeners import Listeners

KEYS = MapKeys("pot/v1", "m")


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        yield session


def test_each_robot_has_listeners_of_its_own_however_many_are_remembered(session: zenoh.Session) -> None:
    listeners = Listeners(session, KEYS, most_robots=2)
    assert not listeners.listen_to("r1")
    subscriber = session.declare_subscriber(KEYS.params("r1"), lambda _: None)
    for _ in range(2):
        assert [listeners.listen_to(robot) for robot in ("r1", "r2", "r3", "r4")] == [
            True,
            False,
            False,
            False,
        ]
    with session.declare_subscriber(KEYS.params("*"), lambda _: None):
        assert listeners.listen_to("r4")
    subscriber.undeclare()
    assert not listeners.listen_to("r1")
