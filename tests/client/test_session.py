"""The Zenoh configuration of a client: what is built in, and what wins over it. No session is opened."""

from __future__ import annotations

import argparse
import json
import traceback
from pathlib import Path
from typing import Any

import pytest
import zenoh

from potclient import MapClient
from potclient.cli import main
from potclient.errors import NoServerError, UsageError
from potclient.session import SessionOptions, add_zenoh_arguments, build_config, options_from_arguments
from potclient.zenoh_config import DEFAULT_ENDPOINT


def options_of(*words: str) -> SessionOptions:
    parser = argparse.ArgumentParser()
    add_zenoh_arguments(parser)
    return options_from_arguments(parser.parse_args(words))


def value(config: zenoh.Config, key: str) -> Any:
    return json.loads(config.get_json(key))


SHM_MESSAGES = "transport/shared_memory/transport_optimization/messages"


def test_the_default_is_a_quiet_client(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ZENOH_CONFIG", raising=False)
    config = build_config(options_of())
    assert value(config, "mode") == "client"
    assert value(config, "connect/endpoints") == [DEFAULT_ENDPOINT]
    assert value(config, "scouting/multicast/enabled") is False
    assert value(config, SHM_MESSAGES) == ["put"]
    assert value(config, "transport/shared_memory/enabled") is False


def test_flags_win_over_cfg_and_cfg_over_the_file_and_the_file_over_ours(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    file = tmp_path / "z.json5"
    file.write_text(
        '{mode: "peer", connect: {endpoints: ["tcp/127.0.0.1:1"]}, scouting: {multicast: {enabled: true}}}'
    )
    for config in (
        build_config(options_of("-c", str(file))),
        build_config_with_environment(monkeypatch, file),
    ):
        assert value(config, "mode") == "peer"
        assert value(config, "connect/endpoints") == ["tcp/127.0.0.1:1"]
        assert value(config, "scouting/multicast/enabled") is True
        assert value(config, SHM_MESSAGES) == ["put"], "what the file leaves open is ours"
    config = build_config(
        options_of(
            *("-c", str(file), "--cfg", 'mode:"router"', "--cfg", f'{SHM_MESSAGES}:["put", "query"]'),
            *("-e", "tcp/127.0.0.1:2", "-e", "tcp/127.0.0.1:3", "--no-multicast-scouting"),
        )
    )
    assert value(config, "mode") == "router"
    assert value(config, SHM_MESSAGES) == ["put", "query"]
    assert value(config, "connect/endpoints") == ["tcp/127.0.0.1:2", "tcp/127.0.0.1:3"]
    assert value(config, "scouting/multicast/enabled") is False
    config = build_config(
        options_of("--cfg", 'mode:"router"', "-m", "peer", "--shm", "-l", "tcp/127.0.0.1:0")
    )
    assert value(config, "mode") == "peer"
    assert value(config, "transport/shared_memory/enabled") is True
    assert value(config, "listen/endpoints") == ["tcp/127.0.0.1:0"]


def test_a_word_in_cfg_needs_no_quotes() -> None:
    assert value(build_config(options_of("--cfg", "mode:peer")), "mode") == "peer"


def build_config_with_environment(monkeypatch: pytest.MonkeyPatch, file: Path) -> zenoh.Config:
    monkeypatch.setenv("ZENOH_CONFIG", str(file))
    config = build_config(options_of())
    monkeypatch.delenv("ZENOH_CONFIG")
    return config


@pytest.mark.parametrize("endpoint", ["carrier-pigeon/127.0.0.1:1", "localhost:7447", "tcp/", ""])
def test_endpoints_that_are_none_are_refused(endpoint: str) -> None:
    with pytest.raises(UsageError, match="PROTOCOL/ADDRESS"):
        build_config(SessionOptions(connect=(endpoint,)))


@pytest.mark.parametrize("flag", ["-e", "-l"])
def test_a_secret_in_an_endpoint_of_the_command_line_is_refused(
    capsys: pytest.CaptureFixture[str], flag: str
) -> None:
    assert main(["info", flag, "tls/h:1#connect_private_key_base64=hush"]) == 2
    told = capsys.readouterr().err
    assert "--config" in told
    assert "hush" not in told


def test_no_secret_of_an_endpoint_is_in_an_error() -> None:
    endpoint = "tcp/127.0.0.1:1#password=hush"
    with pytest.raises(NoServerError, match=r"nobody listens at tcp/127\.0\.0\.1:1#password=") as refused:
        MapClient(endpoint)
    assert "hush" not in "".join(traceback.format_exception_only(refused.value))


def test_a_secret_in_the_command_line_is_refused_with_the_way_to_do_it() -> None:
    for given in ("transport/auth/usrpwd/password:hush", 'transport/auth:{usrpwd:{password:"hush"}}'):
        with pytest.raises(UsageError, match="ZENOH_CONFIG") as refused:
            options_of("--cfg", given)
        assert "hush" not in str(refused.value)
