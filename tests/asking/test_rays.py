"""Where rays first return: the march against float64 sums, against worlds with a formula, and against a town's truth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from potclient.towns import open_town
from potschemas.answers import AnswerRule
from potserver.asking.rays import RayReturns, Rays
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet, Scan, Unknown
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.limits import Limits
from potserver.mapping.service import MappingService
from tests.conformance import reference

Array = np.ndarray[Any, Any]


def cast(
    kernels: KernelMap, origins: Any, directions: Any, max_range_m: float = 10.0, **options: Any
) -> RayReturns:
    plan = Rays(origins, directions, max_range_m, **options).plan(kernels, Limits())
    return plan.result(plan.parts())


def scene(k: int = 300, seed: int = 0, *, shift_m: float = 0.0, **rule: float) -> KernelMap:
    rng = np.random.default_rng(seed)
    return KernelMap.from_arrays(
        rng.uniform(-5, 5, (k, 3)) + shift_m,
        rng.uniform(0.3, 4.0, k),
        rng.normal(-2.0, 3.0, k),
        rng.uniform(0.1, 2.0, k),
        threads=1,
        rule=AnswerRule(**rule),
    )


def some_rays(n: int = 24, seed: int = 1) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-4, 4, (n, 3)), rng.normal(size=(n, 3))


def rates_by_hand(
    kernels: KernelMap, points: Array, unknown_rate: float, width_m: float | None
) -> tuple[Array, Array]:
    """Hazards (1/m) in float64, every kernel at every point, and where the map knows."""
    k = kernels.kernels
    gamma = k.gamma_shape.astype(float) / k.gamma_rate
    sums = reference.latent(points, k.hinge_mean, gamma, k.weight_mean, k.weight_var)
    s2 = sums.var + kernels.rule.residual_var * np.maximum(1 - sums.activation, 0)
    z = sums.mean / np.sqrt(1 + math.pi / 8 * s2)
    widths = np.sqrt(math.pi / (2 * gamma))
    by_known = widths * (1 - k.weight_var / kernels.rule.prior_var)
    weighted = reference.latent(points, k.hinge_mean, gamma, by_known, 0 * widths)
    width = weighted.mean / sums.activation if width_m is None else width_m
    known = sums.activation >= kernels.rule.observed_activation
    return np.where(known, np.logaddexp(0, z) / width, unknown_rate), known


@pytest.mark.parametrize("width_m", [None, 0.7])
@pytest.mark.parametrize("unknown", [Unknown.FREE, Unknown.PRIOR])
def test_the_march_is_the_sum_of_the_hazard(width_m: float | None, unknown: Unknown) -> None:
    kernels = scene(120, residual_var=20.0)
    origins, directions = some_rays()
    levels = (0.1, 0.5, 0.9)
    max_range_m, n_steps = 10.0, 200
    answer = cast(
        kernels,
        origins,
        directions,
        max_range_m,
        quantiles=levels,
        unknown=unknown,
        width_m=width_m,
        step_m=max_range_m / n_steps,
    )
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    h = max_range_m / n_steps
    rate_of_unknown = 0.0 if unknown is Unknown.FREE else math.log(2) / (width_m or kernels.typical_width_m)
    seen_unknown = 0
    for i in range(len(origins)):
        middles = (np.arange(n_steps) + 0.5) * h
        rate, known = rates_by_hand(
            kernels, origins[i] + middles[:, None] * unit[i], rate_of_unknown, width_m
        )
        edges = np.linspace(0, max_range_m, n_steps + 1)
        hazard = np.concatenate([[0], np.cumsum(rate * h)])
        # the same piecewise constant hazard on a grid forty times finer, summed without any formula
        r = (np.arange(40 * n_steps) + 0.5) * h / 40
        survival = np.exp(-np.interp(r, edges, hazard))
        mean = survival.sum() * h / 40
        second = 2 * (r * survival).sum() * h / 40
        np.testing.assert_allclose(answer.hit_probability[i], 1 - math.exp(-hazard[-1]), atol=1e-3)
        np.testing.assert_allclose(answer.mean_m[i], mean, atol=5e-3)
        np.testing.assert_allclose(answer.std_m[i], math.sqrt(second - mean**2), atol=1e-2)
        for q, level in enumerate(levels):
            target = -math.log1p(-level)
            expected = np.interp(target, hazard, edges) if hazard[-1] > target else max_range_m
            np.testing.assert_allclose(answer.quantile_m[i, q], expected, atol=1e-2)
        first_unknown = edges[:-1][~known][0] if (~known).any() else math.nan
        np.testing.assert_allclose(answer.unknown_range_m[i], first_unknown, atol=h * 1.01)
        share = survival.reshape(-1, 40).sum(axis=1)[~known].sum() / survival.sum()
        np.testing.assert_allclose(answer.unknown_share[i], share, atol=2e-2)
        seen_unknown += not known.all()
    assert 0 < seen_unknown < len(origins), "rays of both kinds"


def test_halving_the_step_quarters_the_error() -> None:
    kernels = scene(400, observed_activation=1e-4)
    origins, directions = some_rays(60)

    def mean(step_m: float) -> Array:
        return cast(kernels, origins, directions, 3.0, step_m=step_m, unknown=Unknown.FREE).mean_m

    exact = mean(0.004)
    errors = [float(np.abs(mean(step_m) - exact).mean()) for step_m in (0.4, 0.2, 0.1)]
    assert errors[1] < 0.35 * errors[0]
    assert errors[2] < 0.35 * errors[1]
    finest = cast(kernels, origins, directions, 3.0, unknown=Unknown.FREE)
    assert np.abs(finest.mean_m - exact).max() < 0.02, "the step of its own is fine enough"


@pytest.mark.parametrize("step_m", [0.01, 0.3, 5.0])
@pytest.mark.parametrize("weight", [-4.0, 0.0, 2.0])
def test_a_world_of_constant_probability_stops_rays_exponentially(step_m: float, weight: float) -> None:
    kernels = KernelMap.from_arrays([[0.0, 0, 0]], [1e-9], [weight], [0.0])
    p = 1 / (1 + math.exp(-weight))
    rate = -math.log1p(-p) / 0.5
    answer = cast(kernels, [[0.0, 0, 0]], [[0, 2.0, 0]], 4.0, step_m=step_m, width_m=0.5, quantiles=[0.05])
    through = math.exp(-4.0 * rate)
    mean = (1 - through) / rate
    second = 2 * (1 - through * (1 + 4.0 * rate)) / rate**2
    assert answer.hit_probability[0] == pytest.approx(1 - through, abs=1e-5)
    assert answer.mean_m[0] == pytest.approx(mean, rel=1e-4)
    assert answer.std_m[0] == pytest.approx(math.sqrt(second - mean**2), rel=1e-3)
    assert answer.quantile_m[0, 0] == pytest.approx(min(-math.log(0.95) / rate, 4.0), rel=1e-4)
    assert math.isnan(answer.unknown_range_m[0])
    assert answer.unknown_share[0] == 0.0
    one_width = cast(kernels, [[0.0, 0, 0]], [[1, 0, 0]], 0.5, step_m=step_m, width_m=0.5)
    assert one_width.hit_probability[0] == pytest.approx(p, abs=1e-5), "one width is one trial"


def wall(x_m: float = 5.0) -> KernelMap:
    """Free space from x = -1 on, and a wall."""
    y, z = np.meshgrid(np.arange(-3, 3.1, 0.15), np.arange(-2, 2.1, 0.15), indexing="ij")
    sheet = np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], axis=1)
    free = np.stack(
        np.meshgrid(np.arange(-1, x_m - 0.6, 0.8), np.arange(-3, 3.1, 0.8), np.arange(-2, 2.1, 0.8)), -1
    )
    free = free.reshape(-1, 3)
    hinge = np.concatenate([sheet, free])
    gamma = np.r_[np.full(len(sheet), 40.0), np.full(len(free), 1.5)]
    weight = np.r_[np.full(len(sheet), 3.0), np.full(len(free), -4.0)]
    return KernelMap.from_arrays(hinge, gamma, weight, np.full(len(hinge), 0.1))


def test_rays_end_at_a_wall() -> None:
    angle = np.radians([-25, -10, 0, 10, 25])
    directions = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    answer = cast(wall(), np.zeros((5, 3)), directions, 8.0)
    np.testing.assert_allclose(answer.quantile_m[:, 1], 5.0 / np.cos(angle), atol=0.15)
    np.testing.assert_allclose(answer.mean_m, 5.0 / np.cos(angle), atol=0.2)
    assert (answer.hit_probability > 0.99).all()
    assert (answer.std_m < 0.3).all()
    short = cast(wall(), np.zeros((5, 3)), directions, 3.0)
    assert (short.hit_probability < 0.05).all()
    assert (short.quantile_m[:, 1] == 3.0).all(), "the maximum range where no return is likely"


def test_away_from_the_wall_the_map_does_not_know() -> None:
    for unknown, hit in ((Unknown.FREE, 0.0), (Unknown.PRIOR, 1.0), (Unknown.OCCUPIED, 1.0)):
        answer = cast(wall(), [[0.0, 0, 0]], [[-1, 0, 0]], 20.0, unknown=unknown)
        assert answer.hit_probability[0] == pytest.approx(hit, abs=0.25)
        assert 1.5 < answer.unknown_range_m[0] < 3.5
        if unknown is Unknown.OCCUPIED:
            assert answer.quantile_m[0, 2] == answer.unknown_range_m[0]
            assert answer.unknown_share[0] == 0.0
        elif unknown is Unknown.FREE:
            assert answer.unknown_share[0] == pytest.approx(1 - answer.unknown_range_m[0] / 20.0, abs=0.03)


def test_an_empty_map_knows_nothing() -> None:
    nothing = KernelMap(KernelSet.empty(), map_revision=3)
    free, prior, occupied = (
        cast(nothing, [[1.0, 2, 3]], [[0, 0, 1]], 4.0, unknown=unknown)
        for unknown in (Unknown.FREE, Unknown.PRIOR, Unknown.OCCUPIED)
    )
    assert (free.hit_probability[0], free.mean_m[0], free.std_m[0]) == (0.0, 4.0, 0.0)
    assert prior.hit_probability[0] == pytest.approx(1 - 0.5**4), (
        "a metre is one trial where there is nothing"
    )
    assert (occupied.hit_probability[0], occupied.mean_m[0]) == (1.0, 0.0)
    for answer in (free, prior, occupied):
        assert (answer.unknown_range_m[0], answer.unknown_share[0]) == (0.0, 1.0)
        assert answer.map_revision == 3


def test_unobserved_space_begins_where_the_points_say() -> None:
    kernels = KernelMap.from_arrays([[0.0, 0, 0]], [1.0], [-3.0], [0.1])
    edge = math.sqrt(-math.log(kernels.rule.observed_activation))
    answer = cast(kernels, [[0.0, 0, 0]], [[1, 0, 0]], 5.0, step_m=0.01)
    assert answer.unknown_range_m[0] == pytest.approx(edge, abs=0.011)


@pytest.mark.parametrize("blocks", [(1, 1), (7, 7), (64, 64)])
def test_what_is_gathered_together_does_not_matter(
    monkeypatch: pytest.MonkeyPatch, blocks: tuple[int, int]
) -> None:
    kernels, (origins, directions) = scene(), some_rays(80)
    expected = cast(kernels, origins, directions)
    monkeypatch.setattr("potserver.numerics.rays._BLOCK_STEPS", blocks)
    answer = cast(kernels, origins, directions)
    for name in ("hit_probability", "mean_m", "std_m", "quantile_m"):
        # a point on the edge of the observed may fall to either side
        same = np.isclose(getattr(answer, name), getattr(expected, name), rtol=1e-7, atol=2e-3)
        assert same.mean() > 0.98


def test_parts_and_threads_do_not_matter() -> None:
    origins, directions = some_rays(50)
    kernels = scene()
    many = KernelMap(kernels.kernels, rule=kernels.rule, threads=3)
    plan = Rays(origins, directions, 10.0).plan(many, Limits(), part_samples=300)
    assert plan.n_parts > 5
    answer = plan.result(plan.parts())
    np.testing.assert_array_equal(answer.mean_m, cast(kernels, origins, directions).mean_m)


def test_far_coordinates_lose_nothing() -> None:
    origins, directions = some_rays(20)
    near, far = (cast(scene(shift_m=s), origins + s, directions) for s in (0.0, 5e6))
    np.testing.assert_allclose(near.mean_m, far.mean_m, atol=1e-3)


def test_more_weight_stops_more_rays() -> None:
    origins, directions = some_rays(40)
    k = scene().kernels
    gamma = k.gamma_shape / k.gamma_rate
    less, more = (
        cast(
            KernelMap.from_arrays(k.hinge_mean, gamma, k.weight_mean + extra, k.weight_var),
            origins,
            directions,
        )
        for extra in (0.0, 1.0)
    )
    assert (more.hit_probability >= less.hit_probability - 1e-6).all()
    assert (more.mean_m <= less.mean_m + 1e-4).all()
    assert (np.diff(less.quantile_m, axis=1) >= 0).all()


def test_the_medians_are_near_the_truth_of_a_town() -> None:
    """A planar drive: half of each scan's beams make the map, the other half are asked for."""
    recording = open_town("town:offices:2d:planar360:20m:3", max_range_m=12.0)
    mapping = MappingService(threads=1)
    origins, directions, range_m = [], [], []
    for k in np.linspace(0, len(recording) - 1, 6).astype(int):
        scan = recording[int(k)]
        used = np.arange(len(scan)) % 2 == 0
        mapping.integrate(
            Scan(
                points=scan.points[used],
                is_return=scan.is_return[used],
                T_map_sensor=scan.T_map_sensor,
                is_planar=True,
            )
        )
        asked = ~used & scan.is_return
        offset = scan.in_map[asked] - scan.T_map_sensor[:3, 3]
        origins.append(np.broadcast_to(scan.T_map_sensor[:3, 3], offset.shape))
        directions.append(offset)
        range_m.append(np.linalg.norm(offset, axis=1))
    truth = np.concatenate(range_m)
    answer = cast(mapping.snapshot, np.concatenate(origins), np.concatenate(directions), 15.0)
    error = answer.quantile_m[:, 1] - truth
    assert np.median(np.abs(error)) < 0.15
    assert abs(np.median(error)) < 0.1
    inside = (truth >= answer.quantile_m[:, 0]) & (truth <= answer.quantile_m[:, 2])
    assert inside.mean() > 0.8, "nine in ten, were the map perfect"


# --- what is refused -----------------------------------------------------------------------------------------------


class FewRays(Limits):
    max_query_rays = 10


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"origins": [[np.nan, 0, 0]]}, BadPointsError, "NaN"),
        ({"directions": [[0, np.inf, 0]]}, BadPointsError, "NaN or inf"),
        ({"directions": [[0.0, 0, 0]]}, BadPointsError, "no length"),
        ({"directions": [[1.0, 0, 0]] * 2}, ShapeError, "1 origins and 2"),
        ({"origins": [0.0, 0, 0]}, ShapeError, "need"),
        ({"origins": [[2.1e7, 0, 0]]}, OutOfRangeError, "limit"),
        ({"max_range_m": 0.0}, BadPointsError, "max_range_m"),
        ({"max_range_m": np.nan}, BadPointsError, "max_range_m"),
        ({"max_range_m": 1e9}, OutOfRangeError, "limit"),
        ({"step_m": -1.0}, BadPointsError, "step_m"),
        ({"step_m": 1e-300}, TooLargeError, "step_m"),
        ({"width_m": 0.0}, BadPointsError, "width_m"),
        ({"quantiles": [0.5, 0.5]}, BadPointsError, "quantiles"),
        ({"quantiles": [0.0]}, BadPointsError, "quantiles"),
        ({"quantiles": [np.nan]}, BadPointsError, "quantiles"),
        ({"quantiles": np.linspace(0.1, 0.9, 17)}, BadPointsError, "at most 16"),
        ({"origins": np.zeros((11, 3)), "directions": np.ones((11, 3))}, TooLargeError, "11 rays"),
        ({"origins": np.zeros((9, 3)), "directions": np.ones((9, 3))}, TooLargeError, "step_m"),
    ],
)
def test_bad_rays(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    kernels, limits = scene(), FewRays(max_query_samples=400)
    arguments: dict[str, Any] = {
        "origins": [[0.0, 0, 0]],
        "directions": [[1.0, 0, 0]],
        "max_range_m": 5.0,
        "step_m": 0.1,
    }
    Rays(**arguments).plan(kernels, limits)
    with pytest.raises(error, match=message):
        Rays(**(arguments | changes)).plan(kernels, limits)


def test_directions_of_any_length_and_of_two_dimensions() -> None:
    kernels = scene()
    lengths = (1.0, 1e-200, 1e200)
    ranges = [cast(kernels, [[0.0, 0]], [[0.6 * s, 0.8 * s]]).mean_m[0] for s in lengths]
    np.testing.assert_allclose(ranges, ranges[0])


def test_no_rays_is_a_question_too() -> None:
    answer = cast(scene(), np.zeros((0, 3)), np.zeros((0, 3)))
    assert answer.mean_m.shape == (0,)
    assert answer.quantile_m.shape == (0, 3)
