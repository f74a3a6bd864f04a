"""`--web`: whether a server is alive and ready, and its counters as Prometheus reads them."""

from __future__ import annotations

import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from potclient.client import MapClient
from potclient.errors import MapServerError
from potserver.config import load_settings
from potserver.errors import SettingsError
from potserver.mapping.service import MappingService
from potserver.server import MapServer
from potserver.web.listener import Served, WebListener, host_and_port

from .conftest import DEADLINE_S
from .rooms import pose, room

parser: Any = pytest.importorskip("prometheus_client.parser")


def fetch(address: str, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://{address}{path}", timeout=DEADLINE_S) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def metrics_of(address: str) -> dict[str, float]:
    """name{label=value,...} -> value; labels in alphabetical order."""
    status, text = fetch(address, "/metrics")
    assert status == 200
    return {
        f"{sample.name}{{{','.join(f'{k}={v}' for k, v in sorted(sample.labels.items()))}}}": sample.value
        for family in parser.text_string_to_metric_families(text)
        for sample in family.samples
    }


def settings(**overrides: Any) -> Any:
    return load_settings(overrides={"web.listen": "127.0.0.1:0", "mapping.max_range_m": 12.0, **overrides})


@pytest.fixture(scope="module")
def served() -> Iterator[MapServer]:
    with MapServer(settings(), listen="tcp/127.0.0.1:0") as server:
        yield server


def test_metrics_are_the_server_s_own_counters(served: MapServer) -> None:
    assert served.web is not None
    address = served.web.address
    with MapClient(served.endpoint, timeout_s=DEADLINE_S) as client:
        client.wait_ready()
        client.integrate(room(), pose())
        with pytest.raises(MapServerError, match="last row"):
            client.integrate(room(), pose() * 2)
        found, stats = metrics_of(address), client.stats()
        assert (
            found["potserver_clouds_total{detail=,kind=accepted}"] == stats.counters["clouds.accepted"] == 1
        )
        assert found["potserver_clouds_total{detail=bad_pose,kind=rejected}"] == 1
        assert found["potserver_queries_total{detail=ok,kind=integrate}"] == 1
        assert found["potserver_map_kernels{map=default}"] == stats.map_kernels["default"] > 0
        assert (
            found["potserver_latency_ms{quantile=0.5,work=integrate}"] == stats.latencies["integrate"].p50_ms
        )
        assert found["potserver_queue{queue=clouds.depth}"] == 0
        assert found["potserver_serving{}"] == 1
        assert found["potserver_resident_bytes{}"] > 1e7
        assert stats.map_scores
        score = stats.map_scores["default"].nll
        assert found.get("potserver_map_score{map=default,score=nll}", np.nan) == pytest.approx(
            score, nan_ok=True
        )


def test_only_these_pages_are_there(served: MapServer) -> None:
    assert served.web is not None
    assert fetch(served.web.address, "/live") == (200, "live\n")
    assert fetch(served.web.address, "/ready") == (200, "serving\n")
    assert fetch(served.web.address, "/nothing")[0] == 404


def test_ready_says_starting_and_draining_while_live_says_live() -> None:
    """A mapper that starts slowly, and then one that drains slowly: it is held while we ask."""
    entered, go_on = threading.Event(), threading.Event()

    def make_map(map_id: str) -> MappingService:
        entered.set()
        assert go_on.wait(DEADLINE_S)
        return MappingService(map_id=map_id)

    server = MapServer(settings(), listen="tcp/127.0.0.1:0", make_map=make_map)
    starter = threading.Thread(target=server.start)
    starter.start()
    assert entered.wait(DEADLINE_S)
    assert server.web is not None
    address = server.web.address
    assert fetch(address, "/ready") == (503, "starting\n")
    assert fetch(address, "/live")[0] == 200
    assert metrics_of(address)["potserver_serving{}"] == 0
    go_on.set()
    starter.join()
    assert fetch(address, "/ready")[0] == 200
    assert server.stop()
    assert server.state == "draining"
    with pytest.raises(urllib.error.URLError):
        fetch(address, "/live")


def test_a_failed_start_leaves_no_listener() -> None:
    def make_map(map_id: str) -> MappingService:
        raise SettingsError("no")

    server = MapServer(settings(), listen="tcp/127.0.0.1:0", make_map=make_map)
    with pytest.raises(SettingsError, match="no"):
        server.start()
    assert server.web is not None
    with pytest.raises(urllib.error.URLError):
        fetch(server.web.address, "/live")


@pytest.mark.parametrize("address", ["8080", ":8080", "here:", "here:a", "here:70000", ""])
def test_addresses_that_are_none(address: str) -> None:
    with pytest.raises(SettingsError, match="HOST:PORT"):
        host_and_port(address)


def test_addresses() -> None:
    assert host_and_port("127.0.0.1:80") == ("127.0.0.1", 80)
    assert host_and_port("[::1]:80") == ("::1", 80)


def test_a_taken_port_is_said() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(SettingsError, match=r"web\.listen.*in use"):
            WebListener(
                address, Served(lambda: "serving", lambda: None, lambda: None, ("default",), "pot/v1")
            )  # type: ignore[arg-type,return-value]
