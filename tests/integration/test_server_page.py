"""The page of `--web`: what it asks is what any client is told, and a browser shows it."""

from __future__ import annotations

import json
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.client import MapClient
from potclient.mesh import mesh_of
from potserver.config import load_settings
from potserver.server import MapServer

from .browser import Browser, find_browser
from .conftest import DEADLINE_S, until
from .rooms import pose, room

pytest.importorskip("starlette")


@pytest.fixture(scope="module")
def served() -> Iterator[MapServer]:
    overrides = {"web.listen": "127.0.0.1:0", "mapping.max_range_m": 12.0, "maps": ["default", "other"]}
    with MapServer(load_settings(overrides=overrides), listen="tcp/127.0.0.1:0") as server:
        yield server


@pytest.fixture
def client(served: MapServer) -> Iterator[MapClient]:
    """A client, of a map that has seen a room since the page first looked."""
    ask(served, "state")
    with MapClient(served.endpoint, timeout_s=DEADLINE_S) as client:
        client.wait_ready()
        client.control("clear")
        client.integrate(room(), pose())
        revision = client.info().map_revision
        until(lambda: any(t[3] == revision for t in ask(served, "state")["tiles"]), "the page hears of it")
        yield client


def fetch(served: MapServer, path: str, **query: Any) -> bytes:
    assert served.web is not None
    url = f"http://{served.web.address}/{path}?{urllib.parse.urlencode(query)}"
    with urllib.request.urlopen(url, timeout=DEADLINE_S) as answer:
        data: bytes = answer.read()
    return data


def ask(served: MapServer, name: str, **query: Any) -> Any:
    return json.loads(fetch(served, f"api/{name}", **query))


def refused(served: MapServer, name: str, **query: Any) -> tuple[int, str]:
    with pytest.raises(urllib.error.HTTPError) as caught:
        fetch(served, f"api/{name}", **query)
    with caught.value:
        return caught.value.code, caught.value.read().decode()


def test_points_and_rays_are_what_a_client_is_told(served: MapServer, client: MapClient) -> None:
    for x, y, z in ((1.0, 2.0, 0.0), (6.0, 0.0, 0.1), (3.0, 0.0, 30.0)):
        answer, expected = ask(served, "point", x=x, y=y, z=z), client.occupancy([[x, y, z]])
        assert answer["mean"] == pytest.approx(float(expected.mean[0]), abs=1e-6)
        assert answer["sd"] == pytest.approx(float(np.sqrt(expected.var[0])), abs=1e-6)
        assert answer["observed"] == bool(expected.observed[0])
        assert answer["revision"] == expected.revision
    assert ask(served, "point", x=1, y=2, z=0)["age_s"] >= 0
    answer = ask(served, "ray", x=0, y=0, z=0, tx=9, ty=0, tz=0)
    rays = client.rays([[0, 0, 0]], [[9, 0, 0]], 9.0)
    assert answer["mean_m"] == pytest.approx(float(rays.mean_m[0]), abs=1e-5)
    assert answer["sd_m"] == pytest.approx(float(rays.std_m[0]), abs=1e-5)
    assert answer["reach_m"] == 9.0


def test_risk_of_a_straight_way(served: MapServer, client: MapClient) -> None:
    free = ask(served, "risk", x=0, y=0, z=0, tx=3, ty=0, tz=0, radius=0.3)
    through = ask(served, "risk", x=0, y=0, z=0, tx=8, ty=0, tz=0, radius=0.3)
    assert free["length_m"] == 3.0
    assert free["union"] < 0.1 < 0.9 < through["union"]
    way = np.tile(np.eye(4), (22, 1, 1))
    way[:, 0, 3] = np.linspace(0, 3, 22)
    expected = client.risk(way, [[0, 0, 0, 0.3]], unknown="prior")
    assert free["union"] == pytest.approx(expected.path_union_probability, abs=1e-6)
    assert refused(served, "risk", x=0, y=0, z=0, tx=3, ty=0, tz=0, radius=0)[0] == 400


def test_a_tile_is_the_surface_in_it(served: MapServer, client: MapClient) -> None:
    tiles = ask(served, "state")["tiles"]
    n_faces = 0
    for x, y, z, _ in tiles:
        data = fetch(served, "api/tile", x=x, y=y, z=z)
        nv, nf = (int(n) for n in np.frombuffer(data, "<u4", 2))
        vertices = np.frombuffer(data, "<f4", 3 * nv, 8).reshape(-1, 3)
        faces = np.frombuffer(data[-12 * nf :] if nf else b"", "<u4").reshape(-1, 3)
        lower = np.array([x, y, z]) * 10.0
        mesh = mesh_of(client.grid(lower, lower + 10.25, 0.25))
        np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-5)
        np.testing.assert_array_equal(faces, mesh.faces)
        colours = np.frombuffer(data, np.uint8, 3 * nv, 8 + 12 * nv).reshape(-1, 3)
        np.testing.assert_array_equal(colours, mesh.colours)
        n_faces += nf
    assert n_faces > 100


def test_a_slice_is_a_grid(served: MapServer, client: MapClient) -> None:
    data = fetch(served, "api/slice", z=0.1)
    nx, ny = (int(n) for n in np.frombuffer(data, "<u4", 2))
    x, y, cell = (float(v) for v in np.frombuffer(data, "<f4", 3, 8))
    pixels = np.frombuffer(data, np.uint8, offset=20).reshape(ny, nx, 4)
    i, j = np.meshgrid(np.arange(nx), np.arange(ny))
    places = np.stack([x + (i + 0.5) * cell, y + (j + 0.5) * cell, np.full(i.shape, 0.1)], axis=-1)
    answer = client.occupancy(places.reshape(-1, 3))
    np.testing.assert_array_equal(pixels[:, :, 3].ravel() > 0, answer.observed)
    shade = 255 * (1 - answer.mean)
    assert np.abs(pixels[:, :, 0].ravel() - shade).max() <= 0.6


def test_what_changes_is_seen(served: MapServer, client: MapClient) -> None:
    before = {tuple(t[:3]): t[3] for t in ask(served, "state")["tiles"]}
    client.publish(room(), pose(20.0), robot="r7")
    client.flush()
    revision = client.info().map_revision
    state = until(
        lambda: (s := ask(served, "state"))["robots"].get("r7", {}).get("status")
        and any(t[3] == revision for t in s["tiles"]) and s,
        "the cloud and its receipt",
    )  # fmt: skip
    changed = {tuple(t[:3]) for t in state["tiles"] if t[3] == revision}
    assert changed - set(before), "new tiles"
    assert state["robots"]["r7"]["pose"][3::4] == [20.0, 0.0, 0.0]
    assert state["stats"]["counters"]["clouds.accepted"] >= 2
    client.control("clear")
    state = until(lambda: (s := ask(served, "state"))["cleared_at"] > revision and s, "an empty map")
    assert state["tiles"] == []


def test_what_is_wrong_is_said(served: MapServer, client: MapClient) -> None:
    assert refused(served, "point", x=1, y=2) == (400, "'z'\n")
    assert refused(served, "point", x=1, y=2, z="nan")[0] == 400
    assert refused(served, "tile", x=1, y=2, z="a")[0] == 400
    code, text = refused(served, "state", map="elsewhere")
    assert (code, text) == (400, "no map 'elsewhere' here; there are default, other\n")
    assert ask(served, "state", map="other")["tiles"] == []
    code, text = refused(served, "slice", z=1, map="other")
    assert code == 503
    assert "the map is empty" in text
    assert refused(served, "point", x=1e9, y=0, z=0)[0] == 503, "the server refuses it"


WIDTH, HEIGHT, PAGE_S = 800, 500, 120.0
RIGHT_ARROW = ("ArrowRight", 39)
INSIDE = ((170, 180), (250, 240))  # pixels where the slice is


@pytest.fixture
def browser(served: MapServer, client: MapClient, tmp_path: Path) -> Iterator[Browser]:
    """A page that shows all tiles of the map, and the slice in the middle of it, which is easy to hit."""
    program = find_browser()
    if program is None:
        pytest.skip("no chromium here")
    assert served.web is not None
    with Browser(program, tmp_path, WIDTH, HEIGHT, PAGE_S) as browser:
        browser.open(f"http://{served.web.address}/?ask=5.9,0.2,0.1")
        until(lambda: answer_in(browser), "the point of the address", PAGE_S)
        browser.evaluate("document.getElementById('cut').click()")
        until(lambda: told(browser, "slice"), "the slice", PAGE_S)
        yield browser


def told(browser: Browser, name: str) -> Any:
    """What the page keeps for tests."""
    text = browser.evaluate(f"document.body?.dataset.{name}")
    return None if text is None else json.loads(text)


def answer_in(browser: Browser) -> Any:
    return told(browser, "answer")


def answer_after(browser: Browser, *places: tuple[int, int]) -> Any:
    """The answer that clicks at these pixels bring."""
    before = answer_in(browser)
    for place in places:
        browser.click(*place)
    return until(lambda: (a := answer_in(browser)) != before and a, "the answer to the clicks", PAGE_S)


def choose(browser: Browser, tool: str) -> None:
    browser.evaluate(f"document.querySelector('[value={tool}]').click()")


def test_a_browser_draws_the_map_and_a_click_asks_it(
    served: MapServer, client: MapClient, browser: Browser
) -> None:
    asked = answer_in(browser)
    assert asked["point"] == [5.9, 0.2, 0.1]
    n_tiles = len(ask(served, "state")["tiles"])
    assert browser.evaluate("document.body.dataset.tiles") == str(n_tiles) != "0"
    assert told(browser, "revision") == client.info().map_revision
    clicked = answer_after(browser, INSIDE[0])
    shown = browser.evaluate("document.getElementById('answer').innerText")
    for answer in (asked, clicked):
        expected = client.occupancy([answer["point"]])
        assert answer["mean"] == pytest.approx(float(expected.mean[0]), abs=1e-6)
        assert answer["sd"] == pytest.approx(float(np.sqrt(expected.var[0])), abs=1e-6)
        assert answer["observed"] == bool(expected.observed[0])
    assert f"{clicked['mean']:.4f}" in shown


def test_two_clicks_of_the_ray_tool_are_a_ray(client: MapClient, browser: Browser) -> None:
    choose(browser, "ray")
    answer = answer_after(browser, *INSIDE)
    start, way = np.array(answer["from"]), np.array(answer["to"]) - answer["from"]
    reach_m = float(np.linalg.norm(way))
    assert reach_m > 1.0
    expected = client.rays([start], [way], reach_m)
    assert answer["reach_m"] == pytest.approx(reach_m)
    assert answer["mean_m"] == pytest.approx(float(expected.mean_m[0]), abs=1e-4)
    assert answer["sd_m"] == pytest.approx(float(expected.std_m[0]), abs=1e-4)
    assert answer["hit_probability"] == pytest.approx(float(expected.hit_probability[0]), abs=1e-5)
    shown = browser.evaluate("document.getElementById('answer').innerText")
    assert f"{answer['mean_m']:.2f} of {reach_m:.2f} m" in shown


def test_two_clicks_of_the_risk_tool_are_a_way_of_a_ball(client: MapClient, browser: Browser) -> None:
    browser.evaluate("document.getElementById('radius').value = 0.4")
    choose(browser, "risk")
    answer = answer_after(browser, *INSIDE)
    assert answer["radius"] == 0.4
    n_poses = 2 + int(answer["length_m"] / 0.2)
    way = np.tile(np.eye(4), (n_poses, 1, 1))
    way[:, :3, 3] = np.linspace(answer["from"], answer["to"], n_poses)
    expected = client.risk(way, [[0, 0, 0, 0.4]], unknown="prior")
    assert answer["max"] == pytest.approx(expected.path_max_probability, abs=1e-6)
    assert answer["union"] == pytest.approx(expected.path_union_probability, abs=1e-6)
    shown = browser.evaluate("document.getElementById('answer').innerText")
    assert f"{answer['union']:.4f}" in shown


def test_the_slider_moves_the_slice(served: MapServer, client: MapClient, browser: Browser) -> None:
    first = told(browser, "slice")
    browser.evaluate("document.getElementById('z').focus()")
    browser.press(*RIGHT_ARROW)
    second = until(lambda: (s := told(browser, "slice"))["z"] != first["z"] and s, "the next slice", PAGE_S)
    assert second["z"] == pytest.approx(first["z"] + 0.05)
    assert browser.evaluate("document.getElementById('height').innerText") == f"{second['z']:.2f}"
    for shown in (first, second):
        data = fetch(served, "api/slice", z=shown["z"])  # proved against `occupancy` above
        assert shown["shape"] == np.frombuffer(data, "<u4", 2).tolist()
        assert shown["sum"] == np.frombuffer(data, np.uint8, offset=20).sum(dtype=int)
