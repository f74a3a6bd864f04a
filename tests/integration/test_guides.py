"""Every command of the guides (docs/guides), in order, as a reader runs them, beside the files that a guide begins with."""

from __future__ import annotations

import contextlib
import re
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.server_process import ServerProcess
from potclient.cli import main as client_main
from potclient.datasets import open_dataset
from potclient.ros import types
from potserver.cli import main as server_main
from tests.conftest import ROOT
from tests.packaging.test_docs import blocks, commands
from tests.ros import messages as ros
from tests.ros.bags import START_NS, EchoesOnly, bag_of, writing

from .conftest import DEADLINE_S, until
from .rooms import room
from .ros_strangers import Stranger
from .scripted import free_port

GUIDES = ROOT / "docs/guides"
LASTING = ("serve", "ros")  # commands that run until they are ended
IN_CPP = ("cmake", "mkdir", "build/robot", "build/rewrite_vectors")  # test_cpp_example.py runs these


class Terminals:
    """Runs commands of ours: what lasts in processes, one at a time, the rest here. Addresses move to free ports."""

    def __init__(self) -> None:
        self._ports = {port: str(free_port()) for port in ("7447", "7448", "8080")}
        self.server: ServerProcess | None = None

    def at(self, text: str) -> str:
        """A word with the addresses that stand for those of the guide."""
        text = text.replace("0.0.0.0", "127.0.0.1")
        return re.sub(r"\b(7447|7448|8080)\b", lambda found: self._ports[found[1]], text)

    def run(self, words: list[str]) -> None:
        program, verb, *rest = map(self.at, words)
        if program == "potserver" and verb in LASTING:
            self.end()
            listens = [] if "--listen" in rest else ["--listen", self.at("tcp/127.0.0.1:7447")]
            self.server = ServerProcess(verb, *rest, *listens, "--log-format", "json")
            self.server.event("server_started")
            return
        reaches = [] if program == "potserver" or "-e" in rest else ["-e", self.at("tcp/127.0.0.1:7447")]
        main = {"potserver": server_main, "potclient": client_main}[program]
        assert main([verb, *rest, *reaches]) == 0, words
        for flag in ("-o", "--save", "--json"):
            if flag in rest:
                written = Path(rest[rest.index(flag) + 1])
                assert written.is_dir() or written.stat().st_size > 100, words

    def end(self) -> None:
        if self.server is not None:
            assert self.server.end(signal.SIGTERM) == 0
            self.server = None


@pytest.fixture
def terminals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminals]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    terminals = Terminals()
    yield terminals
    terminals.end()


def commands_of(guide: str) -> list[list[str]]:
    text = (GUIDES / guide).read_text()
    return [words for block in blocks(text, "console") for words in commands(block)]


@pytest.fixture
def drive(tmp_path: Path) -> None:
    """drive.mcap, and lidar-only.mcap without poses: six scans of a street."""
    scans = EchoesOnly(open_dataset("town:terraces:vlp16:3", n_generated=6))
    bag_of(scans, tmp_path / "a")
    with writing(tmp_path / "b") as put:
        for i, scan in enumerate(scans):
            stamp = START_NS + i * 10**8
            put("/points", ros.cloud(ros.xyz_rows(scan.points), "lidar", stamp), stamp)
    (tmp_path / "a/a.mcap").rename(tmp_path / "drive.mcap")
    (tmp_path / "b/b.mcap").rename(tmp_path / "lidar-only.mcap")


def test_every_guide_is_run_here_or_by_the_test_of_the_example_in_cpp() -> None:
    assert {path.name for path in GUIDES.iterdir()} == {
        "bag.md",
        "cpp.md",
        "nav2.md",
        "robots.md",
        "tuning.md",
    }
    ours = [words for words in commands_of("cpp.md") if words[0] not in IN_CPP]
    assert ours == [["potserver", "serve", "--in-memory"]]


@pytest.mark.slow
@pytest.mark.parametrize("guide", ["bag.md", "robots.md", "tuning.md"])
def test_a_guide_works_from_its_first_command_to_its_last(
    guide: str, drive: None, terminals: Terminals, capsys: pytest.CaptureFixture[str]
) -> None:
    todo = commands_of(guide)
    assert len(todo) > 4
    for words in todo:
        terminals.run(words)
    told = capsys.readouterr()
    assert "Traceback" not in told.out + told.err


@pytest.mark.slow
def test_nav2_in_ten_minutes(terminals: Terminals, capsys: pytest.CaptureFixture[str]) -> None:
    """A ROS network with a router; its LiDAR is a stranger's publisher, and so is the costmap's subscriber."""
    serve, *rest = commands_of("nav2.md")
    router = ServerProcess(
        "serve", "--in-memory", "-m", "router", "--map", "nothing", "--listen", terminals.at("tcp/127.0.0.1:7447"),
        "--log-format", "json",
    )  # fmt: skip
    with contextlib.closing(router):
        router.event("server_started")
        terminals.run([*serve, "--set", "ros.wait_s=20"])
        with contextlib.closing(Stranger(terminals.at("tcp/127.0.0.1:7447"))) as nodes:
            nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", START_NS, (0, 0, 1))))
            nodes.publish("/points", ros.cloud(ros.xyz_rows(room().astype(np.float32)), "lidar", START_NS))
            assert terminals.server is not None
            terminals.server.event("scan_integrated")
            until(lambda: "/potserver/map" in nodes.topics(), "the map's topic")
            grid = nodes.subscribe("/potserver/map", types.OCCUPANCY_GRID, latched=True).get(
                timeout=DEADLINE_S
            )
            assert grid.data.max() > 50
            assert grid.data.min() == -1
        asks_for_counters, *others = rest

        def counts_the_cloud() -> bool:
            terminals.run(asks_for_counters)
            return "ros.clouds.sent" in capsys.readouterr().out

        until(counts_the_cloud, "the cloud to be counted")  # which is after its answer
        for words in others:
            terminals.run(words)
        terminals.end()
