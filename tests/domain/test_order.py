"""Which clouds of a robot are new: by the number in their session, whatever any clock says."""

from __future__ import annotations

import pytest

from potserver.domain.order import MAX_SEQ, CloudOrder, joined
from potserver.errors import MapFullError, OldSequenceError


def heard(*clouds: tuple[str, str, int], **options: object) -> CloudOrder:
    order = CloudOrder(**options)  # type: ignore[arg-type]
    for cloud in clouds:
        order.check(*cloud)
        order.remember(*cloud)
    return order


def test_numbers_grow_within_a_session() -> None:
    order = heard(("a", "s", 5))
    for seq in (4, 5):
        with pytest.raises(
            OldSequenceError, match="6 or more would be taken, or any number in a new session"
        ) as old:
            order.check("a", "s", seq)
        assert old.value.next_seq == order.next_seq("a", "s") == 6
    order.check("a", "s", 6)
    order.check("b", "s", 0)
    order.check("a", "t", 0)
    order.replace({})
    order.check("a", "s", 0)


def test_sessions_of_a_robot_do_not_shut_each_other_out() -> None:
    order = heard(("a", "s", 5), ("a", "forged", 2**62), ("a", "s", 6))
    with pytest.raises(OldSequenceError):
        order.check("a", "s", 6)
    with pytest.raises(OldSequenceError):
        order.check("a", "forged", 2**62)


def test_a_session_whose_numbers_have_run_out_is_told_no_number_that_no_message_can_hold() -> None:
    order = heard(("a", "s", MAX_SEQ))
    for seq in (0, MAX_SEQ):
        with pytest.raises(OldSequenceError, match=r"session s: any number in a new session") as old:
            order.check("a", "s", seq)
        assert old.value.next_seq is None
    order.check("a", "t", 0)


def test_no_robot_is_forgotten_for_another_and_a_cloud_never_comes_in_twice() -> None:
    order = heard(("a", "", 1), ("b", "", 1), max_robots=2)
    with pytest.raises(MapFullError, match="forget one"):
        order.check("c", "", 1)
    with pytest.raises(OldSequenceError):
        order.check("a", "", 1)
    order.replace(order.without("b"))
    order.check("c", "", 1)


def test_the_oldest_session_of_a_robot_goes_first() -> None:
    order = heard(*[("a", f"s{n}", 9) for n in (0, 1, 2, 3, 4, 5, 6, 7)])
    order.remember("a", "s0", 10)
    order.remember("a", "s8", 9)
    assert list(order.heard["a"]) == ["s2", "s3", "s4", "s5", "s6", "s7", "s0", "s8"]


def test_what_was_handed_out_never_changes() -> None:
    order = heard(("a", "s", 1))
    before = order.heard
    order.remember("a", "s", 2)
    order.remember("b", "s", 2)
    assert before == {"a": {"s": 1}}
    assert CloudOrder(before).heard == before


def test_repeats_may_be_allowed_and_do_not_count_back() -> None:
    order = heard(("a", "", 5), ("a", "", 4), allow_repeats=True)
    assert order.heard == {"a": {"": 5}}
    assert order.next_seq("a", "") == 0


def test_two_maps_have_heard_what_either_has() -> None:
    assert joined({"a": {"s": 5, "t": 1}}, {"a": {"s": 3}, "b": {"u": 2}}) == {
        "a": {"t": 1, "s": 5},
        "b": {"u": 2},
    }
