"""Edges of the ranking. Against brute force: tests/conformance/test_eq5_eq6_eq7_matching.py."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom
from potserver.mapping.matching import Matcher, Ranking, shared_centres
from potserver.mapping.paper import PAPER
from potserver.numerics.coupling import CouplingCosts, Ragged, coupling_costs
from tests.conformance import reference

RNG = np.random.default_rng(0)
HITS, FREE = RNG.uniform(2, 9, (60, 3)).astype(np.float32), RNG.uniform(1, 5, (40, 3)).astype(np.float32)
NONE = np.zeros((0, 3), np.float32)
RANKINGS = [Ranking(), PAPER.ranking]


def _matcher(ranking: Ranking, *atoms, threads: int = 1) -> Matcher:
    return Matcher(AtomDictionary(atoms), ranking, threads=threads, seed=0)


def test_both_sides_are_centred_on_the_same_label() -> None:
    """Row A4: on the hits; on the free points where one side has no hits."""
    full, free = (HITS, FREE), (NONE, FREE)
    for atom, sector, label in ((full, full, 0), (free, full, 1), (full, free, 1), (free, free, 1)):
        shifted = [points + np.float32([3, -2, 1]) for points in sector]
        centres = shared_centres(reference.atom("a", *atom), reference.sector(*shifted))
        for centre, points in zip(centres, (atom[label], shifted[label]), strict=True):
            np.testing.assert_allclose(centre, points.mean(axis=0, dtype=np.float64), atol=1e-5)


@pytest.mark.parametrize("ranking", RANKINGS, ids=["default", "paper"])
def test_nothing_to_compare_is_no_match(ranking: Ranking) -> None:
    full = reference.sector(HITS, FREE)
    assert _matcher(ranking).match([full, full]) == [None, None]
    matcher = _matcher(ranking, reference.atom("a", HITS, FREE))
    assert matcher.match([]) == []
    found = matcher.match([reference.sector(NONE, NONE), full])
    assert found[0] is None
    assert found[1] is not None


@pytest.mark.parametrize("ranking", RANKINGS, ids=["default", "paper"])
def test_a_sector_equal_to_an_atom_gets_it_unturned(ranking: Ranking) -> None:
    atoms = [reference.atom(f"a{i}", HITS * s, FREE * s) for i, s in enumerate((0.5, 1.0, 1.5))]
    match = _matcher(ranking, *atoms).match([reference.sector(HITS, FREE)])[0]
    assert match is not None
    assert (match.atom.atom_id, match.rotation_rad) == ("a1", 0.0)


def test_a_failed_solve_cannot_win() -> None:
    ranking = PAPER.ranking._replace(max_iterations=1, tolerance=1e-9, reg_m2=0.05)
    assert _matcher(ranking, reference.atom("a", HITS, FREE)).match([reference.sector(HITS * 2, FREE)]) == [
        None
    ]


@pytest.mark.parametrize("ranking", RANKINGS, ids=["default", "paper"])
def test_the_choice_depends_on_neither_threads_nor_the_company_of_other_sectors(
    ranking: Ranking,
) -> None:
    atoms = [reference.atom(f"a{i}", HITS * s, FREE * s) for i, s in enumerate((0.6, 1.0, 1.5))]
    sectors = [reference.sector(HITS * s, FREE) for s in (0.7, 1.1, 1.4)]
    together = _matcher(ranking, *atoms).match(sectors)
    threaded = _matcher(ranking, *atoms, threads=3).match(sectors)
    for one, other in zip(together, threaded, strict=True):
        assert one is not None
        assert other is not None
        assert (one.atom.atom_id, one.rotation_rad, one.w2_m2) == (
            other.atom.atom_id,
            other.rotation_rad,
            other.w2_m2,
        )


def _turned(atom: Atom, number: int) -> Atom:
    """An atom that looks a little like another."""
    rng = np.random.default_rng(number)
    shift = rng.normal(0.0, 1.0, 3).astype(np.float32)
    return dataclasses.replace(
        atom,
        atom_id=f"{atom.atom_id}-{number}",
        hit_points=atom.hit_points * np.float32(rng.uniform(0.5, 1.5)) + shift,
        free_points=atom.free_points * np.float32(rng.uniform(0.5, 1.5)) + shift,
    )


@pytest.mark.parametrize("ranking", RANKINGS, ids=["default", "paper"])
def test_what_a_scan_is_compared_with_does_not_grow_with_the_dictionary(
    ranking: Ranking, monkeypatch: pytest.MonkeyPatch
) -> None:
    posed: list[int] = []

    def counted(sources: Ragged, targets: Ragged, pairs: Any, **options: Any) -> CouplingCosts:
        posed.append(len(pairs))
        return coupling_costs(sources, targets, pairs, **options)

    monkeypatch.setattr("potserver.mapping.matching.coupling_costs", counted)
    builtin = [atom for atom in AtomDictionary.builtin() if atom.dims == 3]
    sectors = [reference.sector(HITS * s, FREE * s) for s in (0.7, 1.0, 1.3)] + [reference.sector(NONE, FREE)]
    work = {}
    for n in (0, 100, 300):
        many = [*builtin, *(_turned(builtin[i % len(builtin)], i) for i in range(n))]
        posed.clear()
        assert all(_matcher(ranking, *many).match(sectors))
        work[n] = sum(posed)
    assert work[100] == work[300] <= ranking.n_compared * (2 * 3 + 1)
    assert work[0] <= len(builtin) * len(ranking.rotations_deg) * (2 * 3 + 1)


def test_of_many_atoms_the_nearest_ones_are_compared() -> None:
    builtin = [atom for atom in AtomDictionary.builtin() if atom.dims == 3]
    many = [*builtin, *(_turned(builtin[i % len(builtin)], i) for i in range(150))]
    rng = np.random.default_rng(1)
    picked = rng.choice(len(many), 40, replace=False)
    # parts of atoms, as a scan sees them
    sectors = [
        reference.sector(
            *(p[rng.permutation(len(p))[: len(p) // 2]] for p in (many[i].hit_points, many[i].free_points))
        )
        for i in picked
    ]
    bounded = _matcher(Ranking(), *many).match(sectors)
    whole = _matcher(Ranking(n_compared=10**6), *many).match(sectors)
    same = [
        a is not None and b is not None and a.atom.atom_id == b.atom.atom_id
        for a, b in zip(bounded, whole, strict=True)
    ]
    assert np.mean(same) > 0.9
