"""The server's Zenoh node on loopback: free ports, taken ports, and illegal endpoints."""

from __future__ import annotations

import subprocess
import sys

import pytest
import zenoh

from potserver.adapters.session import ZenohSettings, build_config, close_session, open_session
from potserver.errors import SettingsError
from potserver.health import rss_bytes

from .conftest import until


def build(endpoint: str) -> zenoh.Config:
    return build_config(ZenohSettings(listen=(endpoint,)), root="pot/v1", wire_guard_bytes=1000)


def test_port_zero_is_any_free_port_and_a_taken_one_is_explained() -> None:
    session, (endpoint,) = open_session(build("tcp/127.0.0.1:0"))
    try:
        assert endpoint.startswith("tcp/127.0.0.1:")
        assert not endpoint.endswith(":0")
        with pytest.raises(SettingsError, match=f"cannot listen on {endpoint}: the port is taken.*--listen"):
            open_session(build(endpoint))
    finally:
        assert close_session(session, 10)
    assert close_session(session, 10), "twice does no harm"


def test_an_illegal_endpoint_is_explained() -> None:
    with pytest.raises(SettingsError, match="cannot open Zenoh") as caught:
        open_session(build("tcp/127.0.0.1:99999"))
    assert ".cargo" not in str(caught.value)


_ROBOT = """
import sys, time
from potclient.session import SessionOptions, open_session
for _ in range(6):
    session = open_session(SessionOptions(connect=(sys.argv[1],)))
    publisher = session.declare_publisher("pot/v1/m/in/r/cloud")
    while not publisher.matching_status.matching:
        time.sleep(0.001)
    for _ in range(15):
        publisher.put(bytes(300_000))
        time.sleep(0.01)  # the library takes a moment to set shared memory up
    session.close()
"""


def test_sessions_that_came_and_went_leave_no_memory_behind() -> None:
    """With shared memory each leaves 18 MB, closed or not: it is off unless somebody asks for it."""
    session, (endpoint,) = open_session(
        build_config(ZenohSettings(listen=("tcp/127.0.0.1:0",)), root="pot/v1", wire_guard_bytes=2**20)
    )
    came: list[int] = []
    try:
        session.declare_subscriber(
            "pot/v1/m/in/*/cloud", lambda sample: came.append(len(sample.payload.to_bytes()))
        )
        before = rss_bytes()
        subprocess.run([sys.executable, "-c", _ROBOT, endpoint], check=True, timeout=120)
        until(lambda: len(came) > 60, "most of the clouds")
        assert rss_bytes() - before < 40 * 2**20
    finally:
        assert close_session(session, 10)
