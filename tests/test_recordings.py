"""Recordings as the evaluation and the atom builder take them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from potclient.errors import DatasetError
from potserver import bundled
from potserver.errors import SettingsError
from potserver.recordings import Reader, open_recording, scan_numbers, to_scan


def test_opening(tmp_path: Path) -> None:
    assert len(open_recording("bundled:rooms", Reader())) == len(bundled.open_bundled("rooms"))
    assert len(open_recording("generated:2d", Reader(n_generated=7))) == 7
    with pytest.raises(DatasetError, match=r"no bundled recording .*; there are street, rooms, plan"):
        open_recording("bundled:moon", Reader())
    with pytest.raises(DatasetError, match="no reader options"):
        open_recording("bundled:rooms", Reader(max_range_m=3.0))
    with pytest.raises(DatasetError, match="no such file"):
        open_recording(str(tmp_path / "none"), Reader())


def test_scans_are_the_first_ones_or_a_slice() -> None:
    assert scan_numbers("7", 20) == scan_numbers(7, 20) == range(7)
    assert scan_numbers("99", 20) == scan_numbers(":", 20) == range(20)
    assert scan_numbers("2:12:4", 20) == range(2, 12, 4)
    for wrong in ("1-5", "x", "", "1:2:0", -1):
        with pytest.raises(SettingsError, match="need a number, or START:STOP:STEP"):
            scan_numbers(wrong, 20)
    for none in (0, "0"):
        with pytest.raises(SettingsError, match="need at least 1"):
            scan_numbers(none, 20)


def test_a_recorded_scan_is_a_scan() -> None:
    recorded = bundled.open_bundled("plan")[1]
    scan = to_scan(recorded, 5)
    assert (scan.seq, scan.stamp_ns, scan.is_planar) == (5, recorded.stamp_ns, True)
    np.testing.assert_array_equal(scan.points, recorded.points)
    np.testing.assert_array_equal(scan.T_map_sensor, recorded.T_map_sensor)
