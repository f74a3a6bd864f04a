"""`potclient view` and `export rrd` against a server: what Rerun gets is what the map and its robots say."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.client import MapClient
from potclient.errors import UsageError
from potclient.view.live import LiveView
from potclient.view.picture import MapPicture
from potclient.watched import WatchedCloud
from potserver.server import MapServer

from .conftest import Run, until
from .rooms import pose, room

pytest.importorskip("rerun")


class HeardPicture(MapPicture):
    """Remembers, beside the recording, what was drawn."""

    def __init__(self) -> None:
        super().__init__("test")
        self.tiles: dict[Any, Any] = {}
        self.clouds: list[WatchedCloud] = []
        self.n_receipts = self.n_stats = self.n_forgotten = 0

    def draw_tile(self, tile: Any, grid: Any) -> None:
        self.tiles[tile] = grid
        super().draw_tile(tile, grid)

    def forget_tiles(self) -> None:
        self.tiles.clear()
        self.n_forgotten += 1
        super().forget_tiles()

    def draw_cloud(self, cloud: WatchedCloud) -> bool:
        self.clouds.append(cloud)
        return super().draw_cloud(cloud)

    def draw_receipt(self, receipt: Any) -> None:
        self.n_receipts += 1
        super().draw_receipt(receipt)

    def draw_stats(self, stats: Any, map_id: str) -> None:
        self.n_stats += 1
        super().draw_stats(stats, map_id)


@contextlib.contextmanager
def viewing(server: MapServer, picture: MapPicture) -> Iterator[LiveView]:
    """A view on a thread and a session of its own."""
    end = threading.Event()
    with MapClient(server.endpoint) as client:
        client.wait_ready()
        view = LiveView(client, picture, 0.5)
        thread = threading.Thread(target=view.run, args=(end,))
        thread.start()
        try:
            yield view
        finally:
            end.set()
            thread.join()


def entities_of(recording: Path) -> set[str]:
    """The entities in a recording, as Rerun's own program lists them."""
    program = Path(sys.executable).with_name("rerun")
    told = subprocess.run(
        [program, "rrd", "stats", str(recording)], capture_output=True, text=True, timeout=120, check=True
    )
    return {line.split(": ")[0] for line in told.stdout.splitlines() if line.startswith("/")}


def test_a_view_follows_the_map_and_its_robots(
    map_server: MapServer, map_client: MapClient, tmp_path: Path
) -> None:
    map_client.integrate(room(), pose())
    picture = HeardPicture()
    picture.save(tmp_path / "live.rrd")
    with viewing(map_server, picture) as view:
        first = map_client.info().map_revision
        until(lambda: view.drawn_revision == first, "the map that was there before")
        before = dict(picture.tiles)
        assert any(grid.observed.any() for grid in before.values())
        points = room().astype(np.float32)
        seq = map_client.publish(points, pose(20.0), robot="r7")
        map_client.flush()
        until(lambda: view.drawn_revision == first + 1 and picture.n_receipts, "what the cloud changed")
        assert [(cloud.robot, cloud.seq) for cloud in picture.clouds] == [("r7", seq)]
        np.testing.assert_array_equal(picture.clouds[0].points, points)
        np.testing.assert_allclose(picture.clouds[0].T_map_sensor, pose(20.0))
        new = set(picture.tiles) - set(before)
        assert new, "the robot was elsewhere"
        for tile in new:
            grid = picture.tiles[tile]
            now = map_client.grid(grid.lower, grid.lower + np.array(grid.shape) * 0.5, 0.5)
            np.testing.assert_allclose(grid.mean, now.mean, atol=1e-6)
        until(lambda: picture.n_stats, "counters, once a second")
        map_client.control("clear")
        until(lambda: picture.n_forgotten, "the map is empty")
        assert not picture.tiles
    picture.close()
    found = entities_of(tmp_path / "live.rrd")
    assert {"/robots/r7/scan", "/robots/r7/way", "/robots_ms/r7", "/queues/clouds.depth"} <= found
    for layer in ("surface", "free", "unknown"):
        assert any(name.startswith(f"/map/{layer}/") for name in found)


def test_clouds_without_a_pose_are_counted(map_server: MapServer, map_client: MapClient) -> None:
    picture = HeardPicture()
    with viewing(map_server, picture) as view:
        first = map_client.info().map_revision
        until(lambda: view.drawn_revision == first, "an empty map")
        map_client.publish(room(), None, robot="r1")
        until(lambda: view.n_unplaced == 1, "the cloud")
        until(lambda: picture.n_receipts == 1, "its receipt, which says no")
    assert view.n_clouds == 0


def test_the_command_records_and_a_map_is_exported(
    run_at: Run, map_server: MapServer, map_client: MapClient, tmp_path: Path
) -> None:
    status, _, err = run_at(
        map_server.endpoint, "export", "rrd", "--resolution", "0.5", "-o", str(tmp_path / "map.rrd")
    )
    assert status == 2
    assert "the map is empty" in err
    map_client.integrate(room(), pose())
    out = {}
    for name, words in {
        "live.rrd": ("view", "--save", str(tmp_path / "live.rrd"), "--resolution", "0.5", "--seconds", "1"),
        "map.rrd": ("export", "rrd", "--resolution", "0.5", "-o", str(tmp_path / "map.rrd")),
    }.items():
        status, out[name], _ = run_at(map_server.endpoint, *words)
        assert status == 0
    assert "tiles and 0 clouds drawn" in out["live.rrd"]
    assert any(name.startswith("/map/surface/") for name in entities_of(tmp_path / "map.rrd"))
    assert {path.name for path in tmp_path.iterdir()} == {"live.rrd", "map.rrd"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("view", "--save", "x.mp4"), "ends in .rrd"),
        (("export", "rrd", "-o", "x.mcap", "--resolution", "1"), "writes .rrd"),
        (("export", "rrd", "-o", "x.rrd", "--resolution", "1", "--lower", "0", "0", "0"), "whole tiles"),
        (("export", "rrd", "-o", "x.rrd"), "--resolution"),
    ],
)
def test_mistakes_are_said(run_at: Run, map_server: MapServer, words: tuple[str, ...], message: str) -> None:
    status, _, err = run_at(map_server.endpoint, *words)
    assert status == 2
    assert message in err


def test_the_view_says_which_package_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match="potserver\\[view\\]"):
        MapPicture("none")
