"""Maps beside each other, and one thread for all of them."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from potclient import MapClient
from potserver.config import load_settings
from potserver.server import MapServer

from .rooms import pose, room

SETTINGS = {"threads": 1, "queries.threads": 1, "mapping.max_range_m": 12.0, "maps": ["busy", "calm"]}


@pytest.fixture
def server() -> Iterator[MapServer]:
    with MapServer(load_settings(overrides=SETTINGS), listen="tcp/127.0.0.1:0") as server:
        yield server


@pytest.fixture
def busy(server: MapServer) -> Iterator[MapClient]:
    with MapClient(server.endpoint, map="busy", timeout_s=60.0) as client:
        client.wait_ready(60.0)
        yield client


def test_one_thread_is_enough(busy: MapClient) -> None:
    receipt = busy.integrate(room(), pose())
    assert receipt.accepted
    assert busy.occupancy(room()).observed.mean() > 0.9
    assert busy.rays(np.zeros(3), np.eye(3), 9.0).revision == receipt.message.map_revision
    assert busy.mirror().update().n_kernels == busy.info().n_kernels


def test_a_map_does_not_wait_for_another(
    server: MapServer, busy: MapClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing of one map stands in a queue behind the work of another, with one thread for all too."""
    mapper: Any = server.mapper("busy")
    begun, may_end = threading.Event(), threading.Event()
    integrate = mapper.integrate

    def held(*arguments: Any, **options: Any) -> Any:
        begun.set()
        assert may_end.wait(60.0)
        return integrate(*arguments, **options)

    monkeypatch.setattr(mapper, "integrate", held)
    for number in range(4):
        busy.publish(room(), pose(), robot=f"r{number}")
    assert begun.wait(60.0)
    try:
        with MapClient(server.endpoint, map="calm", timeout_s=60.0) as calm:
            calm.wait_ready(60.0)
            for number in range(3):
                assert calm.integrate(room(), pose(0.1 * number)).message.map_revision == number + 1
            assert calm.occupancy(room()).revision == 3
        assert busy.info().map_revision == mapper.n_scans == 0
    finally:
        may_end.set()
    busy.flush(60.0)
    assert mapper.n_scans == 4
