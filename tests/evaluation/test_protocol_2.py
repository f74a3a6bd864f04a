"""The questions of protocol 2, on maps whose faults are known: each measure catches the fault that it is for."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from potclient.datasets import RecordedScan, open_dataset
from potclient.errors import DatasetError
from potclient.holdout import HoldOut
from potclient.towns import Lidar, Surfaces, SurveyedRecording
from potserver import cli
from potserver.errors import SettingsError
from potserver.evaluation.beams import Beams, labels_of
from potserver.evaluation.mappers import Answer, Mapper, Size
from potserver.evaluation.neighbours import cosines_of_incidence, nearest, within
from potserver.evaluation.protocol import evaluate
from potserver.evaluation.questions import Scores
from potserver.evaluation.rings import LeftOutRings, ring_numbers

pytest.importorskip("open3d")

WALL_M, THICK_M = 4.0, 0.5
INTO = np.array([1e-5, 0.0, -1e-5])  # from faces into what is behind them: more than single precision loses
NEARER = np.array([0.2, 0.0, -1e-5])
LIDAR = Lidar(
    name="narrow",
    elevations_rad=tuple(np.radians(np.linspace(-12.0, 12.0, 13))),
    n_azimuth=90,
    fov_rad=0.6,
    max_range_m=8.0,
    noise_m=0.0,
    dropout=0.0,
)


class Slab(SurveyedRecording):
    """A sensor that goes along y, 1.5 m above the ground, and looks at a wall of 0.5 m at x = 4 m without an end."""

    def __init__(self) -> None:
        super().__init__(Path("slab"), LIDAR, range(3), seed=0, slice_m=None, ceiling_m=None)

    def pose(self, time_s: float) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, 3] = [0.0, 5.0 * time_s, 1.5]
        return pose

    def occupied(self, points: np.ndarray, time_s: float = 0.0) -> np.ndarray:
        return ((points[:, 0] >= WALL_M) & (points[:, 0] <= WALL_M + THICK_M)) | (points[:, 2] < 0)

    def solid_surfaces(self, eye: np.ndarray, directions: np.ndarray, time_s: float) -> Surfaces:
        with np.errstate(divide="ignore"):
            range_m = (WALL_M - eye[0]) / directions[:, 0]
        range_m[range_m < 0] = np.inf
        return Surfaces(range_m, np.tile([1.0, 0.0, 0.0], (len(range_m), 1)))


class Says(Mapper):
    """A map that answers by a function of the points."""

    def __init__(self, name: str, answer: Callable[[np.ndarray], Answer]) -> None:
        self.name, self._answer = name, answer

    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        return {}

    def occupancy(self, points: np.ndarray) -> Answer:
        return self._answer(points)

    def size(self) -> Size:
        return Size(1, 1)


def sure(occupied: np.ndarray, observed: np.ndarray | None = None) -> Answer:
    return Answer(occupied.astype(float), np.ones(len(occupied), bool) if observed is None else observed)


def scores_of(recording: SurveyedRecording, *maps: Mapper) -> list[Scores]:
    found = evaluate(str(recording.path), recording, range(len(recording)), list(maps), hold_out=HoldOut())
    return [row.scores for row in found.rows]


def truth(place: SurveyedRecording, name: str = "truth") -> Says:
    """Knows it all; the measured ends, which lie on faces, count as inside."""
    return Says(name, lambda points: sure(place.occupied(points) | place.occupied(points + INTO)))


@pytest.fixture(scope="module")
def slab() -> list[Scores]:
    place = Slab()
    return scores_of(
        place,
        truth(place),
        Says("20 cm into free space", lambda points: sure(place.occupied(points + NEARER))),
        Says("unseen is unknown", lambda p: sure(place.occupied(p + INTO), p[:, 0] < WALL_M + 0.05)),
        Says("an honest half", lambda p: Answer(np.full(len(p), 0.5), np.ones(len(p), bool), np.full(len(p), 0.25))),
        Says("no idea, and sure", lambda p: Answer(np.ones(len(p)), np.ones(len(p), bool), np.full(len(p), 1e-6))),
    )  # fmt: skip


PERFECT = pytest.approx(1e-6, rel=1e-3)


def test_the_truth_scores_perfectly(slab: list[Scores]) -> None:
    scores = slab[0]
    assert scores.beams.metrics.nll == PERFECT
    near = scores.beams.near
    assert near is not None
    assert near.nll == PERFECT
    assert near.ends.nll == PERFECT
    assert [found.nll for found in near.bins] == [PERFECT] * 4
    assert near.n_beams > 300
    assert scores.headline == PERFECT
    assert scores.truth is not None
    for volume in (scores.truth.uniform, scores.truth.ball):
        assert volume.metrics.accuracy > 0.9999  # but for points less than 10 um before faces
        assert volume.wrong < 1e-4
        assert volume.called_occupied_true > 0.999
        assert volume.called_free_true == 1.0
    assert scores.faces is not None
    assert scores.faces.upright.median_cm == pytest.approx(0.0, abs=1.1)  # a step of the search is 2 cm
    assert scores.faces.upright.early == scores.faces.upright.missed == 0.0


def test_a_wall_that_stands_20_cm_too_near_is_caught_where_protocol_1_sees_nothing(
    slab: list[Scores],
) -> None:
    scores = slab[1]
    assert scores.protocol_1.held_out.nll == PERFECT
    near = scores.beams.near
    assert near is not None
    assert near.nll > 2.0
    assert scores.headline > 1.0
    assert scores.beams.metrics.nll > 0.1
    assert [round(found.mean) for found in near.bins] == [1, 1, 0, 0]
    assert scores.faces is not None
    upright = scores.faces.upright
    assert 20.0 <= upright.median_cm <= 21.0
    assert upright.p95_cm < 22.0
    assert scores.truth is not None
    assert scores.truth.ball.wrong > 0.1
    assert scores.truth.uniform.called_occupied_true < 0.8


def test_a_map_that_claims_what_nobody_saw_is_caught(slab: list[Scores]) -> None:
    claims, honest = slab[0].truth, slab[2].truth
    assert claims is not None
    assert honest is not None
    assert claims.uniform.unseen > 0.3
    assert claims.uniform.unseen_observed == claims.uniform.unseen_sure == 1.0
    behind = honest.uniform.unseen_observed  # what is before the wall, out of the sensor's narrow view
    assert behind < 0.75
    guess = slab[4].truth
    assert guess is not None
    assert guess.uniform.wrong > 0.5
    assert guess.uniform.called_occupied == 1.0
    assert guess.uniform.called_occupied_true == pytest.approx(1.0 - guess.uniform.wrong)
    assert np.isnan(guess.uniform.called_free_true)


def test_unseen_is_what_is_out_of_sight_and_away_from_hits(slab: list[Scores]) -> None:
    class InSight(Says):
        """Knows a wedge before the wall, and nothing else."""

        def __init__(self) -> None:
            super().__init__("in sight", lambda p: sure(Slab().occupied(p), wedge(p)))

    def wedge(p: np.ndarray) -> np.ndarray:
        inside = (np.abs(p[:, 1]) < 0.25 * p[:, 0]) & (np.abs(p[:, 2] - 1.5) < 0.15 * p[:, 0])
        return inside & (p[:, 0] < WALL_M)

    found = scores_of(Slab(), InSight())[0].truth
    assert found is not None
    assert found.uniform.unseen_observed == found.uniform.unseen_sure == 0.0
    assert found.uniform.unseen == slab[0].truth.uniform.unseen  # type: ignore[union-attr]


def test_errors_stand_beside_variances(slab: list[Scores]) -> None:
    half, guess = slab[3].truth, slab[4].truth
    assert half is not None
    assert guess is not None
    assert [found.share for found in half.sd] == [0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    assert half.sd[-1].brier == half.sd[-1].claimed_brier == pytest.approx(0.25)
    assert half.sd[-1].rms_sd == pytest.approx(0.5)
    assert np.isnan(half.sd[0].brier)
    assert guess.sd[0].share == 1.0
    assert guess.sd[0].claimed_brier == 0.0
    assert guess.sd[0].brier > 0.3
    assert slab[0].truth is not None
    assert slab[0].truth.sd == []  # it has no variances


def test_a_map_without_a_wall_misses_all_faces_and_one_full_of_it_is_early(slab: list[Scores]) -> None:
    empty = Says("empty", lambda p: sure(np.zeros(len(p), bool)))
    faces = scores_of(Slab(), empty)[0].faces
    assert faces is not None
    assert faces.upright.missed == 1.0
    assert np.isnan(faces.upright.median_cm)
    assert slab[4].faces is not None
    assert slab[4].faces.upright.early == 1.0


def test_free_points_of_beams_go_up_to_five_centimetres_before_the_end() -> None:
    n = 5000
    beams = Beams(np.zeros((n, 3)), np.tile([2.0, 0.0, 0.0], (n, 1)), np.arange(n) % 2 == 0, np.full(n, 1.0))
    labels = labels_of(beams)
    free = labels.points[~labels.occupied][:, 0]
    assert labels.occupied.sum() == n / 2
    assert len(free) == n
    assert 0.0 <= free.min() < 0.01
    assert 1.94 < free.max() <= 1.95


# --- neighbours ----------------------------------------------------------------------------------------------------------


def test_neighbours_are_those_of_a_search_through_all() -> None:
    rng = np.random.default_rng(0)
    points, asked = rng.normal(0, 0.6, (800, 3)) - 7.0, rng.normal(0, 0.9, (200, 3)) - 7.0
    found = nearest(points, asked, 5, reach_m=0.5, cube_m=0.13)
    distance = np.linalg.norm(points[None] - asked[:, None], axis=2)
    order = np.argsort(distance, axis=1)[:, :5]
    expected = np.take_along_axis(distance, order, axis=1)
    near = expected <= 0.5
    assert 0 < near.sum() < near.size
    np.testing.assert_array_equal(found.rows, np.where(near, order, -1))
    np.testing.assert_allclose(found.distance_m, np.where(near, expected, np.inf))
    np.testing.assert_array_equal(within(points, asked, 0.5), near[:, 0])
    assert not within(np.zeros((0, 3)), asked, 0.5).any()


@pytest.mark.parametrize("planar", [False, True])
def test_incidence_is_the_angle_to_the_plane_through_the_hits_around(planar: bool) -> None:
    rng = np.random.default_rng(1)
    wall = np.column_stack([np.full(2000, 4.0), rng.uniform(-4, 4, 2000), rng.uniform(-1, 1, 2000)])
    cloud = rng.uniform(-0.5, 0.5, (2000, 3)) - [4.0, 0.0, 0.0]
    hits = np.concatenate([wall, cloud])
    if planar:
        hits[:, 2] = 0.0
    cosine = cosines_of_incidence(hits, hits, np.zeros(3), planar=planar)
    straight = 4.0 / np.linalg.norm(hits[:2000], axis=1)
    np.testing.assert_allclose(cosine[:2000], straight, atol=1e-6)
    alone = cosines_of_incidence(hits, np.array([[50.0, 0.0, 0.0]]), np.zeros(3), planar=planar)
    assert np.isnan(alone).all()
    if not planar:
        assert np.isnan(cosine[2000:]).mean() > 0.7


# --- rings ---------------------------------------------------------------------------------------------------------------


def scan_of(points: np.ndarray, planar: bool = False) -> RecordedScan:
    return RecordedScan(
        points=points.astype(np.float32),
        is_return=np.ones(len(points), bool),
        T_map_sensor=np.eye(4),
        stamp_ns=0,
        name="by hand",
        is_planar=planar,
    )


def directions(elevations: np.ndarray, azimuths: np.ndarray) -> np.ndarray:
    e, a = (grid.ravel() for grid in np.meshgrid(elevations, azimuths, indexing="ij"))
    return np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def test_rings_are_told_apart_by_elevation_whatever_the_order() -> None:
    rng = np.random.default_rng(0)
    points = directions(np.radians(np.arange(-15, 16, 2)), np.linspace(-3.1, 3.1, 100))
    order = rng.permutation(len(points))
    rings = ring_numbers(scan_of((points * rng.uniform(1, 9, (len(points), 1)))[order]))
    np.testing.assert_array_equal(rings, np.repeat(np.arange(16), 100)[order])


@pytest.mark.parametrize("turn", [1.0, -1.0])
@pytest.mark.parametrize("start", [0.0, -np.pi])
def test_rings_that_run_into_each_other_are_told_apart_by_their_order(turn: float, start: float) -> None:
    azimuths = start + turn * (0.003 + 2 * np.pi * np.arange(300) / 300)
    points = directions(np.radians(np.linspace(-20, 2, 64)), azimuths)
    points[:, 2] += np.random.default_rng(0).normal(0, np.radians(0.3), len(points))
    np.testing.assert_array_equal(ring_numbers(scan_of(points)), np.repeat(np.arange(64), 300))


def test_a_planar_scan_is_cut_into_sectors() -> None:
    points = directions(np.zeros(1), np.linspace(-np.pi + 1e-3, np.pi - 1e-3, 720))
    rings = ring_numbers(scan_of(points, planar=True))
    np.testing.assert_array_equal(np.bincount(rings), np.full(72, 10))
    out = LeftOutRings(4).beams(scan_of(points, planar=True))
    assert out.sum() == 180


def test_a_cloud_without_rings_is_refused() -> None:
    cloud = np.random.default_rng(0).normal(size=(5000, 3))
    with pytest.raises(SettingsError, match="no rings can be told apart"):
        LeftOutRings(4).beams(scan_of(cloud))
    with pytest.raises(SettingsError, match="at least 2"):
        LeftOutRings(1)


def test_no_map_is_given_a_ring_that_is_left_out_and_all_are_asked_about_it() -> None:
    place, given = Slab(), []

    class Notes(Says):
        def integrate(self, scan: RecordedScan) -> dict[str, float]:
            given.append(scan)
            return {}

    knows = Notes("truth", truth(place).occupancy)
    found = evaluate("slab", place, range(3), [knows], hold_out=HoldOut(), left_out=LeftOutRings(4))
    elevations = np.degrees(LIDAR.elevations_rad)
    left_out = elevations[2::4]
    for scan in given:
        x, y, z = scan.points.T
        off = np.abs(np.degrees(np.arctan2(z, np.hypot(x, y)))[:, None] - left_out).min(axis=1)
        assert off.min() > 1.0
    rings = found.rows[0].scores.rings
    assert rings is not None
    assert rings.metrics.n == 2 * 3 * 90 * len(left_out)  # an end and a free point each
    assert rings.metrics.nll == PERFECT
    assert rings.near is not None


# --- the gauntlet --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gauntlet() -> list[Scores]:
    place = open_dataset("gauntlet:planar360:3", max_range_m=20.0)
    assert isinstance(place, SurveyedRecording)

    def grown(points: np.ndarray) -> Answer:
        shifts = np.linspace(-0.1, 0.1, 9)
        return sure(
            np.any([place.occupied(points + np.array([shift, 0.0, 0.0])) for shift in shifts], axis=0)
        )

    return scores_of(
        place[:4],
        truth(place),
        Says("10 cm thicker", grown),
        Says("unknown", lambda p: sure(np.ones(len(p), bool), np.zeros(len(p), bool))),
        Says("empty", lambda p: sure(np.zeros(len(p), bool))),
    )


def test_the_truth_leaves_doorways_as_wide_as_they_are_and_keeps_all_poles(gauntlet: list[Scores]) -> None:
    found = gauntlet[0].openings
    assert found is not None
    assert {(o.width_m, o.away_m) for o in found.openings} == {
        (w, a) for w in (0.7, 0.9, 1.2) for a in (3.5, 6.0)
    }
    for opening in found.openings:
        assert opening.free_m == pytest.approx(opening.width_m, abs=0.02)
        assert opening.safe_m == opening.free_m
    assert {pole.diameter_m for pole in found.poles} == {0.05, 0.1, 0.2}
    for pole in found.poles:
        assert pole.kept == 1.0
        assert pole.width_m == pytest.approx(pole.diameter_m, abs=0.02)
    assert found.wires == []


def test_thick_walls_narrow_doorways_and_thicken_poles(gauntlet: list[Scores]) -> None:
    found = gauntlet[1].openings
    assert found is not None
    for opening in found.openings:
        assert opening.free_m == pytest.approx(opening.width_m - 0.2, abs=0.03)
        assert opening.least_free_m <= opening.free_m
    for pole in found.poles:
        assert pole.width_m == pytest.approx(pole.diameter_m + 0.2, abs=0.03)


def test_unknown_doorways_are_not_free_and_lost_poles_are_not_kept(gauntlet: list[Scores]) -> None:
    unknown, empty = gauntlet[2].openings, gauntlet[3].openings
    assert unknown is not None
    assert empty is not None
    assert [o.free_m for o in unknown.openings] == [0.0] * 6
    assert [pole.kept for pole in unknown.poles] == [0.0] * 6
    assert [o.free_m for o in empty.openings] == pytest.approx([1.51] * 6)  # as far as it is asked
    assert [pole.kept for pole in empty.poles] == [0.0] * 6
    assert all(np.isnan(pole.width_m) for pole in empty.poles)


def test_wires_are_asked_for_in_three_dimensions() -> None:
    place = open_dataset("gauntlet:vlp16", max_range_m=12.0)
    assert isinstance(place, SurveyedRecording)
    found = scores_of(place[9:11], truth(place))[0].openings
    assert found is not None
    assert [wire.diameter_m for wire in found.wires] == [0.01, 0.02, 0.03]
    assert [wire.kept for wire in found.wires] == [1.0, 1.0, 1.0]


def test_beams_of_the_gauntlet_end_on_its_solids() -> None:
    place = open_dataset("gauntlet:vlp16:1")
    assert isinstance(place, SurveyedRecording)
    assert len(place) == 20
    scan, again = place[7], open_dataset("gauntlet:vlp16:1")[7]
    np.testing.assert_array_equal(scan.points, again.points)
    ends, eye = scan.in_map[scan.is_return], scan.T_map_sensor[:3, 3]
    rays = (ends - eye) / np.linalg.norm(ends - eye, axis=1, keepdims=True)
    range_m, normals = place.cast(eye, rays)
    assert place.occupied(eye + (range_m[:, None] + 1e-3) * rays).mean() > 0.99
    assert not place.occupied(eye + (range_m[:, None] - 1e-3) * rays).any()
    assert (np.einsum("nd,nd->n", normals, rays) < 0).all()
    assert np.median(np.abs(np.linalg.norm(ends - eye, axis=1) - range_m)) < 0.03


def test_a_word_that_means_nothing_to_the_gauntlet_is_named() -> None:
    with pytest.raises(DatasetError, match="'x' is neither a seed nor a sensor"):
        open_dataset("gauntlet:x")


# --- the command ---------------------------------------------------------------------------------------------------------


def test_the_command_writes_all_measures(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    numbers, document = tmp_path / "eval.json", tmp_path / "eval.md"
    flags = ["--scans", "3", "--rings", "4", "--max-range", "12", "--threads", "1", "--peers", "bgk:0.2"]
    files = ["--json", str(numbers), "--markdown", str(document)]
    assert cli.main(["eval", "gauntlet:planar360", *flags, *files]) == 0
    rows = json.loads(numbers.read_text())["evaluations"][0]["rows"]
    for row in rows:
        measures = {"beams", "rings", "truth", "faces", "openings", "protocol_1"}
        assert all(isinstance(row[measure], dict) for measure in measures)
        assert len(row["beams"]["near"]["bins"]) == 4
        assert row["headline"] == (row["protocol_1"]["held_out"]["nll"] + row["beams"]["near"]["nll"]) / 2
    assert len(rows[0]["truth"]["sd"]) == 6
    assert rows[1]["truth"]["sd"] == []
    shown, text = capsys.readouterr().out, document.read_text()
    for name in (
        "beams",
        "near",
        "beams of rings left out",
        "truth",
        "faces",
        "openings",
        "thin things",
        "protocol 1",
    ):
        assert any(line.startswith(name) for line in shown.splitlines())
        assert any(line.startswith(name) for line in text.splitlines())
    assert f"{rows[0]['truth']['ball']['metrics']['nll']:.3f}" in shown
    assert f"| {rows[0]['headline']:.3f} |" in text
