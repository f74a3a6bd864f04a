"""What a layer has to compute again."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from potclient.questions.tiles import MIRROR_MARGIN_M
from potschemas import messages
from potserver.ros.changes import Box, Change, Changes, changed_boxes


def tick(revision: int, *tiles: tuple[int, int, int]) -> messages.Revision:
    return messages.Revision(
        map="default",
        map_revision=revision,
        stamp_ns=0,
        n_kernels=1,
        tile_size_m=10.0,
        changed_tiles=list(tiles),
    )


def test_at_first_anything_may_have_changed_and_then_nothing_has() -> None:
    changes = Changes()
    assert changes.take() == Change(None, 1.0)
    assert changes.take() is None


def test_the_tiles_of_ticks_add_up() -> None:
    changes = Changes()
    changes.add(tick(4))
    changes.take()
    changes.add(tick(5, (0, 0, 0)))
    changes.add(tick(6, (0, 0, 0), (1, 0, 0)))
    assert changes.take() == Change(frozenset({(0, 0, 0), (1, 0, 0)}), 10.0)


def test_after_a_tick_that_was_missed_anything_may_have_changed() -> None:
    changes = Changes()
    changes.add(tick(4))
    changes.take()
    changes.add(tick(6, (0, 0, 0)))
    assert changes.take() == Change(None, 10.0)
    changes.give_back()
    assert changes.take() == Change(None, 10.0)


def test_tiles_that_touch_make_one_box_with_the_reach_of_kernels_around() -> None:
    boxes = changed_boxes(frozenset({(0, 0, 0), (1, 1, 0), (5, 0, 0)}), 10.0)
    inner = sorted((box.lower.tolist(), box.upper.tolist()) for box, _ in boxes)
    assert inner == [([0, 0, 0], [20, 20, 10]), ([50, 0, 0], [60, 10, 10])]
    for box, around in boxes:
        assert np.array_equal(box.lower - around.lower, np.full(3, MIRROR_MARGIN_M))
        assert np.array_equal(around.upper - box.upper, np.full(3, MIRROR_MARGIN_M))


@given(st.frozensets(st.tuples(st.integers(-4, 4), st.integers(-4, 4)), max_size=12))
def test_every_tile_is_in_one_box(tiles: frozenset) -> None:
    boxes = [box for box, _ in changed_boxes(tiles, 10.0)]
    for tile in tiles:
        middle = (np.array(tile) + 0.5) * 10.0
        assert sum(bool((box.lower < middle).all() and (middle < box.upper).all()) for box in boxes) >= 1


def test_boxes_are_joined_and_cut() -> None:
    a, b = Box(np.zeros(2), np.ones(2)), Box(np.full(2, 2.0), np.full(2, 3.0))
    assert a.joined(b).upper.tolist() == [3, 3]
    assert a.cut(b).is_empty
    assert not a.cut(a).is_empty
