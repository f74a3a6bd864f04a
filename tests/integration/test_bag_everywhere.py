"""A stranger's bag of PointCloud2 and tf, written by rosbags: it maps as the folder it was made of, and is seen everywhere."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.cli import main
from potclient.client import MapClient
from potclient.datasets import Recording, open_dataset
from potclient.ros import types
from potserver.config import load_settings
from potserver.server import MapServer
from tests.ros.bags import EchoesOnly, bag_of

from .browser import Browser, find_browser
from .conftest import DEADLINE_S, until
from .ros_strangers import Stranger
from .test_client_view import entities_of
from .test_ros_out import expected_grid

pytest.importorskip("rerun")
MAX_RANGE_M, HOLD_OUT = 15.0, ("--max-range", "15", "--hold-out", "0.2", "-q")


@pytest.fixture
def server() -> Iterator[MapServer]:
    overrides = {
        "web.listen": "127.0.0.1:0", "ros.out": "/", "ros.clouds": ["/points"], "ros.grid_m": 0.5, "ros.period_s": 0.1,
        "mapping.max_range_m": MAX_RANGE_M,
    }  # fmt: skip
    with MapServer(load_settings(overrides=overrides), listen="tcp/127.0.0.1:0") as server:
        yield server


@pytest.fixture(params=["kitti", "town"])
def recording(request: pytest.FixtureRequest) -> Recording:
    """Four scans of KITTI odometry 00, where the shared data are; and of a made-up street."""
    if request.param == "town":
        return EchoesOnly(open_dataset("town:terraces:vlp16:3", n_generated=4))
    shared: Callable[[str], Path] = request.getfixturevalue("shared_data")
    return open_dataset(shared("kitti_odometry_00"), poses="poses_velo_icp.txt")


def published(server: MapServer, what: str, target: Path, *more: str) -> dict[str, Any]:
    """What `potclient publish` reports of an empty map that got this."""
    words = ("publish", what, *more, *HOLD_OUT, "--clear", "--json", str(target), "-e", server.endpoint)
    assert main([*words]) == 0
    report: dict[str, Any] = json.loads(target.read_text())
    return report


@pytest.mark.slow
def test_a_bag_maps_as_its_folder_and_is_seen_in_rerun_in_the_page_and_as_a_costmap(
    server: MapServer, recording: Recording, tmp_path: Path
) -> None:
    for i, scan in enumerate(recording):
        np.save(tmp_path / f"{i}.npy", scan.points)
    rows = [" ".join(f"{v:.17g}" for v in scan.T_map_sensor[:3].ravel()) for scan in recording]
    (tmp_path / "poses.txt").write_text("\n".join(rows) + "\n")
    bag_of(recording, tmp_path / "bag")
    folder = published(server, str(tmp_path), tmp_path / "folder.json")
    bag = published(server, str(tmp_path / "bag"), tmp_path / "bag.json", "--topic", "/points", "--tf")
    assert bag["counts"]["accepted"] == folder["counts"]["accepted"] == len(recording)
    for score, close in (("nll", 0.005), ("auc", 0.002), ("ece", 0.005)):
        assert bag["held_out"][score] == pytest.approx(folder["held_out"][score], abs=close)
    assert bag["held_out"]["auc"] > 0.95

    with MapClient(server.endpoint, timeout_s=DEADLINE_S) as client:
        client.wait_ready()
        revision = client.info().map_revision
        see_in_rerun(server, tmp_path)
        see_in_the_page(server, revision, tmp_path)
        see_as_a_costmap(server, client)


def see_in_rerun(server: MapServer, folder: Path) -> None:
    words = ("export", "rrd", "--resolution", "0.5", "-o", str(folder / "map.rrd"), "-q")
    assert main([*words, "-e", server.endpoint]) == 0
    shown = entities_of(folder / "map.rrd")
    for layer in ("surface", "free", "unknown"):
        assert sum(name.startswith(f"/map/{layer}/") for name in shown) > 3


def see_in_the_page(server: MapServer, revision: int, folder: Path) -> None:
    assert server.web is not None
    address = f"http://{server.web.address}"
    with urllib.request.urlopen(f"{address}/api/state", timeout=DEADLINE_S) as answer:
        state = json.loads(answer.read())
    assert max(tile[3] for tile in state["tiles"]) == revision
    program = find_browser()
    if program is None:
        return  # no chromium here: the page was asked what it would show
    with Browser(program, folder / "profile", 800, 500, 120.0) as browser:
        browser.open(address)
        n_tiles = str(len(state["tiles"]))
        until(lambda: browser.evaluate("document.body?.dataset.tiles") == n_tiles, "all tiles", 120.0)


def see_as_a_costmap(server: MapServer, client: MapClient) -> None:
    """The grid that a stranger's subscriber gets is what one dense question is told."""
    nodes = Stranger(server.endpoint)
    try:
        grid = nodes.subscribe("/map", types.OCCUPANCY_GRID, latched=True).get(timeout=DEADLINE_S)
    finally:
        nodes.close()
    values = grid.data.reshape(grid.info.height, grid.info.width)
    assert np.abs(values - expected_grid(client, grid)).max() <= 1  # percent: rounding
    assert (values >= 65).sum() > 100  # what a planner takes for occupied by map_server's default
    assert (values == -1).any()
