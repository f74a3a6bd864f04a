"""The server's Zenoh node on loopback: free ports, taken ports, and illegal endpoints."""

from __future__ import annotations

import pytest
import zenoh

from potserver.adapters.session import ZenohSettings, build_config, close_session, open_session
from potserver.errors import SettingsError


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
