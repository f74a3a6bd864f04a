"""A server that is killed under load has all that it acknowledged when it is back; `benchmarks/kill.py` is the long run."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import kill


@pytest.mark.slow
def test_nothing_acknowledged_is_lost_to_kill_9(tmp_path: Path) -> None:
    report = kill.run(tmp_path, kills=3, seed=4, longest_s=0.5, snapshot_scans=1)
    assert report.kills == 3
    assert report.lost == []
    assert 0 < report.acknowledged <= report.integrated
    assert report.snapshots > 0
    assert report.tiles_compared > 0
    assert report.tiles_different == 0, "the map is the one that would be there without the kills"
