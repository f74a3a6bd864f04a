"""Enough scans that nothing known foretells call for learning, and ever more of them."""

from __future__ import annotations

import types
from typing import Any

import pytest

from potserver.mapping import leaning
from potserver.mapping.novelty import FIRST, Novelty


def update(**told: Any) -> Any:
    return types.SimpleNamespace(**{"foretold": None, "not_leaning": None} | told)


NEW = update(not_leaning=leaning.NOVEL)


@pytest.mark.parametrize(
    ("told", "is_new"),
    [
        (NEW, True),
        (update(not_leaning=leaning.NO_MODEL), True),
        (update(foretold=0.5), True),
        (update(foretold=1.0), False),
        (update(not_leaning=leaning.NO_GROUND), False),
        (update(not_leaning=leaning.PLANAR), False),
        (update(), False),
    ],
)
def test_what_is_new(told: Any, is_new: bool) -> None:
    calls: list[int] = []
    novelty = Novelty(lambda: calls.append(1))
    for _ in range(FIRST):
        novelty.note(told)
    assert len(calls) == is_new


def test_each_call_waits_for_twice_as_many() -> None:
    calls: list[int] = []
    novelty = Novelty(lambda: calls.append(1))
    called = []
    for n in range(1, 7 * FIRST + 1):
        novelty.note(NEW)
        if len(calls) > len(called):
            called.append(n)
    assert called == [FIRST, 3 * FIRST, 7 * FIRST]
