"""What a `MapClient` asks a real server: the answers fit each other, and wrong questions are not sent."""

from __future__ import annotations

import dataclasses
import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.atoms import Atom
from potclient.client import MapClient
from potclient.errors import (
    AtomRefusedError,
    OutOfRangeError,
    UnknownAtomError,
    UnknownMapError,
    UnsupportedError,
    UsageError,
)

from .conftest import until
from .rooms import places, pose, room

PATH = np.tile(np.eye(4), (3, 1, 1))
FIELDS = ("mean", "var", "latent_mean", "latent_var", "observed")


@pytest.fixture
def client(map_client: MapClient) -> MapClient:
    """A client whose map has seen the room once."""
    map_client.integrate(room(), pose())
    return map_client


# --- points --------------------------------------------------------------------------------------------------------


def test_occupancy_is_what_the_kernels_say(client: MapClient) -> None:
    online, offline = client.occupancy(places(500)), client.params().occupancy(places(500))
    same = online.observed == offline.observed
    assert same.mean() > 0.99, "the server leaves out what is far below the threshold"
    for name, tolerance in (("mean", 1e-4), ("var", 1e-4), ("latent_mean", 1e-3), ("latent_var", 1e-2)):
        np.testing.assert_allclose(getattr(online, name)[same], getattr(offline, name)[same], atol=tolerance)
    assert online.revision == offline.revision == client.info().map_revision
    assert len(client.occupancy(np.zeros((0, 3)))) == 0
    assert client.occupancy([1.0, 2.0, 3.0]).mean.shape == (1,)


def test_gradients_come_when_asked_for(client: MapClient) -> None:
    points = 0.98 * room()[:30]
    plain, asked = client.occupancy(points), client.occupancy(points, with_gradient=True)
    assert plain.gradient is plain.latent_gradient is None
    offline = client.params().occupancy(points, gradient=True)
    for name in ("gradient", "latent_gradient"):
        online = getattr(asked, name)
        np.testing.assert_allclose(online, getattr(offline, name), atol=2e-3, rtol=1e-3)
        assert np.abs(online).max() > 0.1
    many = client.occupancy(np.tile(points, (700, 1)), with_gradient=True)
    assert many.gradient is not None
    np.testing.assert_allclose(many.gradient, np.tile(asked.gradient, (700, 1)), atol=1e-4)
    nothing = client.occupancy(np.zeros((0, 3)), with_gradient=True)
    assert nothing.gradient is not None
    assert nothing.gradient.shape == (0, 3)


def test_requests_beyond_the_limit_are_split_and_stay_in_order(client: MapClient) -> None:
    asked = client.stats().counters.get("queries.points.ok", 0)
    queries = places(22_001)
    answer = client.occupancy(queries)

    def n_asked() -> int:
        return client.stats().counters["queries.points.ok"] - asked

    until(lambda: n_asked() >= 5, "the server takes 5000 points a question")
    assert n_asked() == 5
    for first in (0, 5_000, 21_999):
        part = client.occupancy(queries[first : first + 200])
        np.testing.assert_allclose(answer.mean[first : first + 200], part.mean, atol=1e-4)
    assert answer.revisions == (answer.revision,)


def test_many_threads_share_a_client(client: MapClient) -> None:
    queries = [places(50, seed=i) for i in range(8)]
    expected = [client.occupancy(q).mean for q in queries]
    results: dict[int, Any] = {}

    def ask(i: int) -> None:
        results[i] = [client.occupancy(queries[i]).mean for _ in range(5)]

    threads = [threading.Thread(target=ask, args=(i,)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i, answers in results.items():
        for answer in answers:
            np.testing.assert_allclose(answer, expected[i], atol=1e-5)
    assert len(results) == 8


# --- grid and kernels ----------------------------------------------------------------------------------------------


def test_a_grid_is_the_occupancy_at_the_cell_centres(client: MapClient) -> None:
    progress: list[tuple[int, int]] = []
    grid = client.grid([-7, -6, -1], [7, 6, 1.2], 0.15, progress=lambda *part: progress.append(part))
    assert grid.shape == (94, 80, 15)
    n_parts = progress[-1][1]
    assert n_parts > 1, "112,800 cells are more than one part holds"
    assert progress == [(i + 1, n_parts) for i in range(n_parts)]
    np.testing.assert_allclose(grid.centers()[0, 0, 0], [-6.925, -5.925, -0.925])
    expected = client.occupancy(grid.centers().reshape(-1, 3))
    for name in FIELDS:
        np.testing.assert_allclose(getattr(grid, name).ravel(), getattr(expected, name), atol=1e-4, rtol=1e-3)
    assert grid.revision == expected.revision
    assert 0.0 < (grid.observed & (grid.mean > 0.5)).mean() < grid.observed.mean() < 1.0


@pytest.mark.parametrize(
    ("lower", "upper", "resolution"),
    [
        ([0, 0, 0], [0, 1, 1], 0.5),
        ([0, 0, 0], [1, 1, 1], 0.0),
        ([0, 0], [1, 1], 1.0),
        ([0, 0, np.nan], [1, 1, 1], 1.0),
    ],
)
def test_boxes_that_are_none_are_refused(
    map_client: MapClient, lower: Any, upper: Any, resolution: float
) -> None:
    with pytest.raises(UsageError):
        map_client.grid(lower, upper, resolution)


def test_params_of_a_box(client: MapClient) -> None:
    assert len(client.params()) == client.info().n_kernels
    inside = client.params([0, 0, -1], [8, 8, 1])
    assert 0 < len(inside) < len(client.params())
    assert (inside.hinge_mean >= [0, 0, -1]).all()


# --- rays and risk -------------------------------------------------------------------------------------------------


def test_one_origin_serves_all_rays(client: MapClient) -> None:
    directions = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0]])
    answer = client.rays([0.5, 0, 0], directions, 10.0, quantiles=[0.5])
    each = client.rays(np.tile([0.5, 0, 0], (3, 1)), directions, 10.0, quantiles=[0.5])
    np.testing.assert_array_equal(answer.mean_m, each.mean_m)
    np.testing.assert_allclose(answer.quantile_m[:, 0], [5.5, 5.0, 6.5], atol=0.8)
    assert answer.quantile_m.shape == (3, 1)
    assert (answer.quantiles, answer.revision) == ((0.5,), client.info().map_revision)
    assert len(client.rays(np.zeros((0, 3)), np.zeros((0, 3)), 10.0)) == 0


def test_risk_of_one_pose_and_one_sphere(client: MapClient) -> None:
    path = PATH.copy()
    path[:, 0, 3] = 0.0, 3.0, 6.0  # from the middle into the wall
    one = client.risk(path[2], [0, 0, 0, 0.5])
    answer = client.risk(path, [[0, 0, 0, 0.5]], unknown="prior")
    assert len(one.union_probability) == 1
    assert one.union_probability[0] > 0.9
    assert answer.union_probability[0] < 0.2 < 0.9 < answer.union_probability[2]
    assert answer.path_union_probability >= answer.path_max_probability == answer.max_probability.max()
    assert answer.resolution_m == 0.25
    assert answer.revision == client.info().map_revision
    assert answer.n_cells == 3 * 32, "the cells of three spheres of half a metre, 0.25 m wide"


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda c: c.rays(np.zeros((2, 3)), np.ones((3, 3)), 1.0), "2 origins and 3"),
        (lambda c: c.rays([0, 0, 0], [[1, 0, 0]], 0.0), "max_range_m"),
        (lambda c: c.rays([0, 0, 0], [[1, 0, 0]], 1.0, step_m=np.nan), "step_m"),
        (lambda c: c.rays([0, 0, 0], [[1, 0, 0]], 1.0, unknown="perhaps"), "occupied, free, prior"),
        (lambda c: c.rays([0, np.nan, 0], [[1, 0, 0]], 1.0), "NaN"),
        (lambda c: c.risk(np.eye(3), [[0, 0, 0, 1]]), "path"),
        (lambda c: c.risk("x", [[0, 0, 0, 1]]), "path"),
        (lambda c: c.risk(PATH, [[0, 0, 0]]), "spheres"),
        (lambda c: c.risk(PATH, [[0, 0, 0, 1]], dims=4), "dims"),
        (lambda c: c.risk(PATH, [[0, 0, 0, 1]], resolution_m=0), "resolution_m"),
        (lambda c: c.occupancy([[0, 0, 0]], timeout_s=0), "timeout_s"),
    ],
)
def test_wrong_questions_are_not_sent(map_client: MapClient, ask: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ask(map_client)


def test_the_server_s_refusals_have_their_names(client: MapClient) -> None:
    with pytest.raises(OutOfRangeError):
        client.occupancy([[1e9, 0, 0]])
    with pytest.raises(UnknownAtomError):
        client.atom("no.such.atom")
    with pytest.raises(UnsupportedError, match="no verb 'fly'"):
        client.control("fly")


# --- atoms, info, control ------------------------------------------------------------------------------------------


def test_info_stats_and_control(client: MapClient) -> None:
    info = client.info()
    assert info.server == "potserver"
    assert info.n_kernels > 0
    assert client.stats().server == client.stats("potserver").server == "potserver"
    assert client.control("clear").map_revision == info.map_revision + 1
    assert client.info().n_kernels == 0


def test_a_map_is_saved_and_loaded_by_name(client: MapClient) -> None:
    n = client.info().n_kernels
    assert client.save().verb == "save"
    assert "before-the-rain" in client.save("before-the-rain").message
    revision = client.control("clear").map_revision
    reply = client.load("before-the-rain")
    assert (reply.verb, reply.map_revision, client.info().n_kernels) == ("load", revision + 1, n)
    T = pose(40.0)
    assert client.merge("before-the-rain", T).verb == "merge"
    assert client.info().n_kernels > n
    assert np.median(client.occupancy(room()[:100] + np.array([40, 0, 0])).mean) > 0.6
    assert client.forget("r1").verb == "forget"
    with pytest.raises(UnknownMapError, match="other"):
        client.load("other")
    with pytest.raises(UsageError, match="is not an id"):
        client.save("../elsewhere")


def test_an_atom_travels_both_ways_unchanged(map_client: MapClient, tmp_path: Path) -> None:
    listed = map_client.atoms()
    fetched = map_client.atom(listed[0].atom_id)
    fetched.save(tmp_path / "wall.atom")
    with pytest.raises(AtomRefusedError) as refused:
        map_client.add_atom(fetched)
    assert refused.value.reason == "taken_id"
    made = Atom.create(
        "wall.2", fetched.hit_points.tolist(), fetched.free_points, Atom.load(tmp_path / "wall.atom").kernels,
        dims=fetched.info.dims, radius_m=fetched.info.radius_m, azimuth_width_rad=fetched.info.azimuth_width_rad,
        provenance=fetched.info.provenance,
    )  # fmt: skip
    removed = map_client.remove_atom(fetched.info.atom_id)
    try:
        added = map_client.add_atom(made)
        assert (added.atom_id, added.n_atoms) == ("wall.2", removed.n_atoms + 1)
        assert not added.persisted
        back = map_client.atom("wall.2")
        map_client.remove_atom("wall.2")
    finally:
        map_client.add_atom(fetched)
    assert back.info == made.info
    np.testing.assert_array_equal(back.hit_points, fetched.hit_points)
    np.testing.assert_array_equal(back.free_points, fetched.free_points)
    for field in dataclasses.fields(fetched.kernels):
        mine, theirs = getattr(back.kernels, field.name), getattr(fetched.kernels, field.name)
        np.testing.assert_array_equal(mine, theirs)


def test_the_text_of_a_client_says_where_it_is(map_client: MapClient) -> None:
    pattern = r"MapClient\(tcp/127\.0\.0\.1:\d+, map='default', servers: potserver\)"
    assert re.fullmatch(pattern, repr(map_client))
