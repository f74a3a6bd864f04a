"""Rays, risk and exports on the client's side: what is sent, what is refused, what the commands print."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.cli import main
from potclient.client import MapClient
from potclient.errors import BadReplyError, TooLargeError, UsageError
from potschemas import messages
from potschemas.messages import ErrorCode
from tests.integration.fake_server import FakeServer

PATH = np.tile(np.eye(4), (3, 1, 1))


@pytest.fixture(scope="module")
def server() -> Iterator[FakeServer]:
    with FakeServer() as server:
        server.points = np.random.default_rng(0).uniform(-2, 2, (40, 3))
        server.revision = 5
        yield server


@pytest.fixture
def client(server: FakeServer) -> Iterator[MapClient]:
    server.script.fail_once.clear()
    server.script.fail.clear()
    server.script.garbage.clear()
    with MapClient(server.endpoint) as client:
        client.wait_ready()
        yield client


@pytest.fixture
def run(server: FakeServer, capsys: pytest.CaptureFixture[str]) -> Any:
    def command(*words: str) -> tuple[int, str, str]:
        status = main([*words, "-e", server.endpoint])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return command


def test_gradients_come_when_asked_for(client: MapClient) -> None:
    points = np.random.default_rng(1).uniform(-2, 2, (30, 3))
    plain, asked = client.occupancy(points), client.occupancy(points, with_gradient=True)
    assert plain.gradient is plain.latent_gradient is None
    offline = client.params().occupancy(points, gradient=True)
    assert asked.gradient is not None
    assert asked.latent_gradient is not None
    np.testing.assert_allclose(asked.gradient, offline.gradient, atol=1e-5)
    np.testing.assert_allclose(asked.latent_gradient, offline.latent_gradient, atol=1e-5)
    many = client.occupancy(np.tile(points, (700, 1)), with_gradient=True)
    assert many.gradient is not None
    np.testing.assert_allclose(many.gradient, np.tile(asked.gradient, (700, 1)), atol=1e-6)
    nothing = client.occupancy(np.zeros((0, 3)), with_gradient=True)
    assert nothing.gradient is not None
    assert nothing.gradient.shape == (0, 3)


def test_a_server_that_knows_no_gradients_is_told_of(client: MapClient, monkeypatch: Any) -> None:
    encode = FakeServer._occupancy
    monkeypatch.setattr(FakeServer, "_occupancy", lambda self, points, _=False: encode(self, points))
    with pytest.raises(BadReplyError, match="older"):
        client.occupancy([[0.0, 0, 0]], with_gradient=True)


def test_one_origin_serves_all_rays(client: MapClient) -> None:
    answer = client.rays([3.0, 0, 0], np.eye(3), 10.0, quantiles=[0.5])
    np.testing.assert_array_equal(answer.mean_m, [4, 4, 4])
    assert answer.quantile_m.shape == (3, 1)
    assert (answer.quantiles, answer.revision) == ((0.5,), 5)
    assert len(client.rays(np.zeros((0, 3)), np.zeros((0, 3)), 10.0)) == 0


def test_rays_that_are_too_many_are_halved(server: FakeServer, client: MapClient) -> None:
    server.script.fail_once["rays"] = [ErrorCode.TOO_LARGE, ErrorCode.TOO_LARGE]
    asked = server.queries.count("rays")
    origins = np.arange(30.0).reshape(10, 3)
    answer = client.rays(origins, np.ones((10, 3)), 10.0)
    np.testing.assert_array_equal(answer.mean_m, origins[:, 0] + 1)
    assert server.queries.count("rays") - asked == 2 + 5, "10, 5, then twos"
    server.script.fail["rays"] = ErrorCode.TOO_LARGE
    with pytest.raises(TooLargeError):
        client.rays(origins, np.ones((10, 3)), 10.0)


def test_risk_of_one_pose_and_one_sphere(client: MapClient) -> None:
    one = client.risk(np.eye(4), [0, 0, 0, 0.5])
    assert len(one.union_probability) == 1
    answer = client.risk(PATH, [[0, 0, 0, 0.5]], unknown="prior")
    np.testing.assert_allclose(answer.union_probability, [0, 0.1, 0.2])
    assert (answer.path_max_probability, answer.path_union_probability) == (0.25, 0.5)
    assert (answer.n_cells, answer.revision) == (100, 5)


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
    ],
)
def test_wrong_questions_are_not_sent(client: MapClient, ask: Any, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ask(client)


def test_replies_that_do_not_fit_are_refused(client: MapClient, monkeypatch: Any) -> None:
    none = messages.Array(dtype=messages.DType.FLOAT32, shape=[0], data=b"")
    rays = FakeServer._reply_rays
    monkeypatch.setattr(
        FakeServer,
        "_reply_rays",
        lambda self, payload: [messages.msgspec.structs.replace(rays(self, payload)[0], mean_m=none)],
    )
    with pytest.raises(BadReplyError, match="mean_m"):
        client.rays([0, 0, 0], [[1, 0, 0]], 1.0)
    risk = FakeServer._reply_risk
    monkeypatch.setattr(
        FakeServer,
        "_reply_risk",
        lambda self, payload: [messages.msgspec.structs.replace(risk(self, payload)[0], unknown_share=none)],
    )
    with pytest.raises(BadReplyError, match="unknown_share"):
        client.risk(PATH, [[0, 0, 0, 1]])


CORNERS = ("--lower", "-2", "-2", "-2", "--upper", "2", "2", "2")


# --- commands ------------------------------------------------------------------------------------------------------


def test_query_with_gradients(run: Any) -> None:
    status, out, _ = run("query", "0", "0", "0", "--gradient")
    assert status == 0
    assert "dP/dx" in out
    status, out, _ = run("query", "0", "0", "0", "--gradient", "--json", "-")
    assert len(json.loads(out)["gradient"][0]) == 3


def test_rays_all_around_and_toward(run: Any, tmp_path: Path) -> None:
    status, out, _ = run("rays", "2", "0", "1", "--fan", "4", "-o", str(tmp_path / "r.npz"))
    assert status == 0
    assert len(out.splitlines()) == 6
    with np.load(tmp_path / "r.npz") as saved:
        assert saved["quantile_m"].shape == (4, 3)
        np.testing.assert_allclose(saved["mean_m"], 3.0)
    status, out, _ = run("rays", "2", "0", "1", "--toward", "1", "0", "0", "--json", "-")
    tree = json.loads(out)
    assert (tree["mean_m"], tree["unknown_range_m"]) == ([3.0], [None])
    np.save(tmp_path / "rays.npy", np.ones((3, 6)))
    status, out, _ = run("rays", "--file", str(tmp_path / "rays.npy"), "--quantiles", "0.5")
    assert status == 0
    assert "q0.5 m" in out


@pytest.mark.parametrize("row", ["1 2 3", "1 2 3 0.5", "1 0 0 1 0 1 0 2 0 0 1 3"])
def test_risk_of_a_path_in_a_file(run: Any, tmp_path: Path, row: str) -> None:
    (tmp_path / "path.txt").write_text(f"{row}\n{row}\n")
    status, out, _ = run("risk", "--path", str(tmp_path / "path.txt"), "--sphere", "0", "0", "0", "0.3")
    assert status == 0
    assert "union 0.5000" in out
    assert "1.00  2.00  3.00" in out
    status, out, _ = run(
        "risk", "--path", str(tmp_path / "path.txt"), "--sphere", "0", "0", "0", "0.3", "--json", "-"
    )
    np.testing.assert_allclose(json.loads(out)["union_probability"], [0, 0.1], atol=1e-6)


@pytest.mark.parametrize("kind", ["ply", "npz", "pgm", "bt"])
def test_export_writes_each_kind(run: Any, tmp_path: Path, kind: str) -> None:
    cells = [*CORNERS, "--resolution", "0.5"]
    grid = {"pgm": [*cells, "--band", "0", "1"], "bt": cells}.get(kind, [])
    status, out, err = run("export", kind, "-o", str(tmp_path / f"map.{kind}"), *grid)
    assert (status, err) == (0, "")
    assert "revision 5" in out
    expected = {f"map.{kind}"} | ({"map.yaml"} if kind == "pgm" else set())
    assert {p.name for p in tmp_path.iterdir()} == expected


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rays"], "give the origin"),
        (["rays", "1", "2"], "need X Y Z"),
        (["rays", "1", "2", "3", "--fan", "0"], "--fan"),
        (["rays", "1", "2", "3", "--max-range", "5", "--quantiles", "0.9", "0.5"], "ascending"),
        (["rays", "--file", "absent.npy"], "absent"),
        (["risk", "--path", "absent.txt", "--sphere", "0", "0", "0", "1"], "absent"),
        (["export", "bt", "-o", "x"], "--resolution"),
        (["export", "pgm", "-o", "x", "--resolution", "1"], "the map is empty"),
        (["export", "pgm", "-o", "x", "--resolution", "1", *CORNERS], "--band"),
        (["export", "ply", "-o", "x", "--resolution", "1"], "no cells"),
        (["export", "bt", "-o", "x", "--resolution", "1", "--band", "0", "1"], "--lower"),
    ],
)
def test_mistakes_are_one_clear_line(run: Any, words: list[str], message: str) -> None:
    status, out, err = run(*words)
    assert status in (1, 2)
    assert out == ""
    assert message in err
    assert len(err.splitlines()) == 1
