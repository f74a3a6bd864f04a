"""`potserver atoms build` as a process of its own: the same file from any number of workers and from Ray; a clean end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from potserver.domain.dictionary import AtomDictionary

from .scripted import free_port

TIMEOUT_S = 240.0
RECIPE = """
tolerance_m = 0.5
learner = { max_kernels = 40, max_epochs = 3, max_range_m = 10.0, max_labelled = 300, min_hits = 20 }

[[recordings]]
dataset = "bundled:plan"
licence = "MIT"
scans = "0:6:2"

[[recordings]]
dataset = "bundled:rooms"
scans = 1
"""
ENDLESS = """
recordings = [
  { dataset = "bundled:plan", scans = 1, dims = 3 },
  { dataset = "bundled:street", learner = { max_labelled = 20000, max_kernels = 2000 } },
]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the recipe lies, and the file that one worker built."""
    folder = tmp_path_factory.mktemp("build")
    (folder / "site.toml").write_text(RECIPE)
    done = _build(folder, "one.atoms", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "4 scans of 2 recordings" in done.stdout
    for heading in ("candidates", "kept", "later AUC"):
        assert heading in done.stdout
    return folder


def _command(folder: Path, out: str, *flags: str, recipe: str = "site.toml") -> list[str]:
    files = ["--recipe", str(folder / recipe), "-o", str(folder / out)]
    return [sys.executable, "-m", "potserver", "atoms", "build", *files, *flags]


def _build(folder: Path, out: str, *flags: str, padding: int = 0) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        _command(folder, out, *flags),
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        env=os.environ | {"PADDING": "x" * padding},  # moves what a process has in memory
    )


def test_the_number_of_workers_changes_nothing(folder: Path) -> None:
    done = _build(folder, "two.atoms", "--workers", "2", padding=777)
    assert done.returncode == 0, done.stderr
    assert (folder / "two.atoms").read_bytes() == (folder / "one.atoms").read_bytes()
    dictionary = AtomDictionary.load(folder / "two.atoms")
    assert {atom.dims for atom in dictionary} == {2, 3}
    assert f"{len(dictionary)} atoms, " in done.stdout.splitlines()[-1]


def test_ray_builds_the_same_file(folder: Path) -> None:
    pytest.importorskip("ray", reason="Ray has no wheel for this platform")
    done = _build(folder, "ray.atoms", "--ray", "local", "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert done.stderr == "", "Ray starts and ends without noise"
    assert (folder / "ray.atoms").read_bytes() == (folder / "one.atoms").read_bytes()


@pytest.fixture
def interruptible() -> Iterator[None]:
    """What runs these tests in the background may ignore SIGINT, and what they start would inherit that."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_ends_the_workers_and_leaves_nothing(folder: Path) -> None:
    (folder / "endless.toml").write_text(ENDLESS)
    with subprocess.Popen(
        _command(folder, "none.atoms", "--workers", "1", recipe="endless.toml"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as build:
        assert build.stdout is not None
        assert build.stdout.readline().startswith("3 scans of 2 recordings")
        assert "the recipe says 3" in build.stdout.readline(), (
            "the first scan fails at once; the others take hours"
        )
        os.killpg(build.pid, signal.SIGINT)  # as a terminal does: the workers are in the group
        _, errors = build.communicate(timeout=TIMEOUT_S)
    assert build.returncode == 130
    assert errors == "potserver: interrupted, nothing was written\n"
    assert not list(folder.glob("none.atoms*"))


def test_a_cluster_that_is_not_there(folder: Path) -> None:
    port = free_port()
    pytest.importorskip("ray", reason="Ray has no wheel for this platform")
    done = _build(folder, "none.atoms", "--ray", f"127.0.0.1:{port}")
    assert done.returncode == 2
    assert done.stderr.startswith(f"potserver: no Ray cluster at 127.0.0.1:{port}")
