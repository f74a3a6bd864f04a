"""Rays, risk and gradients over the wire, from a server with the real mapper."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from potclient import MapClient
from potschemas import messages, wire
from potschemas.keys import DEFAULT_ROOT
from potschemas.messages import ErrorCode
from potserver.asking.rays import Rays
from potserver.asking.risk import Risk
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Unknown
from potserver.limits import Limits
from potserver.server import MapServer

from .conftest import Client, points_query

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-5, 5, (40, 3))
DIRECTIONS = RNG.normal(size=(40, 3)) * [1, 1, 0.2]
PATH = np.tile(np.eye(4), (5, 1, 1))
PATH[:, 0, 3] = np.linspace(-3, 5.5, 5)
SPHERES = np.array([[0.2, 0, 0.1, 0.4], [-0.2, 0, 0.1, 0.3]])


@pytest.fixture
def map_client(real_client: Client, real_server: MapServer) -> Any:
    with MapClient(real_server.endpoint) as client:
        client.wait_ready()
        yield client


def snapshot(real_server: MapServer) -> KernelMap:
    return real_server.mapper("default").snapshot


def array(values: Any, dtype: Any = np.float64) -> messages.Array:
    return wire.encode_array(np.asarray(values, dtype))


def rays_query(**changes: Any) -> messages.RaysQuery:
    fields: dict[str, Any] = {"origins": array(POINTS), "directions": array(DIRECTIONS), "max_range_m": 9.0}
    return messages.RaysQuery(**fields | changes)


def risk_query(**changes: Any) -> messages.RiskQuery:
    fields: dict[str, Any] = {"path": array(PATH), "spheres": array(SPHERES), "resolution_m": 0.2}
    return messages.RiskQuery(**fields | changes)


@pytest.mark.parametrize("unknown", ["occupied", "free", "prior"])
def test_rays_are_what_the_map_says(map_client: MapClient, real_server: MapServer, unknown: str) -> None:
    answer = map_client.rays(
        np.zeros(3), DIRECTIONS, 9.0, quantiles=[0.25, 0.5], unknown=unknown, step_m=0.1, width_m=0.4
    )
    asked = Rays(
        np.zeros((40, 3)),
        DIRECTIONS.astype(np.float32),
        9.0,
        quantiles=[0.25, 0.5],
        unknown=Unknown(unknown),
        step_m=0.1,
        width_m=0.4,
    )
    plan = asked.plan(snapshot(real_server), Limits())
    expected = plan.result(plan.parts())
    for name in ("hit_probability", "mean_m", "std_m", "quantile_m", "unknown_range_m", "unknown_share"):
        np.testing.assert_allclose(getattr(answer, name), getattr(expected, name), atol=1e-4)
    assert answer.revision == expected.map_revision
    assert answer.hit_probability.max() > 0.85, "there is a room around it"


def test_risk_is_what_the_map_says(map_client: MapClient, real_server: MapServer) -> None:
    answer = map_client.risk(PATH, SPHERES, resolution_m=0.2, unknown="prior", correlation_m=0.7)
    asked = Risk(PATH, SPHERES, resolution_m=0.2, unknown=Unknown.PRIOR, correlation_m=0.7)
    plan = asked.plan(snapshot(real_server), Limits())
    expected = plan.result(plan.parts())
    for name in ("max_probability", "union_probability", "unknown_share"):
        np.testing.assert_allclose(getattr(answer, name), getattr(expected, name), atol=1e-3)
    assert answer.path_union_probability == pytest.approx(expected.path_union_probability, abs=1e-3)
    assert answer.n_cells == expected.n_cells
    assert np.ptp(answer.union_probability) > 0.05, "there is something on the way, and not everywhere"


def test_gradients_over_the_wire_are_those_offline(map_client: MapClient) -> None:
    asked, offline = map_client.occupancy(POINTS, with_gradient=True), map_client.params()
    there = offline.occupancy(POINTS, gradient=True)
    same = asked.observed == there.observed
    assert asked.gradient is not None
    assert there.gradient is not None
    np.testing.assert_allclose(asked.gradient[same], there.gradient[same], atol=2e-3)
    assert np.abs(asked.gradient).max() > 0.05


def test_the_limits_of_rays_and_risk_are_told(real_client: Client) -> None:
    limits = real_client.one("info").limits
    for name in ("max_query_rays", "max_query_poses", "max_query_spheres", "max_query_samples"):
        assert getattr(limits, name) > 0


@pytest.mark.parametrize(
    ("op", "query", "code"),
    [
        ("rays", rays_query(directions=array(DIRECTIONS[:3])), ErrorCode.BAD_ARRAY),
        ("rays", rays_query(origins=array(POINTS, np.int64)), ErrorCode.BAD_ARRAY),
        ("rays", rays_query(directions=array(0 * DIRECTIONS)), ErrorCode.BAD_POINTS),
        ("rays", rays_query(origins=array(POINTS * np.nan)), ErrorCode.BAD_POINTS),
        ("rays", rays_query(origins=array(POINTS + 2e6)), ErrorCode.OUT_OF_RANGE),
        ("rays", rays_query(step_m=1e-6), ErrorCode.TOO_LARGE),
        ("rays", rays_query(quantiles=[0.5, 0.1]), ErrorCode.BAD_POINTS),
        ("rays", rays_query(quantiles=[1.5]), ErrorCode.BAD_MESSAGE),
        ("rays", rays_query(max_range_m=-1.0), ErrorCode.BAD_MESSAGE),
        ("rays", rays_query(deadline_ms=1e-6), ErrorCode.DEADLINE),
        ("risk", risk_query(path=array(PATH[:, :3])), ErrorCode.BAD_ARRAY),
        ("risk", risk_query(path=array(2 * PATH)), ErrorCode.BAD_POSE),
        ("risk", risk_query(spheres=array(-SPHERES)), ErrorCode.BAD_POINTS),
        ("risk", risk_query(spheres=array(np.zeros((300, 4)))), ErrorCode.TOO_LARGE),
        ("risk", risk_query(resolution_m=1e-3), ErrorCode.TOO_LARGE),
        ("risk", risk_query(dims=5), ErrorCode.BAD_MESSAGE),
        ("risk", risk_query(deadline_ms=1e-6), ErrorCode.DEADLINE),
        ("points", points_query(POINTS * np.nan, with_gradient=True), ErrorCode.BAD_POINTS),
    ],
)
def test_bad_questions_get_their_reason(
    real_client: Client, op: str, query: messages.Message, code: ErrorCode
) -> None:
    before = real_client.stats().counters.get(f"queries.{op}.{code.value}", 0)
    error = real_client.error(op, query)
    assert error.code is code
    assert error.message
    assert real_client.stats().counters[f"queries.{op}.{code.value}"] == before + 1


def test_a_question_without_options_is_enough(real_client: Client) -> None:
    answer = real_client.one("rays", rays_query())
    assert isinstance(answer, messages.Rays)
    assert answer.quantile_m.shape == [40, 3]
    assert isinstance(real_client.one("risk", risk_query()), messages.Risk)
    counters = real_client.stats().counters
    assert counters["queries.rays.ok"] > 0
    assert counters["queries.risk.ok"] > 0


def test_rays_answer_on_their_own_key(real_client: Client) -> None:
    (answer,) = real_client.get(f"{DEFAULT_ROOT}/*/q/rays", rays_query())
    assert isinstance(answer, messages.Rays)
