"""Stamps in order, robot by robot."""

from __future__ import annotations

import time

import pytest

from potserver.adapters.stamps import StampOrder
from potserver.errors import OldStampError


def test_a_stamp_must_be_newer_than_the_last_one_of_its_robot() -> None:
    order = StampOrder({"a": 5})
    for stamp_ns in (4, 5):
        with pytest.raises(OldStampError, match="before the last accepted cloud of a"):
            order.check("a", stamp_ns)
    order.check("a", 6)
    order.check("b", 1)
    order.remember("a", 6)
    assert order.newest == {"a": 6}
    order.replace({})
    order.check("a", 1)


def test_old_stamps_may_be_allowed_and_do_not_set_the_clock_back() -> None:
    order = StampOrder({"a": 5}, allow_old=True)
    order.check("a", 4)
    order.remember("a", 4)
    assert order.newest == {"a": 5}


def test_no_stamp_may_be_far_in_the_future() -> None:
    with pytest.raises(OldStampError, match="ahead"):
        StampOrder(max_future_s=1.0).check("a", time.time_ns() + 10**10)


def test_the_robot_that_was_silent_longest_is_forgotten_first() -> None:
    order = StampOrder(max_robots=2)
    for robot in ("a", "b", "a", "c"):
        order.remember(robot, 1)
    assert set(order.newest) == {"a", "c"}
