"""Bags for tests, written by rosbags."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from potclient.datasets import RecordedScan, Recording
from tests.ros import messages as ros

Put = Callable[[str, Any, int], None]  # (topic, message, when it is logged, ns)

LIDAR_ON_BASE = (0.3, -0.1, 1.7)  # m
START_NS = 1_700_000_000 * 10**9


@contextlib.contextmanager
def writing(folder: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> Iterator[Put]:
    """A rosbag2 folder in the making."""
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}

        def put(topic: str, message: Any, logged_ns: int) -> None:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ros.STORE)
            writer.write(connections[topic], logged_ns, ros.cdr(message, kind))

        yield put


class EchoesOnly(Recording):
    """A recording without its beams that have no echo: a point cloud cannot tell them."""

    format = "echoes"

    def __init__(self, source: Recording) -> None:
        super().__init__(source.path)
        self._source = source

    def __len__(self) -> int:
        return len(self._source)

    def read(self, i: int) -> RecordedScan:
        scan = self._source.read(i)
        echoes = scan.points[scan.is_return]
        return dataclasses.replace(scan, points=echoes, is_return=np.ones(len(echoes), np.bool_))


def bag_of(recording: Recording, folder: Path, plugin: StoragePlugin = StoragePlugin.MCAP) -> None:
    """A stranger's bag of a recording: /points, /tf and /tf_static, the transform of a scan logged after the scan."""
    T_base_lidar = np.eye(4)
    T_base_lidar[:3, 3] = LIDAR_ON_BASE
    with writing(folder, plugin) as put:
        put("/tf_static", ros.tf(ros.transform("base", "lidar", START_NS, LIDAR_ON_BASE)), START_NS)
        for i, scan in enumerate(recording):
            stamp = START_NS + i * 10**8
            put("/points", ros.cloud(ros.xyz_rows(scan.points), "lidar", stamp), stamp)
            base = scan.T_map_sensor @ np.linalg.inv(T_base_lidar)
            yaw = float(np.arctan2(base[1, 0], base[0, 0]))
            transforms = (
                ros.transform("odom", "base", stamp, base[:3, 3], yaw),
                ros.transform("map", "odom", stamp),
            )
            put("/tf", ros.tf(*transforms), stamp + 10**7)
