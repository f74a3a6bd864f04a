"""The Zenoh configuration: what is built in, and what wins over it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from potserver.adapters.session import ZenohSettings, build_config, close_session
from potserver.errors import SettingsError


@pytest.fixture(autouse=True)
def no_zenoh_config(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ZENOH_CONFIG", raising=False)


def build(**settings: Any) -> zenoh.Config:
    return build_config(ZenohSettings(**settings), root="pot/v1", wire_guard_bytes=1000)


def get(config: zenoh.Config, key: str) -> Any:
    return json.loads(config.get_json(key))


def test_the_built_in_node_is_a_quiet_local_peer() -> None:
    config = build()
    assert get(config, "mode") == "peer"
    assert get(config, "listen/endpoints") == ["tcp/127.0.0.1:7447"]
    assert get(config, "scouting/multicast/enabled") is False
    assert get(config, "timestamping/enabled") is True
    assert get(config, "transport/link/rx/max_message_size") == 64 * 2**20
    assert get(config, "transport/shared_memory/transport_optimization/messages") == ["put"]
    assert get(config, "transport/unicast/lowlatency") is False
    (guard,) = get(config, "low_pass_filter")
    assert (guard["size_limit"], guard["key_exprs"], guard["messages"]) == (
        1000,
        ["pot/v1/**"],
        ["put", "query"],
    )


def test_the_file_wins_over_what_is_built_in_and_flags_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(
        '{ mode: "router", listen: { endpoints: ["tcp/127.0.0.1:1"] }, scouting: { multicast: { enabled: true } },'
        "  transport: { link: { rx: { max_message_size: 5000000 }, tx: { lease: 1000 } } } }"
    )
    config = build(config=str(file))
    assert get(config, "mode") == "router"
    assert get(config, "listen/endpoints") == ["tcp/127.0.0.1:1"]
    assert get(config, "scouting/multicast/enabled") is True
    assert get(config, "transport/link/rx/max_message_size") == 5_000_000
    assert get(config, "timestamping/enabled") is True, "what the file leaves alone is built in"

    config = build(config=str(file), cfg={"transport/link/tx/lease": "2000", "mode": "client"})
    assert get(config, "transport/link/tx/lease") == 2000
    assert get(config, "mode") == "client"

    config = build(
        config=str(file),
        cfg={"mode": "client"},
        mode="peer",
        listen=("tcp/127.0.0.1:2",),
        connect=("tcp/127.0.0.1:3",),
    )
    assert get(config, "mode") == "peer"
    assert get(config, "listen/endpoints") == ["tcp/127.0.0.1:2"]
    assert get(config, "connect/endpoints") == ["tcp/127.0.0.1:3"]


def test_the_environment_names_a_file_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text('{ mode: "router" }')
    monkeypatch.setenv("ZENOH_CONFIG", str(file))
    assert get(build(), "mode") == "router"
    other = tmp_path / "other.json5"
    other.write_text('{ mode: "client" }')
    assert get(build(config=str(other)), "mode") == "client"


def test_a_client_of_a_router_does_not_listen() -> None:
    assert get(build(mode="client"), "listen/endpoints") == []


def test_shared_memory_is_off_unless_it_is_asked_for() -> None:
    assert get(build(), "transport/shared_memory/enabled") is False
    assert get(build(shared_memory=True), "transport/shared_memory/enabled") is True
    on = {"transport/shared_memory/enabled": True}
    assert get(build(cfg=on), "transport/shared_memory/enabled") is True
    assert get(build(cfg=on, shared_memory=False), "transport/shared_memory/enabled") is False
    key = "transport/shared_memory/transport_optimization/messages"
    assert get(build(cfg={key: ["put", "query"]}), key) == ["put", "query"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cfg": {"no/such/key": "1"}}, "Zenoh refuses no/such/key = 1"),
        ({"cfg": {"mode": "broker"}}, "Zenoh refuses mode"),
        ({"config": "/no/such/file"}, "no Zenoh configuration file"),
        (
            {"cfg": {"transport/unicast/lowlatency": "true", "transport/unicast/qos/enabled": "false"}},
            "loses every message",
        ),
    ],
)
def test_what_zenoh_refuses_is_one_line(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message) as caught:
        build(**settings)
    assert "\n" not in str(caught.value)
    assert ".cargo" not in str(caught.value)


def test_a_broken_file_is_said(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{ mode: ")
    with pytest.raises(SettingsError, match="is not a Zenoh configuration"):
        build(config=str(file))


def test_a_close_that_hangs_is_given_up() -> None:
    import threading

    gate = threading.Event()

    class Session:
        def close(self) -> None:
            gate.wait(30)

    assert close_session(Session(), 0.01) is False  # type: ignore[arg-type]
    gate.set()
