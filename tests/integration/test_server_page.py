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


def test_a_browser_draws_the_map_and_a_click_asks_it(
    served: MapServer, client: MapClient, tmp_path: Path
) -> None:
    program = find_browser()
    if program is None:
        pytest.skip("no chromium here")
    assert served.web is not None
    width, height = 800, 500

    def answer_in(browser: Browser) -> Any:
        text = browser.evaluate("document.body?.dataset.answer")
        return None if text is None else json.loads(text)

    with Browser(program, tmp_path, width, height, 120.0) as browser:
        browser.open(f"http://{served.web.address}/?ask=5.9,0.2,0.1")
        asked = until(lambda: answer_in(browser), "the point of the address", 120.0)
        assert asked["point"] == [5.9, 0.2, 0.1]
        n_tiles = len(ask(served, "state")["tiles"])
        assert browser.evaluate("document.body.dataset.tiles") == str(n_tiles) != "0"
        browser.evaluate("document.getElementById('cut').click()")
        until(lambda: browser.evaluate("document.body?.dataset.slices"), "the slice", 120.0)
        browser.click(width // 3, height // 2)
        clicked = until(
            lambda: (a := answer_in(browser)) and a["point"] != asked["point"] and a, "the click", 120.0
        )
        shown = browser.evaluate("document.getElementById('answer').innerText")
    for answer in (asked, clicked):
        expected = client.occupancy([answer["point"]])
        assert answer["mean"] == pytest.approx(float(expected.mean[0]), abs=1e-6)
        assert answer["sd"] == pytest.approx(float(np.sqrt(expected.var[0])), abs=1e-6)
        assert answer["observed"] == bool(expected.observed[0])
    assert f"{clicked['mean']:.4f}" in shown
