"""Edges of the ranking. Against brute force: tests/conformance/test_eq5_eq6_eq7_matching.py."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.mapping.matching import Matcher, shared_centres
from potserver.mapping.settings import PAPER, MappingSettings
from tests.conformance import reference

RNG = np.random.default_rng(0)
HITS, FREE = RNG.uniform(2, 9, (60, 3)).astype(np.float32), RNG.uniform(1, 5, (40, 3)).astype(np.float32)
NONE = np.zeros((0, 3), np.float32)
SETTINGS = [MappingSettings(), PAPER]


def _matcher(settings: MappingSettings, *atoms, threads: int = 1) -> Matcher:
    return Matcher(AtomDictionary(atoms), settings, threads=threads, seed=0)


def test_both_sides_are_centred_on_the_same_label() -> None:
    """Row A4: on the hits; on the free points where one side has no hits."""
    full, free = (HITS, FREE), (NONE, FREE)
    for atom, sector, label in ((full, full, 0), (free, full, 1), (full, free, 1), (free, free, 1)):
        shifted = [points + np.float32([3, -2, 1]) for points in sector]
        centres = shared_centres(reference.atom("a", *atom), reference.sector(*shifted))
        for centre, points in zip(centres, (atom[label], shifted[label]), strict=True):
            np.testing.assert_allclose(centre, points.mean(axis=0, dtype=np.float64), atol=1e-5)


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.profile)
def test_nothing_to_compare_is_no_match(settings: MappingSettings) -> None:
    full = reference.sector(HITS, FREE)
    assert _matcher(settings).match([full, full]) == [None, None]
    matcher = _matcher(settings, reference.atom("a", HITS, FREE))
    assert matcher.match([]) == []
    found = matcher.match([reference.sector(NONE, NONE), full])
    assert found[0] is None
    assert found[1] is not None


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.profile)
def test_a_sector_equal_to_an_atom_gets_it_unturned(settings: MappingSettings) -> None:
    atoms = [reference.atom(f"a{i}", HITS * s, FREE * s) for i, s in enumerate((0.5, 1.0, 1.5))]
    match = _matcher(settings, *atoms).match([reference.sector(HITS, FREE)])[0]
    assert match is not None
    assert (match.atom.atom_id, match.rotation_rad) == ("a1", 0.0)


def test_a_failed_solve_cannot_win() -> None:
    settings = dataclasses.replace(PAPER, rank_iterations=1, rank_tolerance=1e-9, rank_reg_m2=0.05)
    assert _matcher(settings, reference.atom("a", HITS, FREE)).match([reference.sector(HITS * 2, FREE)]) == [
        None
    ]


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: s.profile)
def test_the_choice_depends_on_neither_threads_nor_the_company_of_other_sectors(
    settings: MappingSettings,
) -> None:
    atoms = [reference.atom(f"a{i}", HITS * s, FREE * s) for i, s in enumerate((0.6, 1.0, 1.5))]
    sectors = [reference.sector(HITS * s, FREE) for s in (0.7, 1.1, 1.4)]
    together = _matcher(settings, *atoms).match(sectors)
    threaded = _matcher(settings, *atoms, threads=3).match(sectors)
    for one, other in zip(together, threaded, strict=True):
        assert one is not None
        assert other is not None
        assert (one.atom.atom_id, one.rotation_rad, one.w2_m2) == (
            other.atom.atom_id,
            other.rotation_rad,
            other.w2_m2,
        )
