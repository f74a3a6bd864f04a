"""`potserver ros` and `serve --ros` as processes, and bags played by the client's command."""

from __future__ import annotations

import contextlib
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.server_process import ServerProcess
from potclient import MapClient
from potclient.cli import main
from potclient.datasets import open_dataset
from potclient.holdout import HoldOut
from potclient.play import play
from potserver.server import MapServer
from tests.ros import messages as ros
from tests.ros.bags import EchoesOnly, bag_of

from .conftest import until
from .ros_strangers import Stranger
from .scripted import free_port

T0 = 1_700_000_000 * 10**9


@pytest.fixture
def start() -> Iterator[Any]:
    """Starts `potserver` with these words, and waits for an event."""
    with contextlib.ExitStack() as stack:

        def run(event: str, *words: str) -> tuple[ServerProcess, dict[str, Any]]:
            process = ServerProcess(*words, "--log-format", "json")
            stack.callback(process.close)
            return process, process.event(event)

        yield run


def say_a_scan(nodes: Stranger) -> None:
    points = np.random.default_rng(0).uniform(-9, 9, (500, 3)).astype(np.float32)
    nodes.publish("/tf", ros.tf(ros.transform("odom", "lidar", T0)))
    nodes.publish("/r1/points", ros.cloud(ros.xyz_rows(points), "lidar", T0))


@pytest.mark.slow
def test_a_server_with_ros_beside_a_router(start: Any) -> None:
    """As docs/ros.md has it: the ROS router has the port, the server joins it and listens elsewhere."""
    router, server = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    ros_router = ServerProcess(
        "serve", "--in-memory", "-m", "router", "--listen", router, "--log-format", "json"
    )
    with contextlib.closing(ros_router):
        ros_router.event("server_started")
        words = (
            "serve",
            "--in-memory",
            "--map",
            "site",
            "--connect",
            router,
            "--listen",
            server,
            "--ros",
            "/points",
        )
        process, _ = start("server_started", *words, "--set", "ros.map_frame=odom", "--set", "ros.wait_s=20")
        with contextlib.closing(Stranger(router)) as nodes:
            say_a_scan(nodes)
            until(lambda: process.of("scan_integrated"), "the scan")
        assert process.of("scan_integrated")[0]["robot_id"] == "r1"
        process.popen.send_signal(signal.SIGTERM)
        assert process.wait() == 0
        assert process.event("server_stopped")["counters"]["ros.clouds.sent"] == 1


@pytest.mark.slow
def test_a_bridge_between_a_ros_network_and_a_server_elsewhere(start: Any, map_server: MapServer) -> None:
    network = f"tcp/127.0.0.1:{free_port()}"
    words = ("ros", "/points", "--server", map_server.endpoint, "-m", "peer", "-l", network)
    process, started = start(
        "ros_bridge_started", *words, "--set", "ros.map_frame=odom", "--set", "ros.wait_s=20"
    )
    assert started["map"] == "default"
    with contextlib.closing(Stranger(network)) as nodes:
        before = map_server.health.counter("clouds.accepted")
        say_a_scan(nodes)
        until(lambda: map_server.health.counter("clouds.accepted") == before + 1, "the scan")
        assert "/potserver/map" in nodes.topics()
    process.popen.send_signal(signal.SIGTERM)
    assert process.wait() == 0
    stopped = process.event("ros_bridge_stopped")
    assert stopped["clean"] is True
    assert stopped["counters"]["ros.clouds.received"] == stopped["counters"]["ros.clouds.sent"] == 1


def test_a_bridge_without_a_network_says_so() -> None:
    process = ServerProcess("ros", "/points", "-e", f"tcp/127.0.0.1:{free_port()}")
    with contextlib.closing(process):
        assert process.wait() == 2
    assert "nobody listens at" in "".join(process.lines)
    assert "Traceback" not in "".join(process.lines)


def test_a_bag_maps_as_the_recording_that_it_was_made_of(
    map_server: MapServer, map_client: MapClient, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = EchoesOnly(open_dataset("generated")[:4])
    bag_of(recording, tmp_path / "drive")
    direct = play(map_client, recording, hold_out=HoldOut(0.2, 0)).held_out
    assert direct is not None
    (file,) = (tmp_path / "drive").glob("*.mcap")
    target = tmp_path / "report.json"
    words = [
        "publish",
        str(file),
        "--topic",
        "/points",
        "--tf",
        "--clear",
        "--hold-out",
        "0.2",
        "--json",
        str(target),
    ]
    assert main([*words, "-e", map_server.endpoint]) == 0
    assert "topic /points; poses in 'map' from /tf, /tf_static" in capsys.readouterr().err
    report = json.loads(target.read_text())
    assert report["counts"]["accepted"] == 4
    assert report["held_out"]["nll"] == pytest.approx(direct.nll, abs=0.005)
    assert report["held_out"]["auc"] == pytest.approx(direct.auc, abs=0.002)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--topic", "/nothing"), "no scans on /nothing; topics of PointCloud2, LaserScan: /points"),
        (("--tf", "--poses", "/odom"), "--tf and --poses: poses come from one of the two"),
        (("--tf", "--odometry", "kiss-icp"), "--tf and --odometry: poses come from one of the two"),
        (("--tf", "nowhere"), "those above 'nowhere' are none"),
        (("--poses", "/odom"), "no poses on /odom"),
    ],
)
def test_mistakes_about_bags_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: tuple[str, ...], message: str
) -> None:
    bag_of(open_dataset("generated")[:2], tmp_path / "drive")
    assert main(["publish", str(tmp_path / "drive"), *flags]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_flags_of_bags_are_for_bags(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["publish", "generated", "--topic", "/points"]) == 2
    assert "--topic and --tf are for bags" in capsys.readouterr().err
