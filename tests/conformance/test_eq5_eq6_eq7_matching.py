"""Equations 5 to 7: every atom in every rotation against a sector; the least Wasserstein cost wins."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from potclient.datasets import open_dataset
from potserver.domain.dictionary import AtomDictionary
from potserver.mapping.matching import Matcher, Ranking, RankScore
from potserver.mapping.paper import PAPER
from potserver.mapping.sampling import BeamLimits, Draws, draw_beams
from potserver.mapping.sectors import cut_sectors
from potserver.mapping.settings import MappingSettings
from potserver.numerics.beams import label_beams
from potserver.numerics.coupling import couple
from potserver.numerics.geometry import rotation_z
from potserver.recordings import to_scan
from tests.conformance import reference

ROTATIONS_DEG = tuple(45.0 * k for k in range(-4, 4))
ROTATIONS = [math.radians(a) for a in ROTATIONS_DEG]
REG = 12.5
BOX = ((-6.0, -6.0, -1.0), (6.0, 6.0, 2.0))


def _ranking(score: RankScore) -> Ranking:
    return Ranking(
        score=score, reg_m2=REG, tolerance=1e-5, rotations_deg=ROTATIONS_DEG, n_hits=200, n_free=200
    )


def _atoms(seed: int, n: int = 4):
    rng = np.random.default_rng(seed)
    made = []
    for i in range(n):
        stretch = rng.uniform(0.3, 1.6, 3)
        hits = reference.spaced(rng, 30, *BOX, 0.8) * stretch
        free = reference.spaced(rng, 20, *BOX, 0.8) * stretch[::-1] + 3.0
        made.append(reference.atom(f"a{i}", _apart(hits), _apart(free)))
    return made


def _apart(points: np.ndarray) -> np.ndarray:
    """Drop what the ranking's voxel filter might drop."""
    kept: list[np.ndarray] = []
    for point in points:
        if all(np.linalg.norm(point - other) > 0.75 for other in kept):
            kept.append(point)
    return np.asarray(kept)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 45.0, 90.0, -135.0, 180.0])
def test_eq5_rotation(angle_deg: float) -> None:
    angle = math.radians(angle_deg)
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(points @ rotation_z(angle).T, reference.rotated(points, angle), atol=1e-12)
    np.testing.assert_allclose(rotation_z(math.pi / 2) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("score", list(RankScore))
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_eq6_eq7_choice_equals_brute_force(score: RankScore, seed: int) -> None:
    atoms = _atoms(seed)
    rng = np.random.default_rng(100 + seed)
    sectors = []
    for _ in range(3):
        source = atoms[int(rng.integers(len(atoms)))]
        angle, offset = rng.uniform(-math.pi, math.pi), rng.normal(0.0, 5.0, 3)
        hits = reference.rotated(source.hit_points, angle) * rng.uniform(0.8, 1.2, 3) + offset
        free = reference.rotated(source.free_points, angle) + rng.normal(0.0, 0.5, 3) + offset
        sectors.append(reference.sector(_apart(hits), _apart(free)))
    found = Matcher(AtomDictionary(tuple(atoms)), _ranking(score), threads=2, seed=0).match(sectors)
    for sector, match in zip(sectors, found, strict=True):
        truth = reference.rank(atoms, ROTATIONS, sector, REG)
        wanted = truth.w2 if score is RankScore.W2 else truth.normalised
        a, r = (int(i) for i in np.unravel_index(int(wanted.argmin()), wanted.shape))
        runner_up = float(np.sort(wanted.ravel())[1])
        assert runner_up > wanted.min() * 1.0005, "the case is a tie; choose another seed"
        assert match is not None
        assert match.atom.atom_id == atoms[a].atom_id
        assert match.rotation_rad == pytest.approx(ROTATIONS[r])
        assert match.w2_m2 == pytest.approx(float(truth.w2[a, r]), rel=2e-4)


def test_the_two_scores_are_not_the_same_rule() -> None:
    """Row A7: wide free space outweighs the hits in eq. 7, and counts as much as they do in the authors' score."""
    rng = np.random.default_rng(4)
    hits = _apart(reference.spaced(rng, 30, *BOX, 1.6) * 0.5)
    free = _apart(reference.spaced(rng, 25, *BOX, 0.8) * 1.2)
    atoms = [
        reference.atom("right-hits", hits, _apart(free * 1.45)),
        reference.atom("right-free", _apart(hits * 1.5), free),
        reference.atom("poor", _apart(hits * 1.575), _apart(free * 2.2)),
    ]
    target = reference.sector(hits, free)
    truth = reference.rank(atoms, ROTATIONS, target, REG)
    chosen = {}
    for score in RankScore:
        match = Matcher(AtomDictionary(tuple(atoms)), _ranking(score), threads=1, seed=0).match([target])[0]
        assert match is not None
        wanted = truth.w2 if score is RankScore.W2 else truth.normalised
        assert match.atom is atoms[int(wanted.min(axis=1).argmin())]
        chosen[score] = match.atom.atom_id
    assert chosen == {RankScore.W2: "right-free", RankScore.NORMALISED: "right-hits"}


@pytest.mark.parametrize("score", list(RankScore))
@pytest.mark.parametrize("missing", ["hits", "free"])
def test_row_a9_a_sector_with_one_label_is_ranked_by_that_label(score: RankScore, missing: str) -> None:
    atoms = _atoms(5)
    source = atoms[2]
    hits = np.zeros((0, 3)) if missing == "hits" else reference.rotated(source.hit_points, math.radians(90))
    free = np.zeros((0, 3)) if missing == "free" else reference.rotated(source.free_points, math.radians(90))
    target = reference.sector(hits, free)
    truth = reference.rank(atoms, ROTATIONS, target, REG)
    a, r = (int(i) for i in np.unravel_index(int(truth.w2.argmin()), truth.w2.shape))
    match = Matcher(AtomDictionary(tuple(atoms)), _ranking(score), threads=1, seed=0).match([target])[0]
    assert match is not None
    assert (match.atom.atom_id, match.rotation_rad) == (atoms[a].atom_id, pytest.approx(ROTATIONS[r]))


def test_row_a10_an_atom_without_hits_never_serves_a_sector_with_hits() -> None:
    """The authors' code leaves the previous candidate's value standing; here such an atom is not comparable."""
    rng = np.random.default_rng(6)
    hits, free = reference.spaced(rng, 20, *BOX, 0.8), reference.spaced(rng, 20, *BOX, 0.8)
    no_hits = reference.atom("no-hits", np.zeros((0, 3)), free)
    poor = reference.atom("poor", _apart(hits * 2.5), _apart(free * 2.5))
    target = reference.sector(hits, free)
    for atoms in ((poor, no_hits), (no_hits, poor)):
        match = Matcher(AtomDictionary(atoms), _ranking(RankScore.W2), threads=1, seed=0).match([target])[0]
        assert match is not None
        assert match.atom.atom_id == "poor"
    assert Matcher(AtomDictionary((no_hits,)), _ranking(RankScore.W2), threads=1, seed=0).match([target]) == [
        None
    ]


def test_row_c20_the_choice_does_not_depend_on_where_the_sector_lies() -> None:
    atoms = _atoms(7)
    rng = np.random.default_rng(8)
    hits, free = reference.spaced(rng, 30, *BOX, 0.8), reference.spaced(rng, 25, *BOX, 0.8)
    matcher = Matcher(AtomDictionary(tuple(atoms)), _ranking(RankScore.W2), threads=1, seed=0)
    # whole voxels of the ranking's filter, so that it keeps the same points
    sectors = [
        reference.sector(hits + shift, free + shift)
        for shift in ([0.0] * 3, [8.0, -16.0, 4.0], [80.0, 8.0, 0.0])
    ]
    here, *elsewhere = matcher.match(sectors)
    assert here is not None
    for there in elsewhere:
        assert there is not None
        assert (there.atom.atom_id, there.rotation_rad) == (here.atom.atom_id, here.rotation_rad)
        assert there.w2_m2 == pytest.approx(here.w2_m2, rel=1e-4)


def test_row_c20_scale_does_matter_whatever_the_paper_says() -> None:
    atoms = _atoms(9, 1)
    matcher = Matcher(AtomDictionary(tuple(atoms)), _ranking(RankScore.W2), threads=1, seed=0)
    same, larger = matcher.match(
        [reference.sector(s * atoms[0].hit_points, s * atoms[0].free_points) for s in (1.0, 1.5)]
    )
    assert same is not None
    assert larger is not None
    assert larger.w2_m2 > 1.2 * same.w2_m2


def _sectors(dataset: str, numbers: list[int]) -> list:
    """The sectors of some scans, as profile `paper` cuts them."""
    recording, settings = open_dataset(dataset, max_range_m=20.0), MappingSettings.of_profile("paper")
    found = []
    for number in numbers:
        scan, draws = to_scan(recording[number], number), Draws.of(0, number)
        beams = draw_beams(scan, BeamLimits.of(settings), draws).learned
        labelled = label_beams(beams, free_per_beam=2, gap_m=settings.free_gap_m, rng=draws.learn)
        found += cut_sectors(labelled, scan.T_map_sensor, settings.max_range_m, PAPER.sectors)
    return found


def _few(thing, rng: np.random.Generator):
    """An atom or a sector with no more points than the ranking looks at, so that it draws none of them."""
    kept = {}
    for name, n in (("hit_points", PAPER.ranking.n_hits), ("free_points", PAPER.ranking.n_free)):
        points = getattr(thing, name)
        kept[name] = points[rng.permutation(len(points))[:n]]
    return dataclasses.replace(thing, **kept)


def test_row_a8_the_blur_of_the_ranking_leaves_the_choice_of_exact_transport_in_2d() -> None:
    """At the authors' reg of 12.5 m^2 some choices are others."""
    rng = np.random.default_rng(0)
    sectors = [_few(sector, rng) for sector in _sectors("town:terraces:2d:11", [0, 10])]
    atoms = [_few(atom, rng) for atom in list(AtomDictionary.builtin().of_dims(2))[:8]]
    rotations = np.deg2rad(PAPER.ranking.rotations_deg)
    found: dict[str, list[tuple[str, float]]] = {"exact": []}
    for sector in sectors:
        scores = reference.rank(atoms, rotations.tolist(), sector, 0.0).normalised
        a, r = np.unravel_index(int(scores.argmin()), scores.shape)
        found["exact"].append((atoms[a].atom_id, rotations[r]))
    for name, ranking in (("ours", PAPER.ranking), ("theirs", PAPER.ranking._replace(reg_m2=12.5))):
        matches = Matcher(AtomDictionary(tuple(atoms)), ranking, threads=2, seed=0).match(sectors)
        found[name] = [(m.atom.atom_id, m.rotation_rad) for m in matches if m is not None]
    assert found["ours"] == found["exact"]
    assert sum(one != other for one, other in zip(found["theirs"], found["exact"], strict=True)) >= 1


def test_row_c20_a_plan_without_entropy_depends_on_neither_shift_nor_scale_but_its_cost_does() -> None:
    """The marginals fix |x|^2 and |y|^2 in the cost, so that only x.y chooses."""
    rng = np.random.default_rng(10)
    x, y = rng.normal(size=(2, 40, 3))
    plan, cost = reference.exact_plan(x, y)
    for scale, shift in ((3.0, [0.0] * 3), (1.0, [5.0, -7.0, 1.0]), (0.3, [2.0, 2.0, 0.0])):
        other, other_cost = reference.exact_plan(x, scale * y + shift)
        np.testing.assert_array_equal(other > 0, plan > 0)
        assert other_cost != pytest.approx(cost, rel=0.05)


def test_row_c20_entropy_ties_the_plan_to_scale_unless_it_grows_with_the_cost() -> None:
    rng = np.random.default_rng(11)
    x, y = rng.normal(size=(2, 60, 3)).astype(np.float32)
    plan = couple(x, y, reg=0.01, tolerance=1e-5).plan
    both = couple(10 * x, 10 * y, reg=0.01, tolerance=1e-5).plan
    np.testing.assert_allclose(both, plan, atol=1e-5)
    fixed = [couple(s * x, s * y, reg=0.1, relative=False, tolerance=1e-5).plan for s in (1, 3)]
    assert np.abs(fixed[0] - fixed[1]).max() > 1e-3
