"""The risk of a path: against a count of cells by hand, against worlds with a formula, and what must never shrink."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from potschemas.answers import AnswerRule
from potserver.asking.risk import PART_CELLS, PathRisk, Risk
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet, Unknown
from potserver.errors import BadPointsError, BadPoseError, OutOfRangeError, ShapeError, TooLargeError
from potserver.limits import Limits
from potserver.numerics.lattice import covered_cells, most_cells

Array = np.ndarray[Any, Any]
CUT = 1e-4  # by so little a probability may depend on what is asked together: the kernels' cut


def assess(
    kernels: KernelMap, path: Any, spheres: Any, *, part_cells: int = PART_CELLS, **options: Any
) -> PathRisk:
    plan = Risk(path, spheres, **options).plan(kernels, Limits(), part_cells=part_cells)
    return plan.result(plan.parts())


def scene(seed: int = 0, k: int = 250) -> KernelMap:
    rng = np.random.default_rng(seed)
    return KernelMap.from_arrays(
        rng.uniform(-4, 4, (k, 3)),
        rng.uniform(0.5, 3.0, k),
        rng.normal(-2.0, 2.0, k),
        rng.uniform(0.1, 2.0, k),
        rule=AnswerRule(residual_var=10.0),
        threads=1,
    )


def constant(weight: float) -> KernelMap:
    return KernelMap.from_arrays([[0.0, 0, 0]], [1e-9], [weight], [0.0])


def poses(*positions: Any, yaw_rad: float = 0.0) -> Array:
    path = np.tile(np.eye(4), (len(positions), 1, 1))
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    path[:, :2, :2] = [[cos, -sin], [sin, cos]]
    path[:, :3, 3] = positions
    return path


BODY = np.array([[0.4, 0.0, 0.2, 0.5], [-0.3, 0.1, 0.0, 0.3]])


def cells_by_hand(path: Array, spheres: Array, edge: float, dims: int = 3) -> list[set[tuple[int, ...]]]:
    """Of each pose: all cells near the robot, one by one."""
    covered = []
    for pose in path:
        cells = set()
        for sphere in spheres:
            centre = pose[:3, :3] @ sphere[:3] + pose[:3, 3]
            n = int(sphere[3] / edge) + 2
            home = tuple(math.floor(c / edge) for c in centre)
            for offset in itertools.product(range(-n, n + 1), repeat=dims):
                cell = tuple(h + o for h, o in zip(home, offset, strict=False))
                away = [(c + 0.5) * edge - x for c, x in zip(cell, centre, strict=False)]
                if cell == home[:dims] or math.hypot(*away) <= sphere[3]:
                    cells.add((*cell, 0)[:3])
        covered.append(cells)
    return covered


@pytest.mark.parametrize("unknown", list(Unknown))
@pytest.mark.parametrize(("dims", "correlation_m"), [(3, 0.8), (3, None), (2, 0.8)])
def test_risk_is_the_count_by_hand(unknown: Unknown, dims: int, correlation_m: float | None) -> None:
    kernels = scene()
    path = poses((0.0, 0, 0), (1.1, 0.7, 0.2), (4.7, 4.5, 4.3), yaw_rad=0.7)
    edge = 0.17
    answer = assess(
        kernels, path, BODY, unknown=unknown, resolution_m=edge, dims=dims, correlation_m=correlation_m
    )
    covered = cells_by_hand(path, BODY, edge, dims)
    assumed = {Unknown.OCCUPIED: 1.0, Unknown.FREE: 0.0, Unknown.PRIOR: 0.5}[unknown]

    def by_hand(cells: set[tuple[int, ...]]) -> tuple[float, float, float]:
        points = (np.array(sorted(cells)) + 0.5) * edge
        if dims == 2:
            points[:, 2] = 0.0
        o = kernels.occupancy(points)
        p = np.where(o.observed, o.mean, assumed)
        c: Any = correlation_m
        if correlation_m is None:
            c = np.where(o.observed, kernels.widths(points), kernels.typical_width_m)
        with np.errstate(divide="ignore"):
            free = np.prod((1 - p) ** ((edge / c) ** dims))
        return p.max(), max(p.max(), 1 - free), 1 - o.observed.mean()

    for i, cells in enumerate(covered):
        highest, union, share = by_hand(cells)
        assert answer.max_probability[i] == pytest.approx(highest, abs=1e-4)
        assert answer.union_probability[i] == pytest.approx(union, abs=1e-3)
        assert answer.unknown_share[i] == pytest.approx(share, abs=0.01)
    whole = set().union(*covered)
    highest, union, share = by_hand(whole)
    assert answer.n_cells == len(whole)
    assert answer.path_max_probability == pytest.approx(highest, abs=1e-4)
    assert answer.path_union_probability == pytest.approx(union, abs=1e-3)
    assert answer.path_unknown_share == pytest.approx(share, abs=0.01)
    assert 0 < share < 1, "some of it is known, some not"


def test_widths_are_those_of_the_kernels_there() -> None:
    kernels = KernelMap.from_arrays([[0.0, 0, 0], [50.0, 0, 0]], [1.0, 0.25], [1.0, 1.0], [0.1, 0.1])
    narrow, wide = math.sqrt(math.pi / 2), math.sqrt(math.pi / 0.5)
    widths = kernels.widths(np.array([[0.3, 0, 0], [50.5, 0, 0], [1000.0, 0, 0]]))
    np.testing.assert_allclose(widths, [narrow, wide, (narrow + wide) / 2], rtol=1e-5)


@pytest.mark.parametrize("edge", [0.2, 0.1, 0.05])
def test_the_union_depends_on_the_volume_and_not_on_the_cells(edge: float) -> None:
    answer = assess(
        constant(-3.0), poses((0.0, 0, 0)), [[0, 0, 0, 1.0]], resolution_m=edge, correlation_m=0.5
    )
    p = 1 / (1 + math.exp(3.0))
    volume = 4 / 3 * math.pi
    expected = 1 - (1 - p) ** (volume / 0.5**3)
    assert answer.union_probability[0] == pytest.approx(expected, rel=0.03)
    assert answer.max_probability[0] == pytest.approx(p, rel=1e-4)


def test_a_robot_smaller_than_the_correlation_is_one_trial() -> None:
    answer = assess(constant(-1.0), poses((0.0, 0, 0)), [[0, 0, 0, 0.1]], correlation_m=5.0)
    assert answer.union_probability[0] == answer.max_probability[0] == answer.path_union_probability


def test_standing_still_adds_no_risk() -> None:
    once, often = (
        assess(scene(), poses(*[(0.5, 0.5, 0.0)] * n), BODY, unknown=Unknown.PRIOR) for n in (1, 5)
    )
    assert often.path_union_probability == once.path_union_probability
    assert often.n_cells == once.n_cells
    np.testing.assert_array_equal(often.union_probability, np.full(5, once.union_probability[0]))


@pytest.mark.parametrize("unknown", list(Unknown))
@pytest.mark.parametrize("seed", range(4))
def test_more_robot_is_no_less_risk(unknown: Unknown, seed: int) -> None:
    rng = np.random.default_rng(seed)
    kernels, path = scene(seed), poses(*rng.uniform(-2, 2, (4, 3)))
    options: dict[str, Any] = {"unknown": unknown, "resolution_m": 0.21, "correlation_m": 0.6}
    smaller = BODY * [1, 1, 1, rng.uniform(0.1, 0.9)]
    for less, more in (
        (assess(kernels, path, smaller, **options), assess(kernels, path, BODY, **options)),
        (assess(kernels, path, BODY[:1], **options), assess(kernels, path, BODY, **options)),
    ):
        assert (more.max_probability >= less.max_probability - CUT).all()
        assert (more.union_probability >= less.union_probability - CUT).all()
        assert more.path_union_probability >= less.path_union_probability - CUT
    whole, start = assess(kernels, path, BODY, **options), assess(kernels, path[:2], BODY, **options)
    assert whole.path_max_probability >= start.path_max_probability - CUT
    assert whole.path_union_probability >= start.path_union_probability - CUT
    assert whole.path_union_probability >= whole.union_probability.max()


def test_what_is_unknown_counts_as_it_is_told() -> None:
    nothing = KernelMap(KernelSet.empty(), map_revision=4)
    free, prior, occupied = (
        assess(nothing, poses((0.0, 0, 0)), [[0, 0, 0, 0.5]], unknown=unknown)
        for unknown in (Unknown.FREE, Unknown.PRIOR, Unknown.OCCUPIED)
    )
    assert (free.path_max_probability, free.path_union_probability) == (0.0, 0.0)
    assert prior.path_max_probability == 0.5
    assert prior.path_union_probability >= 0.5
    assert (occupied.path_max_probability, occupied.path_union_probability) == (1.0, 1.0)
    assert occupied.path_unknown_share == 1.0
    assert occupied.map_revision == 4


def test_parts_do_not_matter() -> None:
    whole = assess(scene(), poses((0.0, 0, 0), (1.0, 0, 0)), BODY)
    parts = assess(scene(), poses((0.0, 0, 0), (1.0, 0, 0)), BODY, part_cells=37)
    np.testing.assert_allclose(parts.union_probability, whole.union_probability, atol=1e-4)
    assert parts.path_union_probability == pytest.approx(whole.path_union_probability, abs=1e-4)


def test_no_poses_is_a_question_too() -> None:
    answer = assess(scene(), np.zeros((0, 4, 4)), BODY)
    assert answer.max_probability.shape == (0,)
    assert (answer.path_max_probability, answer.path_union_probability, answer.n_cells) == (0.0, 0.0, 0)


@pytest.mark.parametrize("dims", [2, 3])
def test_no_robot_covers_more_cells_than_are_counted_on(dims: int) -> None:
    rng = np.random.default_rng(dims)
    for _ in range(50):
        radii, edge = rng.uniform(0.01, 2.0, 2), rng.uniform(0.1, 1.0)
        _, cells = covered_cells(rng.uniform(-3, 3, (1, 2, 3)), radii, edge, dims)
        assert len(cells) <= most_cells(radii, edge, dims)


def _tilted() -> Array:
    pose = poses((0.0, 0, 0))
    pose[0, 0, 0] = 1.1
    return pose


class SmallRobots(Limits):
    max_query_poses = 3
    max_query_spheres = 5


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"path": np.eye(4)}, ShapeError, "path"),
        ({"path": _tilted()}, BadPoseError, "rigid|rotation|orthonormal"),
        ({"path": poses((np.nan, 0, 0))}, BadPoseError, "."),
        ({"path": poses((2.5e7, 0, 0))}, OutOfRangeError, "limit"),
        ({"path": poses(*[(0.0, 0, 0)] * 4)}, TooLargeError, "4 poses"),
        ({"spheres": [[0, 0, 0]]}, ShapeError, "spheres"),
        ({"spheres": np.zeros((0, 4))}, ShapeError, "at least 1"),
        ({"spheres": [[0, 0, 0, 0.0]]}, BadPointsError, "radii"),
        ({"spheres": [[0, np.nan, 0, 1.0]]}, BadPointsError, "finite"),
        ({"spheres": [[0, 0, 0, 1.0]] * 6}, TooLargeError, "6 spheres"),
        ({"dims": 4}, BadPointsError, "dims"),
        ({"resolution_m": 0.0}, BadPointsError, "resolution_m"),
        ({"resolution_m": 0.01}, TooLargeError, "resolution_m"),
        ({"resolution_m": 1e-300}, TooLargeError, "resolution_m"),
        ({"correlation_m": -1.0}, BadPointsError, "correlation_m"),
        ({"path": poses((-9e6, 0, 0), (9e6, 0, 0))}, TooLargeError, "along an axis"),
    ],
)
def test_bad_questions(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    kernels, limits = scene(), SmallRobots(max_query_samples=5000)
    arguments: dict[str, Any] = {"path": poses((0.0, 0, 0)), "spheres": [[0, 0, 0, 0.5]]}
    Risk(**arguments).plan(kernels, limits)
    with np.errstate(over="ignore"), pytest.raises(error, match=message):
        Risk(**(arguments | changes)).plan(kernels, limits)
