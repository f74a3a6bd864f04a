"""Labelled points from beams (row C8, DESIGN section 2)."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.beams import Beams, LabelledPoints, beam_weights, label_beams, limit_range


def _beams(n: int = 200, seed: int = 0, share_return: float = 0.7, longest: float = 20.0) -> Beams:
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return Beams(direction * rng.uniform(0.1, longest, (n, 1)), rng.random(n) < share_return)


@pytest.mark.parametrize("gap_m", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("free_per_beam", [1, 2, 5])
def test_free_points_are_stratified_and_keep_the_gap(free_per_beam: int, gap_m: float) -> None:
    beams = _beams()
    labelled = label_beams(beams, free_per_beam=free_per_beam, gap_m=gap_m, rng=np.random.default_rng(1))
    length = np.linalg.norm(beams.ends, axis=1)
    free = ~labelled.occupied
    along = np.linalg.norm(labelled.points[free], axis=1)
    beam = labelled.beam[free]
    np.testing.assert_allclose(
        labelled.points[free], beams.ends[beam] / length[beam, None] * along[:, None], atol=1e-9
    )
    usable = np.where(beams.is_return, length - gap_m, length)
    assert (along <= usable[beam] + 1e-9).all()
    for b in np.unique(beam):
        piece = np.floor(np.sort(along[beam == b]) / usable[b] * free_per_beam).astype(int)
        np.testing.assert_array_equal(piece, np.arange(free_per_beam))
    np.testing.assert_array_equal(np.unique(beam), np.flatnonzero(usable > 0))


def test_hits_are_the_ends_of_returned_beams() -> None:
    beams = _beams()
    labelled = label_beams(beams, free_per_beam=2, gap_m=0.3, rng=np.random.default_rng(1))
    n_hits = int(beams.is_return.sum())
    assert labelled.occupied[:n_hits].all()
    assert not labelled.occupied[n_hits:].any()
    np.testing.assert_array_equal(labelled.points[:n_hits], beams.ends[beams.is_return])
    np.testing.assert_array_equal(labelled.beam[:n_hits], np.flatnonzero(beams.is_return))


def test_beams_without_return_give_free_points_only() -> None:
    labelled = label_beams(_beams(share_return=0.0), free_per_beam=3, gap_m=0.3, rng=np.random.default_rng(1))
    assert len(labelled.points) == 600
    assert not labelled.occupied.any()


def test_a_hit_nearer_than_the_gap_gives_no_free_point() -> None:
    beams = Beams(np.array([[0.2, 0, 0], [5.0, 0, 0]]), np.array([True, True]))
    labelled = label_beams(beams, free_per_beam=2, gap_m=0.3, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(labelled.beam, [0, 1, 1, 1])


def test_no_beams_no_points() -> None:
    empty = label_beams(
        Beams(np.zeros((0, 3)), np.zeros(0, bool)), free_per_beam=2, gap_m=0.3, rng=np.random.default_rng(1)
    )
    assert empty.points.shape == (0, 3)
    assert empty.beam.shape == empty.occupied.shape == (0,)


def test_the_free_points_depend_on_the_seed_alone() -> None:
    first, again, other = (
        label_beams(_beams(), free_per_beam=2, gap_m=0.3, rng=np.random.default_rng(s)).points
        for s in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_range_limits() -> None:
    ends = np.array(
        [[0.2, 0, 0], [0.3, 0, 0], [0, 5, 0], [0, 0, 25.0], [30.0, 40.0, 0], [0, 60.0, 0], [0.0, 0, 0]]
    )
    returned = np.array([True, True, False, True, True, False, True])
    limited = limit_range(Beams(ends, returned), 0.3, 25.0)
    np.testing.assert_allclose(limited.ends, [[0.3, 0, 0], [0, 5, 0], [0, 0, 25], [15, 20, 0], [0, 25, 0]])
    np.testing.assert_array_equal(limited.is_return, [True, False, True, False, False])


def test_a_beam_of_no_length_is_left_out_even_without_a_minimum() -> None:
    limited = limit_range(Beams(np.zeros((2, 3)), np.ones(2, bool)), 0.0, 10.0)
    assert limited.ends.shape == (0, 3)


def test_a_beams_free_points_weigh_as_much_as_its_hit() -> None:
    labelled = label_beams(_beams(), free_per_beam=3, gap_m=0.3, rng=np.random.default_rng(1))
    weight = beam_weights(labelled)
    np.testing.assert_array_equal(weight[labelled.occupied], 1.0)
    free = ~labelled.occupied
    per_beam = np.bincount(labelled.beam[free], weight[free])
    np.testing.assert_allclose(per_beam[np.unique(labelled.beam[free])], 1.0)
    none = LabelledPoints(np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0, np.int64))
    assert len(beam_weights(none)) == 0
