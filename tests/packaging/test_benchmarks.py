"""The benchmarks load what they name: each one tells its flags."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    "name",
    [
        "fairness",
        "ghosts",
        "kill",
        "kilometre",
        "laps",
        "lattices",
        "learner_curves",
        "mirror",
        "receipts",
        "service",
        "sessions",
        "standing",
        "thin",
        "torture",
    ],
)
def test_a_benchmark_tells_its_flags(root: Path, name: str) -> None:
    run = subprocess.run(
        [sys.executable, str(root / "benchmarks" / f"{name}.py"), "--help"],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.startswith(f"usage: {name}.py")
