"""The client in C++ (clients/examples/cpp): its messages against the golden vectors, and its robot against a real server.

Needs cmake, a C++ compiler and msgpack-cxx, and for the robot zenoh-cpp at CMAKE_PREFIX_PATH; skips name what is missing.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from potclient.client import MapClient
from potschemas import messages
from potschemas.wire import decode
from potserver.server import MapServer
from tests.conftest import ROOT

SOURCE = ROOT / "clients/examples/cpp"
VECTORS = ROOT / "schemas/potschemas/vectors"
SPOKEN = {
    "pot.cloud.v1": messages.Cloud,
    "pot.points_query.v1": messages.PointsQuery,
    "pot.occupancy.v1": messages.Occupancy,
    "pot.receipt.v1": messages.Receipt,
    "pot.error.v1": messages.ErrorReply,
}
# what the example does not read of a message: so it is not in what it writes
LEFT_OUT = {
    "pot.occupancy.v1": ("gradient", "latent_gradient"),
    "pot.receipt.v1": (
        "queue_depth", "wait_ms", "integrate_ms", "n_points", "n_kernels", "n_kernels_added", "n_kernels_transported",
        "map_kernels", "sectors", "kernels", "next_seq", "borrowed",
    ),
}  # fmt: skip


def run(*words: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, timeout=280)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the programs."""
    if shutil.which("cmake") is None or shutil.which(os.environ.get("CXX", "c++")) is None:
        pytest.skip("no cmake or no C++ compiler here")
    folder = tmp_path_factory.mktemp("cpp")
    configured = run("cmake", "-S", SOURCE, "-B", folder)
    if "MSGPACK_INCLUDE_DIR" in configured.stderr:
        pytest.skip("no msgpack-cxx here (Debian, Ubuntu: libmsgpack-cxx-dev)")
    assert configured.returncode == 0, configured.stderr
    made = run("cmake", "--build", folder)
    assert made.returncode == 0, made.stdout + made.stderr
    assert "warning:" not in made.stderr
    return folder


def test_the_golden_vectors_survive_the_way_through_cpp(built: Path, tmp_path: Path) -> None:
    done = run(built / "rewrite_vectors", VECTORS, tmp_path)
    assert done.returncode == 0, done.stderr
    golden = {path.name for path in VECTORS.glob("*.msgpack") if schema_of(path) in SPOKEN}
    assert {path.name for path in tmp_path.iterdir()} == golden
    assert len(golden) > 10
    for name in sorted(golden):
        schema = schema_of(Path(name))
        theirs, ours = (
            decode((folder / name).read_bytes(), SPOKEN[schema]) for folder in (tmp_path, VECTORS)
        )
        for field in ours.__struct_fields__:
            if field not in LEFT_OUT.get(schema, ()):
                assert getattr(theirs, field) == getattr(ours, field), f"{name}: {field}"


def schema_of(path: Path) -> str:
    return ".".join(path.name.split(".")[:3])


def test_a_robot_in_cpp_feeds_a_map_and_asks_it(
    built: Path, map_server: MapServer, map_client: MapClient
) -> None:
    robot = built / "robot"
    if not robot.is_file():
        pytest.skip("no zenoh-cpp here: name its prefix in CMAKE_PREFIX_PATH, see docs/guides/cpp.md")
    done = run(robot, map_server.endpoint)
    assert (done.returncode, done.stderr) == (0, "")
    lines = done.stdout.splitlines()
    assert re.fullmatch(r"cloud 0: accepted +revision \d+", lines[0])
    told = [re.fullmatch(r"(.+): P\(occupied\) (.+), sd (.+), (\w+)", line) for line in lines[1:]]
    points = [[float(v) for v in found[1].split()] for found in told if found]
    answer = map_client.occupancy(points)
    assert [float(found[2]) for found in told if found] == pytest.approx(answer.mean.tolist(), abs=6e-5)
    assert [float(found[3]) ** 2 for found in told if found] == pytest.approx(answer.var.tolist(), abs=2e-4)
    assert [found[4] == "observed" for found in told if found] == answer.observed.tolist()
    assert answer.observed.tolist() == [True, True, False]
    assert answer.mean[0] < 0.1 < 0.5 < answer.mean[1]
