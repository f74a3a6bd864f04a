"""The settings tree: precedence, and errors that say what to do."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from potserver.config import Settings, as_tree, load_settings, to_toml
from potserver.errors import SettingsError
from potserver.limits import Limits
from potserver.mapping.settings import PAPER, MappingSettings


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def write(text: str) -> Path:
        path = tmp_path / "settings.toml"
        path.write_text(text)
        return path

    return write


def test_the_defaults_are_legal_and_local() -> None:
    settings = load_settings()
    assert settings == Settings()
    assert settings.maps == ("default",)
    assert settings.root == "pot/v1"
    assert settings.zenoh.listen == (), "the built-in endpoint is loopback"


def test_flags_win_over_variables_over_the_file_over_defaults(write: Any) -> None:
    file = write(
        'server_id = "file"\nroot = "file"\nseed = 1\n[limits]\nmax_cloud_points = 10\nmax_query_points = 11\n'
    )
    environ = {"POTSERVER_ROOT": "environ", "POTSERVER_SEED": "2", "POTSERVER_LIMITS__MAX_CLOUD_POINTS": "20"}
    settings = load_settings(file=file, environ=environ, overrides={"seed": 3})
    assert (settings.server_id, settings.root, settings.seed) == ("file", "environ", 3)
    assert (settings.limits.max_cloud_points, settings.limits.max_query_points) == (20, 11)
    assert settings.limits.max_grid_cells == Limits().max_grid_cells


def test_a_variable_may_name_the_file(write: Any) -> None:
    file = write("seed = 5")
    assert load_settings(environ={"POTSERVER_SETTINGS": str(file)}).seed == 5


@pytest.mark.parametrize(
    ("name", "text", "path", "value"),
    [
        ("MAPS", "ground,first_floor", "maps", ("ground", "first_floor")),
        ("MAPS", '["a", "b"]', "maps", ("a", "b")),
        ("MAPPING__ROTATIONS_DEG", "-10, 0, 10", "mapping.rotations_deg", (-10.0, 0.0, 10.0)),
        ("MAPPING__REFINE", "false", "mapping.refine", False),
        ("MAPPING__RANK_SCORE", "normalised", "mapping.rank_score", "normalised"),
        ("DICTIONARY", "/data/1.npz", "dictionary", "/data/1.npz"),
        ("SERVER_ID", "42", "server_id", "42"),
        ("THREADS", "3", "threads", 3),
        (
            "ZENOH__CFG",
            '{ "transport/link/tx/lease" = 5000 }',
            "zenoh.cfg",
            {"transport/link/tx/lease": 5000},
        ),
        ("ZENOH__LISTEN", "tcp/127.0.0.1:0", "zenoh.listen", ("tcp/127.0.0.1:0",)),
        ("POSES__WAIT_S", "0", "poses.wait_s", 0.0),
    ],
)
def test_variables_are_read_as_their_keys_want(name: str, text: str, path: str, value: Any) -> None:
    settings: Any = load_settings(environ={f"POTSERVER_{name}": text})
    for key in path.split("."):
        settings = getattr(settings, key)
    assert settings == value


def test_what_kubernetes_injects_for_a_service_of_our_name_is_not_ours() -> None:
    environ = {
        "POTSERVER_SERVICE_HOST": "10.0.0.1",
        "POTSERVER_SERVICE_PORT": "7447",
        "POTSERVER_SERVICE_PORT_ZENOH": "7447",
        "POTSERVER_PORT": "tcp://10.0.0.1:7447",
        "POTSERVER_PORT_7447_TCP_ADDR": "10.0.0.1",
    }
    assert load_settings(environ=environ) == Settings()


def test_a_profile_sets_what_the_other_keys_start_from(write: Any) -> None:
    assert load_settings(overrides={"mapping.profile": "paper"}).mapping == PAPER
    settings = load_settings(file=write('[mapping]\nprofile = "paper"\nn_sectors = 7\n'))
    assert settings.mapping == dataclasses.replace(PAPER, n_sectors=7)
    assert load_settings().mapping == MappingSettings()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            {"limits.max_cloud_byte": 1},
            r"no setting 'limits\.max_cloud_byte'; did you mean limits\.max_cloud_bytes\?",
        ),
        ({"server": "x"}, r"did you mean server_id\?"),
        ({"limits": 3}, "is a table"),
        ({"limits.max_cloud_bytes.x": 3}, "no setting"),
        ({"limits.max_cloud_bytes": "many"}, r"limits\.max_cloud_bytes = 'many': expected `int`"),
        ({"limits.max_cloud_bytes": 0}, "need a positive number"),
        ({"limits.max_coordinate_m": float("nan")}, "need a positive number"),
        ({"intake.max_queued_bytes": 10}, r"need at least limits\.max_cloud_bytes"),
        ({"queries.max_queued_bytes": 10}, r"need at least limits\.max_query_bytes"),
        ({"maps": []}, "at least one map"),
        ({"maps": ["a", "a"]}, "each once"),
        ({"maps": ["srv"]}, "another name"),
        ({"maps": ["A b"]}, "is not an id"),
        ({"server_id": "*"}, "is not an id"),
        ({"intake.robots": ["r 1"]}, "is not an id"),
        ({"root": "pot/**"}, "chunks"),
        ({"root": "/pot"}, "chunks"),
        ({"root": "@pot"}, "chunks"),
        ({"threads": 0}, "at least 1"),
        ({"zenoh.mode": "broker"}, "peer, client or router"),
        ({"log.level": "loud"}, "debug, info"),
        ({"mapping.profile": "none"}, "no profile 'none'"),
        ({"mapping.max_range_m": -1.0}, r"mapping\.max_range_m is -1\.0, need positive"),
        ({"mapping.rank_score": "best"}, r"mapping\.rank_score = 'best'"),
        ({"stats_period_s": 0.0}, "at least"),
        ({"seed": -1}, "at least 0"),
    ],
)
def test_illegal_settings_say_which_and_why(overrides: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        load_settings(overrides=overrides)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("limits = 3", "limits is a table"),
        ("[limit]\n", r"no setting 'limit'; did you mean limits\?"),
        ("[limits]\nx = 1\n", r"no setting 'limits\.x'"),
        ("seed = ", "is not TOML"),
        ('seed = "x"', "seed = 'x'"),
    ],
)
def test_errors_of_a_file_name_the_file_or_key(write: Any, text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        load_settings(file=write(text))


def test_a_missing_file_is_said(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"cannot read settings file .*none\.toml"):
        load_settings(file=tmp_path / "none.toml")


def test_an_unknown_variable_is_refused_by_its_name() -> None:
    with pytest.raises(SettingsError, match=r"POTSERVER_LIMITS__MAX_CLOUDS: no setting"):
        load_settings(environ={"POTSERVER_LIMITS__MAX_CLOUDS": "1"})


def test_what_is_shown_can_be_read_back(write: Any) -> None:
    settings = load_settings(
        overrides={
            "maps": ["a", "b-2"],
            "threads": 2,
            "dictionary": 'a "quoted" path.npz',
            "zenoh.cfg": {"transport/link/tx/lease": 5000, "mode": "peer"},
            "mapping.profile": "paper",
            "mapping.rotations_deg": [0.0],
        }
    )
    assert load_settings(file=write(to_toml(settings))) == settings
    assert load_settings(file=write(to_toml(Settings()))) == Settings()


def test_the_tree_is_plain() -> None:
    def check(value: Any) -> None:
        if isinstance(value, dict):
            for item in value.values():
                check(item)
        elif isinstance(value, list):
            for item in value:
                check(item)
        else:
            assert value is None or type(value) in (bool, int, float, str)

    check(as_tree(Settings()))
