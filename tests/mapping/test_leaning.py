"""A map that leans: on what the dictionary expects where little was seen, and on nothing where it cannot."""

from __future__ import annotations

import numpy as np
import pytest

from potclient.metrics import score
from potclient.towns import TownRecording
from potserver.asking.rays import Rays
from potserver.asking.risk import Risk
from potserver.domain.atom_file import Learned
from potserver.domain.dictionary import EXPECTATION, AtomDictionary
from potserver.domain.types import Scan, Unknown, yaw_pose
from potserver.limits import Limits
from potserver.mapping import leaning
from potserver.mapping.service import MappingService
from potserver.recordings import Reader, open_recording, to_scan

EXPECTING = AtomDictionary((), expectation=AtomDictionary.builtin().expectation)


@pytest.fixture(scope="module")
def street() -> TownRecording:
    return open_recording("town:suburb:vlp16:60m:31", Reader(max_range_m=20.0))


def few_rings(street: TownRecording, number: int, every: int) -> tuple[Scan, Scan]:
    """A scan's beams of every so many elevations, and all others."""
    whole = to_scan(street[number], number)
    x, y, z = whole.points.T.astype(float)
    ring = np.rint(np.degrees(np.arctan2(z, np.hypot(x, y)))).astype(int) // 2
    kept = ring % every == 0
    thin, rest = (
        Scan(points=whole.points[m], is_return=whole.is_return[m], T_map_sensor=whole.T_map_sensor)
        for m in (kept, ~kept)
    )
    return thin, rest


def mapped(dictionary: AtomDictionary, *scans: Scan) -> MappingService:
    service = MappingService(dictionary, threads=1)
    for scan in scans:
        service.integrate(scan)
    return service


def labels_of(scan: Scan) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    ends = scan.beams.ends
    along = rng.random(len(ends))[:, None]
    points = np.concatenate([ends[scan.is_return], ends * along]) + scan.origin
    return points, np.arange(len(points)) < scan.is_return.sum()


def test_between_rings_a_leaning_map_is_far_better(street: TownRecording) -> None:
    thin, rest = few_rings(street, 5, 4)
    points, occupied = labels_of(rest)
    bare, leaning_map = (mapped(d, thin).snapshot.occupancy(points) for d in (AtomDictionary(()), EXPECTING))
    without, with_it = (score(a.mean, occupied) for a in (bare, leaning_map))
    assert with_it.nll < 0.6 * without.nll
    assert with_it.ece < without.ece
    assert not bare.borrowed.any()
    np.testing.assert_array_equal(leaning_map.observed, bare.observed)  # what is observed goes by evidence
    assert (leaning_map.borrowed[~bare.observed] == 1.0).mean() > 0.95


def test_evidence_only_borrows_nothing(street: TownRecording) -> None:
    thin, rest = few_rings(street, 5, 2)
    points, _ = labels_of(rest)
    snapshot = mapped(EXPECTING, thin).snapshot
    answer, own = snapshot.occupancy(points), snapshot.occupancy(points, evidence_only=True)
    assert not own.borrowed.any()
    assert (own.mean[~own.observed] == 0.5).all()
    assert (answer.mean[~own.observed] != 0.5).mean() > 0.9
    sure = answer.observed & (answer.borrowed == 0.0)
    np.testing.assert_allclose(answer.mean[sure], own.mean[sure], rtol=1e-6)


@pytest.mark.parametrize("evidence_only", [False, True])
def test_rays_and_risk_borrow_what_points_borrow(street: TownRecording, evidence_only: bool) -> None:
    thin, _ = few_rings(street, 5, 4)
    snapshot = mapped(EXPECTING, thin).snapshot
    rng = np.random.default_rng(2)
    ways = rng.normal(size=(40, 3)) * [1.0, 1.0, 0.1]
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    asked = Rays(
        np.tile(thin.origin, (40, 1)), ways, 16.0, width_m=0.4, step_m=0.1, evidence_only=evidence_only
    )
    plan = asked.plan(snapshot, Limits())
    rays = plan.result(plan.parts())
    middles = thin.origin + ways[:, None] * ((np.arange(160) + 0.5) * 0.1)[:, None]
    points = snapshot.occupancy(middles.reshape(-1, 3), evidence_only=evidence_only)
    hazard = np.cumsum(-np.log1p(-points.mean.reshape(40, -1)) / 0.4 * 0.1, axis=1)
    survival = np.exp(-np.column_stack([np.zeros(40), hazard]))
    length = (survival[:, :-1] - survival[:, 1:]) / np.diff(hazard, axis=1, prepend=0.0) * 0.1
    borrowed = (length * points.borrowed.reshape(40, -1)).sum(axis=1) / length.sum(axis=1)
    np.testing.assert_allclose(rays.mean_m, length.sum(axis=1), atol=0.02)
    np.testing.assert_allclose(rays.borrowed_share, borrowed, atol=0.01)
    way = np.tile(np.eye(4), (5, 1, 1))
    way[:, :3, 3] = middles[0, :100:20]
    for unknown in Unknown:
        told = Risk(way, [[0, 0, 0, 0.5]], unknown=unknown, evidence_only=evidence_only).plan(
            snapshot, Limits()
        )
        risk = told.result(told.parts())
        cells = snapshot.occupancy((told.swept.cells + 0.5) * risk.resolution_m, evidence_only=evidence_only)
        counts = cells.borrowed * (cells.observed | (unknown is Unknown.PRIOR))
        assert risk.path_borrowed_share == pytest.approx(counts.mean(), abs=1e-5)
        assert risk.borrowed_share.max() >= risk.path_borrowed_share
        assert (risk.path_borrowed_share > 0.0) == (not evidence_only)
    assert rays.borrowed_share.max() > 0.05 or evidence_only
    assert not (evidence_only and rays.borrowed_share.any())


def test_what_foretells_a_scan_best_speaks(street: TownRecording) -> None:
    net = AtomDictionary.builtin().expectation
    assert net is not None
    wrong = net._replace(last=-net.last, last_bias=-net.last_bias)
    scan = to_scan(street[5], 5)
    for base, other, name in ((wrong, net, "other"), (net, wrong, EXPECTATION)):
        both = AtomDictionary(expectation=base, grown=[Learned("other", other, {})])
        update = MappingService(both, threads=1).integrate(scan)
        assert [borrowed.name for borrowed in update.own.borrowed] == [name]
    neither = AtomDictionary(expectation=wrong, grown=[Learned("other", wrong, {})])
    assert MappingService(neither, threads=1).integrate(scan).not_leaning == leaning.NOVEL


def test_with_more_evidence_less_is_borrowed(street: TownRecording) -> None:
    scans = [to_scan(street[i], i) for i in (4, 5, 6)]
    points, _ = labels_of(few_rings(street, 5, 2)[1])
    shares = [mapped(EXPECTING, *scans[:n]).snapshot.occupancy(points).borrowed.mean() for n in (1, 3)]
    assert shares[1] < shares[0]


def test_a_tile_keeps_the_lean_that_its_evidence_began_with(street: TownRecording) -> None:
    service = mapped(EXPECTING, to_scan(street[0], 0))
    assert service.state.tiled is not None
    first = {
        i: t.lean for i, t in service.state.tiled.tiles.items() if t.lean is not None and len(t.rows.kind)
    }
    service.integrate(to_scan(street[10], 1))
    assert len(first) > 3
    assert all(service.state.tiled.tiles[i].lean is lean for i, lean in first.items())


def test_forgetting_a_robot_forgets_what_was_expected_about_it(street: TownRecording) -> None:
    service = mapped(EXPECTING, to_scan(street[0], 0))
    service.remove_robot("recording")
    assert service.state.tiled is not None
    assert not service.state.tiled.tiles
    assert service.snapshot.lean is None


@pytest.mark.parametrize(
    ("dictionary", "scan", "reason"),
    [
        (AtomDictionary(()), "ground", leaning.NO_MODEL),
        (EXPECTING, "planar", leaning.PLANAR),
        (EXPECTING, "wall", leaning.NO_GROUND),
        (EXPECTING, "snow", leaning.NOVEL),
        (EXPECTING, "ground", None),
    ],
)
def test_a_map_says_why_it_does_not_lean(dictionary: AtomDictionary, scan: str, reason: str | None) -> None:
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-12, 12, (2500, 2)), np.full(2500, -1.6)])
    made = {
        "ground": ground,
        "planar": ground * [1, 1, 0],
        "wall": np.column_stack([np.full(2500, 6.0), rng.uniform(-6, 6, 2500), rng.uniform(1, 5, 2500)]),
        # most beams end anywhere on their way to a level floor
        "snow": ground * np.where(rng.random(2500) < 0.8, rng.random(2500), 1.0)[:, None],
    }[scan].astype(np.float32)
    returned = np.ones(len(made), bool)
    service = MappingService(dictionary, threads=1)
    pose, planar = yaw_pose(0, 0, 0), scan == "planar"
    update = service.integrate(Scan(points=made, is_return=returned, T_map_sensor=pose, is_planar=planar))
    assert update.not_leaning == reason
    assert (service.snapshot.lean is None) == (reason is not None)
