"""The settings tree: precedence, and errors that say what to do."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from potserver.commands.config import to_markdown, to_toml
from potserver.config import Settings, as_tree, describe, load_settings
from potserver.errors import SettingsError
from potserver.limits import Limits
from potserver.mapping.settings import MappingSettings


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
        'server_id = "file"\nroot = "file"\nthreads = 1\n[limits]\nmax_cloud_points = 10\nmax_query_points = 11\n'
    )
    environ = {
        "POTSERVER_ROOT": "environ",
        "POTSERVER_THREADS": "2",
        "POTSERVER_LIMITS__MAX_CLOUD_POINTS": "20",
    }
    settings = load_settings(file=file, environ=environ, overrides={"threads": 3})
    assert (settings.server_id, settings.root, settings.threads) == ("file", "environ", 3)
    assert (settings.limits.max_cloud_points, settings.limits.max_query_points) == (20, 11)
    assert settings.limits.max_grid_cells == Limits().max_grid_cells


def test_a_variable_may_name_the_file(write: Any) -> None:
    file = write("threads = 5")
    assert load_settings(environ={"POTSERVER_SETTINGS": str(file)}).threads == 5


@pytest.mark.parametrize(
    ("name", "text", "path", "value"),
    [
        ("MAPS", "ground,first_floor", "maps", ("ground", "first_floor")),
        ("MAPS", '["a", "b"]', "maps", ("a", "b")),
        ("INTAKE__ROBOTS", "r1, r2", "intake.robots", ("r1", "r2")),
        ("STORE__FSYNC", "false", "store.fsync", False),
        ("MAPPING__PROFILE", "paper", "mapping.profile", "paper"),
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
        ("MAPPING__HALF_LIFE_S", "0", "mapping.half_life_s", 0.0),
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
    paper = MappingSettings.of_profile("paper")
    assert load_settings(overrides={"mapping.profile": "paper"}).mapping == paper
    settings = load_settings(file=write('[mapping]\nprofile = "paper"\nmax_range_m = 7.0\n'))
    assert settings.mapping == dataclasses.replace(paper, max_range_m=7.0)
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
        (
            {"mapping.fine_m": 0.2},
            r"flag mapping\.fine_m: mapping\.fine_m is called mapping\.resolution_m now",
        ),
        ({"mapping.gap_m": 0.2}, r"is called mapping\.free_gap_m now"),
        ({"mapping.n_sectors": 5}, r"mapping\.n_sectors is no setting any more"),
        ({"seed": 1}, "seed is no setting any more"),
        ({"atoms.admission.max_atoms": 1}, r"atoms\.admission is no setting any more"),
        ({"maps": []}, "at least one map"),
        ({"maps": ["a", "a"]}, "each once"),
        ({"maps": ["srv"]}, "a map cannot be called 'srv'"),
        ({"maps": ["A b"]}, "is not an id"),
        ({"server_id": "*"}, "is not an id"),
        ({"intake.robots": ["r 1"]}, "is not an id"),
        ({"root": "pot/**"}, "chunks"),
        ({"root": "/pot"}, "chunks"),
        ({"root": "@pot"}, "chunks"),
        ({"root": "pot/a b"}, "chunks"),
        ({"threads": 0}, "at least 1"),
        ({"zenoh.mode": "broker"}, "peer, client or router"),
        ({"log.level": "loud"}, "debug, info"),
        ({"mapping.profile": "none"}, "'none', need one of default, paper"),
        ({"mapping.max_range_m": -1.0}, r"mapping\.max_range_m is -1\.0, need a positive number"),
        ({"mapping.beams_per_scan": 1.5}, r"mapping\.beams_per_scan = 1\.5"),
        ({"store.snapshot_scans": 1}, "no setting any more"),
        ({"drain_timeout_s": -1.0}, "number of seconds"),
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
        ("threads = ", "is not TOML"),
        ('threads = "x"', "threads = 'x'"),
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
        }
    )
    assert load_settings(file=write(to_toml(describe(settings)))) == settings
    assert load_settings(file=write(to_toml(describe(Settings())))) == Settings()


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


def test_an_operator_meets_few_settings_each_with_a_description() -> None:
    leaves = describe(Settings())
    n_ros = sum(
        leaf.path.startswith("ros.") for leaf in leaves
    )  # of those who have ROS: nobody else meets them
    assert n_ros <= 16
    assert len(leaves) - n_ros <= 50
    assert sum(leaf.path.startswith("mapping.") for leaf in leaves) <= 14
    assert len({leaf.path for leaf in leaves}) == len(leaves)
    for leaf in leaves:
        assert len(leaf.text) >= 8, leaf.path
        assert leaf.value == leaf.default


def test_what_differs_from_the_default_of_the_profile_is_told() -> None:
    settings = load_settings(overrides={"mapping.profile": "paper", "threads": 3, "mapping.max_range_m": 9.0})
    changed = {
        leaf.path: (leaf.value, leaf.default) for leaf in describe(settings) if leaf.value != leaf.default
    }
    assert changed == {"threads": (3, None), "mapping.max_range_m": (9.0, 20.0)}


def test_the_page_of_settings_is_the_generated_one(root: Path) -> None:
    assert (root / "docs" / "settings.md").read_text() == to_markdown(describe(Settings())) + "\n", (
        "run `make fix`"
    )


@pytest.mark.parametrize("root", ["pot/v1", "Site_1/pot", "a/b/c"])
def test_a_root_is_legal_by_the_rule_of_the_keys(root: str) -> None:
    assert load_settings(overrides={"root": root}).root == root
