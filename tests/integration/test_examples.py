"""The client's examples run, and print what they promise."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from potclient import MapClient
from potserver.server import MapServer

EXAMPLES = Path(__file__).resolve().parents[2] / "clients" / "examples"


def run(name: str, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLES / name), *words],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_robot_drives_and_a_planner_asks(map_server: MapServer, map_client: MapClient) -> None:
    out = run("robot.py", "--connect", map_server.endpoint, "--limit", "4", "generated")
    assert re.search(r"the first scan: \d+ beams became \d+ kernels", out)
    assert out.count("accepted, ") == 4, "three receipts and the summary"
    assert "3 of 3 published scans accepted, 0 unknown" in out
    assert map_client.info().n_scans == 4
    out = run("planner.py", "--connect", map_server.endpoint)
    assert re.search(r"P\(occupied\) 0\.\d+, sd 0\.\d+, observed", out), "it asks where the map knows"
    assert out.count("degrees: ") == 8
    assert "a collision with probability" in out
    out = run("planner.py", "--connect", map_server.endpoint, "--at", "500", "0", "0")
    assert re.search(r"500.*P\(occupied\) 0\.50, sd 0\.\d+, unknown", out)


def test_a_notebook_maps_in_its_own_process() -> None:
    out = run("notebook.py")
    assert "revision 6: " in out
    ends, half_way = (float(p) for p in re.findall(r"median P\(occupied\) (\d\.\d+)", out))
    assert half_way < 0.3 < 0.6 < ends
    assert "far away: P(occupied) 0.50, observed False" in out


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 60
