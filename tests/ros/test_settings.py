"""The table `ros` of the settings, and what is said where the extra is missing."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest

from potclient.errors import UsageError
from potclient.ros import types
from potserver.config import load_settings
from potserver.errors import SettingsError


def ros_settings(**changes: Any) -> Any:
    return load_settings(overrides={f"ros.{name}": value for name, value in changes.items()}).ros


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clouds": ["points"]}, "ros.clouds is 'points', need a topic"),
        ({"clouds": ["/a//b"]}, "need a topic"),
        ({"clouds": ["/*/points"]}, "need a topic"),
        ({"poses": "odom"}, "ros.poses"),
        ({"out": "map"}, "ros.out is 'map', need a namespace"),
        ({"domain": 233}, "0 to 232"),
        ({"map": "other"}, "one of `maps`"),
        ({"robot": "No Way"}, "ros.robot"),
        ({"map_frame": "/"}, "a frame"),
        ({"grid_m": 0.0}, "a positive number"),
        ({"wait_s": -1.0}, "0 or more"),
        ({"min_range_m": "nan"}, "ros.min_range_m"),
        ({"band_m": [2.0, 1.0]}, "lowest and highest"),
        ({"box_m": [0.0, 0, 0, 1, 1, 0]}, "the upper one"),
        ({"extrinsic": [0.0, 0, 0, 0, 0, 0, 2]}, "of length 1"),
        ({"extrinsic": [0.0, 0, 0]}, "qx qy qz qw"),
    ],
)
def test_what_cannot_work_is_refused_by_name(changes: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        ros_settings(**changes)


def test_numbers_may_be_given_as_words() -> None:
    settings = ros_settings(extrinsic="0.3, 0, 1.7, 0, 0, 0, 1", band_m="[0.2, 1.0]")
    assert settings.band_m == (0.2, 1.0)
    assert np.array_equal(settings.sensor_pose[:3, 3], [0.3, 0, 1.7])
    assert np.array_equal(settings.sensor_pose[:3, :3], np.eye(3))


@pytest.mark.parametrize(("out", "topic"), [("/potserver", "/potserver/map"), ("/", "/map")])
def test_topics_that_go_out_are_in_their_namespace(out: str, topic: str) -> None:
    assert ros_settings(out=out).out_topic("map") == topic


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    types.typestore.cache_clear()
    monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
    with pytest.raises(UsageError, match=r"pip install 'potserver\[ros\]'"):
        types.typestore()
    monkeypatch.undo()
    assert types.type_hash(types.POSE).startswith("RIHS01_")
