"""A server that is killed under load has all that it acknowledged when it is back; `benchmarks/kill.py` is the long run."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def kill(root: Path) -> ModuleType:
    """`benchmarks/kill.py`, which is no part of a package."""
    spec = importlib.util.spec_from_file_location("kill", root / "benchmarks" / "kill.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["kill"] = importlib.util.module_from_spec(
        spec
    )  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_to_kill_9(kill: ModuleType, tmp_path: Path) -> None:
    report = kill.run(tmp_path, kills=3, seed=4, longest_s=0.5, snapshot_scans=1)
    assert report.kills == 3
    assert report.lost == []
    assert 0 < report.acknowledged <= report.integrated
    assert report.tiles_compared > 0
    assert report.tiles_different == 0, "the map is the one that would be there without the kills"
