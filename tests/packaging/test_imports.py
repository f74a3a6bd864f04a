"""What a start loads: large packages wait for who needs them."""

from __future__ import annotations

import subprocess
import sys

import pytest

LARGE = {
    "torch",
    "open3d",
    "matplotlib",
    "pandas",
    "sklearn",
    "ray",
    "pyarrow",
    "kiss_icp",
    "skimage",
    "trimesh",
    "rerun",
}
COMPILER = {"numba", "llvmlite", "scipy"}
READY = """
from potserver.adapters.questions.registry import warm_up
from potserver.mapping.service import MappingService
import potserver.server
MappingService().warm_up()
warm_up()
"""


@pytest.mark.parametrize(
    ("program", "absent"),
    [
        ("import potclient", LARGE | COMPILER | {"rich"}),
        ("import potclient.cli", LARGE | COMPILER),
        ("import potserver.cli", LARGE | COMPILER),
        (READY, LARGE),
    ],
    ids=["client", "client's command", "server's command", "a server that is ready"],
)
def test_large_packages_wait_until_they_are_needed(program: str, absent: set[str]) -> None:
    code = f"{program}\nimport sys\nprint(*({absent!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=280)
    assert (done.returncode, done.stdout.split()) == (0, []), done.stderr
