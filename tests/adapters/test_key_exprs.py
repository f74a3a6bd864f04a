"""Who may send."""

from __future__ import annotations

import pytest

from potserver.adapters.key_exprs import check_robot_id
from potserver.errors import UnknownRobotError


def test_robots_need_a_legal_id_and_a_place_on_the_list() -> None:
    check_robot_id("r1", frozenset())
    check_robot_id("r1", frozenset({"r1"}))
    for robot in ("R1", "", "*", "a/b", "x" * 64, "é"):
        with pytest.raises(UnknownRobotError):
            check_robot_id(robot, frozenset())
    with pytest.raises(UnknownRobotError, match="allow list"):
        check_robot_id("r2", frozenset({"r1"}))
