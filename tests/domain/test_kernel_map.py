"""KernelMap: what it accepts and the rule for what was never seen. Exactness: tests/conformance/test_eq1_occupancy.py."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from potschemas.answers import OBSERVED_ACTIVATION, PRIOR_VAR, AnswerRule
from potserver.domain.kernel_map import KernelMap, as_points
from potserver.domain.map_part import MapPart
from potserver.domain.types import KernelSet
from potserver.errors import BadPointsError, ShapeError

GOOD = {
    "hinge_points": [[0.0, 0, 0], [1, 0, 0]],
    "gamma": [1.0, 2.0],
    "weight_mean": [3.0, -1.0],
    "weight_var": [0.5, 0.0],
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("hinge_points", [[0.0, 0, 0]]),
        ("hinge_points", [[0.0], [1.0]]),
        ("hinge_points", [0.0, 1.0]),
        ("gamma", [1.0]),
        ("gamma", [1.0, 0.0]),
        ("gamma", [1.0, -1.0]),
        ("gamma", [1.0, np.nan]),
        ("gamma", [1.0, np.inf]),
        ("weight_mean", [1.0, 2.0, 3.0]),
        ("weight_mean", [1.0, np.inf]),
        ("weight_var", [1.0, -1e-9]),
        ("weight_var", [1.0, np.nan]),
    ],
)
def test_bad_arrays_are_refused(name: str, value: list) -> None:
    with pytest.raises(ShapeError):
        KernelMap.from_arrays(**(GOOD | {name: value}))


def test_hinges_that_are_not_finite_are_refused() -> None:
    with pytest.raises(BadPointsError):
        KernelMap.from_arrays(**(GOOD | {"hinge_points": [[0.0, 0, 0], [np.nan, 0, 0]]}))


def test_row_vectors_and_columns_are_taken_as_the_authors_ship_them() -> None:
    shaped = {
        k: np.reshape(v, (1, 2)) if k == "gamma" else np.reshape(v, (2, 1))
        for k, v in GOOD.items()
        if k != "hinge_points"
    }
    one = KernelMap.from_arrays(**GOOD).occupancy([[0.5, 0, 0]])
    other = KernelMap.from_arrays(GOOD["hinge_points"], **shaped).occupancy([[0.5, 0, 0]])
    np.testing.assert_array_equal(one.mean, other.mean)


@pytest.mark.parametrize("points", [[0.0, 0, 0], [[0.0]], [[0.0] * 4], [[[0.0, 0, 0]]], []])
def test_queries_of_another_shape_are_refused(points: list) -> None:
    with pytest.raises(ShapeError):
        KernelMap.from_arrays(**GOOD).occupancy(points)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_queries_that_are_not_finite_are_refused(value: float) -> None:
    with pytest.raises(BadPointsError):
        KernelMap.from_arrays(**GOOD).occupancy([[0.0, 0, 0], [0, value, 0]])


def test_no_queries_no_answers() -> None:
    answer = KernelMap.from_arrays(**GOOD).occupancy(np.zeros((0, 3)))
    assert len(answer.mean) == len(answer.var) == len(answer.observed) == 0


def test_as_points_pads_2d_with_zero() -> None:
    np.testing.assert_array_equal(as_points([[1, 2]]), [[1.0, 2.0, 0.0]])
    assert as_points(np.zeros((2, 3), np.float32)).dtype == np.float64


def test_the_answer_says_what_is_known() -> None:
    kernels = KernelMap.from_arrays([[0.0, 0, 0]], [1.0], [4.0], [0.5])
    edge = np.sqrt(-np.log(OBSERVED_ACTIVATION))
    answer = kernels.occupancy([[0, 0, 0], [edge * 0.999, 0, 0], [edge * 1.001, 0, 0], [100.0, 0, 0]])
    np.testing.assert_array_equal(answer.observed, [True, True, False, False])
    np.testing.assert_allclose(answer.latent_mean[:2], [4.0, 4.0 * OBSERVED_ACTIVATION], rtol=1e-2)
    np.testing.assert_array_equal(answer.latent_mean[2:], 0.0)
    np.testing.assert_array_equal(answer.latent_var[2:], np.float32(PRIOR_VAR))
    np.testing.assert_array_equal(answer.mean[2:], 0.5)
    assert (answer.var[2:] > 0.15).all()
    assert answer.mean.dtype == answer.var.dtype == np.float64


def test_unknown_is_as_uncertain_as_it_is_told() -> None:
    kernels = KernelMap.from_arrays(**GOOD, rule=AnswerRule(prior_var=7.0, observed_activation=0.9))
    answer = kernels.occupancy([[0.0, 0.9, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(answer.observed, [False, True])
    assert answer.latent_var[0] == np.float32(7.0)


def test_a_sure_answer_is_never_exactly_one() -> None:
    """In float32, 1 - 1e-9 is 1, and being wrong would cost an infinite log-loss."""
    answer = KernelMap.from_arrays([[0.0, 0, 0]], [1.0], [25.0], [0.0]).occupancy([[0.0, 0, 0]])
    assert 0.999999 < answer.mean[0] < 1.0


def test_the_revision_travels_with_the_answer() -> None:
    assert KernelMap(KernelSet.empty(), map_revision=17).occupancy([[0.0, 0, 0]]).map_revision == 17


def test_a_map_ignores_later_changes_of_the_callers_arrays() -> None:
    hinge, weight = np.array(GOOD["hinge_points"]), np.array(GOOD["weight_mean"])
    kernels = KernelMap.from_arrays(hinge, GOOD["gamma"], weight, GOOD["weight_var"])
    before = kernels.occupancy([[0.2, 0, 0]]).mean
    hinge += 100.0
    weight *= -1.0
    np.testing.assert_array_equal(kernels.occupancy([[0.2, 0, 0]]).mean, before)


def test_many_threads_may_ask_at_once() -> None:
    rng = np.random.default_rng(0)
    kernels = KernelMap.from_arrays(
        rng.uniform(-9, 9, (3000, 3)),
        rng.uniform(0.1, 4, 3000),
        rng.normal(size=3000),
        np.ones(3000),
        threads=2,
    )
    points = rng.uniform(-9, 9, (2000, 3))
    truth = kernels.occupancy(points).mean
    answers: list[np.ndarray] = [np.empty(0)] * 6

    def ask(i: int) -> None:
        answers[i] = kernels.occupancy(points).mean

    threads = [threading.Thread(target=ask, args=(i,)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for answer in answers:
        np.testing.assert_array_equal(answer, truth)


def test_parts_answer_like_the_whole() -> None:
    rng = np.random.default_rng(0)
    whole = KernelMap.from_arrays(
        rng.uniform(-60, 60, (4000, 3)) * [1, 1, 0.1],
        rng.uniform(0.1, 4, 4000),
        rng.normal(0, 4, 4000),
        rng.uniform(0, 2, 4000),
    )
    part_of = np.floor(whole.kernels.hinge_mean[:, 0] / 25.0).astype(int)
    parts = [MapPart.of(whole.kernels.take(part_of == n)) for n in (*np.unique(part_of), 99)]
    together = KernelMap(parts, map_revision=3, threads=2)
    points = np.concatenate([rng.uniform(-70, 70, (5000, 3)) * [1, 1, 0.1], whole.kernels.hinge_mean[:500]])
    one, other = whole.occupancy(points), together.occupancy(points)
    np.testing.assert_allclose(one.mean, other.mean, atol=2e-4)
    np.testing.assert_allclose(one.latent_var, other.latent_var, rtol=1e-2, atol=1e-2)
    assert (one.observed == other.observed).mean() > 0.999
    assert len(together) == len(together.kernels) == 4000
    alone = together.occupancy(points[:1])
    np.testing.assert_allclose(alone.mean, other.mean[:1], atol=1e-6)


def test_a_map_of_no_parts_knows_nothing() -> None:
    empty = KernelMap([])
    assert len(empty) == len(empty.kernels) == 0
    assert not empty.occupancy(np.zeros((3, 3))).observed.any()
