"""What a scan's sender gets back: kernels fitted to it, carried from atoms, or nothing; the map is the same."""

from __future__ import annotations

import numpy as np
import pytest

from potclient.datasets import RecordedScan
from potclient.holdout import HoldOut
from potclient.metrics import score
from potserver.bundled import open_bundled
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import MapUpdate, ParamsKind, Scan
from potserver.mapping.service import MappingService
from potserver.numerics.lean import Lean
from potserver.recordings import to_scan


def own_map(update: MapUpdate) -> KernelMap:
    lean = update.own.lean
    return KernelMap(update.kernels, rule=update.rule, lean=None if lean is None else Lean(*lean))


def nll(update: MapUpdate, points: np.ndarray, occupied: np.ndarray) -> float:
    return score(own_map(update).occupancy(points).mean, occupied).nll


@pytest.fixture(scope="module")
def split() -> tuple[RecordedScan, np.ndarray, np.ndarray]:
    """Four fifths of a street's beams, and points on the others."""
    given, labels = HoldOut().split(open_bundled("street")[0])
    return given, labels.points, labels.occupied


@pytest.fixture(scope="module")
def updates(split) -> dict[ParamsKind, tuple[MappingService, MapUpdate]]:
    """The first scan of a map, for each that its sender may ask for."""
    made = {}
    for kind in ParamsKind:
        service = MappingService(threads=2)
        made[kind] = service, service.integrate(to_scan(split[0], 0), params=kind)
    return made


def test_fitted_kernels_answer_better_than_carried_ones(updates, split) -> None:
    _, points, occupied = split
    found = {
        kind: nll(updates[kind][1], points, occupied) for kind in (ParamsKind.FITTED, ParamsKind.TRANSPORTED)
    }
    assert found[ParamsKind.FITTED] < 0.8 * found[ParamsKind.TRANSPORTED]
    assert found[ParamsKind.FITTED] < 0.2


def test_a_fit_leans_on_the_dictionary_and_names_what_it_took(updates, split) -> None:
    given, points, occupied = split
    _, leaning = updates[ParamsKind.FITTED]
    bare = MappingService(AtomDictionary(), threads=2).integrate(to_scan(given, 0))
    assert bare.own.lean is None
    assert bare.own.borrowed == ()
    assert nll(leaning, points, occupied) < nll(bare, points, occupied)
    assert sum(part.weight for part in leaning.own.borrowed) == pytest.approx(1.0, abs=0.05)
    for part in leaning.own.borrowed:
        below = given.T_map_sensor[:3, 3] - part.displacement
        assert np.abs(below[:2]).max() < 1e-9
        assert 1.0 < below[2] < 3.0, "the ground below the sensor of a car"


def test_the_map_is_the_same_whatever_is_asked_for(updates) -> None:
    one, *others = (service.snapshot.kernels for service, _ in updates.values())
    for other in others:
        np.testing.assert_array_equal(one.hinge_mean, other.hinge_mean)
        np.testing.assert_array_equal(one.weight_mean, other.weight_mean)


def test_only_what_is_asked_for_is_computed(updates) -> None:
    steps = {kind: set(update.timings_ms) for kind, (_, update) in updates.items()}
    assert steps[ParamsKind.FITTED] - steps[ParamsKind.NONE] == {"fit"}
    assert steps[ParamsKind.TRANSPORTED] - steps[ParamsKind.NONE] == {"match", "transport", "refine"}
    nothing = updates[ParamsKind.NONE][1]
    assert nothing.own.is_nothing
    assert len(nothing.kernels) == len(nothing.sectors) == 0


def test_a_scan_asks_itself(split) -> None:
    given = to_scan(split[0], 0)
    asking = Scan(
        points=given.points,
        T_map_sensor=given.T_map_sensor,
        is_return=given.is_return,
        params=ParamsKind.NONE,
    )
    assert MappingService(threads=2).integrate(asking).own.is_nothing


@pytest.mark.parametrize("planar", [False, True], ids=["3d", "2d"])
def test_a_fit_is_of_one_scan_and_the_same_anywhere(planar: bool) -> None:
    angle = np.linspace(-np.pi, np.pi, 900, endpoint=False)
    points = np.stack(
        [5 * np.cos(angle), 4 * np.sin(angle), np.zeros(900) if planar else np.sin(7 * angle)], axis=1
    )
    found = []
    for place in ((0.0, 0.0, 0.0), (691_610.0, 5_335_800.0, 0.0)):  # leans stand on a lattice of the map
        pose = np.eye(4)
        pose[:3, 3] = place
        service = MappingService(threads=1)
        for _ in range(2):  # the second fit knows nothing of the first scan
            update = service.integrate(
                Scan(points=points.astype(np.float32), T_map_sensor=pose, is_planar=planar)
            )
            found.append(own_map(update).occupancy(0.9 * points + place).mean)
    assert found[0].mean() < 0.2
    for other in found[1:]:  # draws differ from scan to scan
        assert np.abs(other - found[0]).mean() < 0.02
    assert np.abs(found[2] - found[0]).max() < 0.02


def test_scans_without_echoes_are_free_space() -> None:
    points = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32) * 4.0
    scan = Scan(points=points, T_map_sensor=np.eye(4), is_return=np.zeros(300, bool))
    answer = own_map(MappingService(threads=1).integrate(scan)).occupancy(0.5 * points)
    assert answer.mean[answer.observed].max() < 0.5
    assert answer.observed.mean() > 0.5
