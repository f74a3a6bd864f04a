"""The choice of atoms: what is covered, what is taken, and that the order of the candidates plays no part."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest

from potserver.atoms.cover import distances_m, greedy_cover
from potserver.domain.types import Atom
from potserver.errors import EmptyError, ShapeError
from potserver.numerics.geometry import rotation_z
from tests.conformance import reference

TOLERANCE_M = 1.0


@functools.cache
def _candidates(n: int = 14) -> tuple[Atom, ...]:
    """Walls of random places and sizes; every other one is a slightly moved copy of the one before."""
    rng = np.random.default_rng(4)
    atoms: list[Atom] = []
    for i in range(n):
        if i % 2:
            hits = atoms[-1].hit_points + rng.normal(0.0, 0.03, atoms[-1].hit_points.shape)
        else:
            size = rng.uniform([2.0, 4.0, 1.0], [6.0, 14.0, 3.0])
            hits = np.array([8.0, 0.0, 0.0]) + rng.uniform(-size / 2, size / 2, (40, 3))
        atoms.append(reference.atom(f"a{i:02d}", hits, hits * 0.5))
    return tuple(atoms)


@functools.cache
def _content(n: int = 14) -> tuple[float, ...]:
    return tuple(np.random.default_rng(5).uniform(100.0, 500.0, n))


def test_every_candidate_has_a_chosen_atom_within_the_tolerance() -> None:
    atoms = _candidates()
    cover = greedy_cover(atoms, _content(), TOLERANCE_M)
    assert 1 < len(cover.chosen) < len(atoms)
    for i, (by, distance) in enumerate(zip(cover.covered_by, cover.distance_m, strict=True)):
        assert by in cover.chosen
        assert (by == i) == (i in cover.chosen)
        assert distance <= TOLERANCE_M
        assert distances_m(atoms[by], [atoms[i]])[0] <= TOLERANCE_M


def test_no_chosen_atom_is_near_an_earlier_one() -> None:
    atoms = _candidates()
    chosen = greedy_cover(atoms, _content(), TOLERANCE_M).chosen
    for position, later in enumerate(chosen):
        for earlier in chosen[:position]:
            assert distances_m(atoms[earlier], [atoms[later]])[0] > TOLERANCE_M


@pytest.mark.parametrize("seed", range(3))
def test_the_order_of_the_candidates_plays_no_part(seed: int) -> None:
    atoms, content = _candidates(), np.array(_content())
    expected = greedy_cover(atoms, content, TOLERANCE_M)
    order = np.random.default_rng(seed).permutation(len(atoms))
    shuffled = greedy_cover([atoms[i] for i in order], content[order], TOLERANCE_M)
    assert [order[i] for i in shuffled.chosen] == expected.chosen
    np.testing.assert_array_equal(order[shuffled.covered_by], expected.covered_by[order])


def test_of_two_that_are_alike_the_one_that_tells_more_is_taken() -> None:
    atoms = _candidates()[:2]
    assert greedy_cover(atoms, [300.0, 200.0], TOLERANCE_M).chosen == [0]
    assert greedy_cover(atoms, [200.0, 300.0], TOLERANCE_M).chosen == [1]
    assert greedy_cover(atoms, [200.1, 200.4], TOLERANCE_M).chosen == [0], "the same in nats: the id decides"


def test_what_tells_little_comes_last_however_far_it_is() -> None:
    atoms = _candidates()
    content = np.full(len(atoms), 1_000.0)
    content[[0, 6]] = [-50.0, 0.0]  # worse than a constant, and no better
    chosen = greedy_cover(atoms, content, 0.0).chosen
    assert sorted(chosen) == list(range(len(atoms))), "what is not covered is kept in the end"
    assert set(chosen[-2:]) == {0, 6}


def test_of_what_tells_as_much_the_farthest_is_taken() -> None:
    atoms = _candidates()
    chosen = greedy_cover(atoms, np.full(len(atoms), 200.0), TOLERANCE_M).chosen
    assert chosen[0] == 0
    to_first = distances_m(atoms[0], atoms)
    assert to_first[chosen[1]] == to_first.max()
    least = np.minimum(to_first, distances_m(atoms[chosen[1]], atoms))
    assert least[chosen[2]] == least.max()


def test_a_larger_tolerance_never_keeps_more() -> None:
    counts = [
        len(greedy_cover(_candidates(), _content(), tolerance).chosen)
        for tolerance in (0.0, 0.5, 1.0, 2.0, 99.0)
    ]
    assert counts == sorted(counts, reverse=True)
    assert (counts[0], counts[-1]) == (len(_candidates()), 1)


def test_a_limit_leaves_the_rest_uncovered() -> None:
    cover = greedy_cover(_candidates(), _content(), 0.0, max_atoms=3)
    whole = greedy_cover(_candidates(), _content(), 0.0)
    assert cover.chosen == whole.chosen[:3]
    assert int((cover.covered_by == -1).sum()) == len(_candidates()) - 3


def test_each_group_has_a_limit_of_its_own() -> None:
    group = [i % 2 for i in range(len(_candidates()))]
    calls: list[tuple[int, int]] = []
    cover = greedy_cover(
        _candidates(),
        _content(),
        0.0,
        group=group,
        max_of_group=[2, None],
        on_chosen=lambda *n: calls.append(n),
    )
    chosen_of = [sum(group[i] == g for i in cover.chosen) for g in (0, 1)]
    assert chosen_of == [2, group.count(1)]
    assert [n for n, _ in calls] == list(range(1, len(cover.chosen) + 1))
    assert calls[-1][1] == 0


def test_an_atom_counts_as_far_in_units_of_its_own_tolerance() -> None:
    coarse, fine = np.full(len(_candidates()), 99.0), np.full(len(_candidates()), 99.0)
    fine[[0, 2, 4]] = 0.1
    assert len(greedy_cover(_candidates(), _content(), coarse).chosen) == 1
    assert {0, 2, 4} <= set(greedy_cover(_candidates(), _content(), fine).chosen)


def test_an_atom_is_at_no_distance_from_itself_and_its_turned_copies() -> None:
    atom = _candidates()[0]
    assert distances_m(atom, [atom])[0] == 0.0
    small, large = _turned(atom, 30.0), _turned(atom, 90.0)
    assert distances_m(atom, [small])[0] < 0.3
    assert distances_m(atom, [large])[0] > 3 * distances_m(atom, [small])[0] + 0.5


def test_the_distance_of_a_stretched_atom_is_the_root_mean_square_displacement() -> None:
    """Stretching is its own optimal map, so the squared distance is mean |(s - 1) x|^2."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-4.0, 4.0, (100, 3)).astype(np.float32)
    points -= points.mean(axis=0)
    one = reference.atom("one", points, points)
    for factor in (1.3, 2.0):
        other = reference.atom("other", points * factor, points)
        expected = (factor - 1.0) * math.sqrt(float(np.square(points).sum(axis=1).mean()))
        assert distances_m(one, [other])[0] == pytest.approx(expected, rel=0.1)


def test_nothing_to_choose_from_and_wrong_lengths() -> None:
    with pytest.raises(EmptyError):
        greedy_cover([], [], 1.0)
    with pytest.raises(ShapeError):
        greedy_cover(_candidates(), [0.1], 1.0)
    with pytest.raises(ShapeError):
        greedy_cover(_candidates(), _content(), 1.0, group=[0])


def _turned(atom: Atom, degrees: float) -> Atom:
    rotation = rotation_z(math.radians(degrees)).T.astype(np.float32)
    return dataclasses.replace(
        atom, hit_points=atom.hit_points @ rotation, free_points=atom.free_points @ rotation
    )
