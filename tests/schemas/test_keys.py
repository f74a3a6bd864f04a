"""The key space: what is built, what is refused."""

from __future__ import annotations

import pytest

from potschemas.keys import (
    CONTROL_VERBS,
    DEFAULT_ROOT,
    MapKeys,
    check_id,
    check_map_id,
    check_root,
    robot_of,
    server_of,
    stats_key,
)

KEYS = MapKeys(DEFAULT_ROOT, "site")


def test_keys_are_the_contract() -> None:
    assert KEYS.cloud("r1") == "pot/v1/site/in/r1/cloud"
    assert KEYS.pose("r1") == "pot/v1/site/in/r1/pose"
    assert KEYS.integrate("r1") == "pot/v1/site/in/r1/integrate"
    assert KEYS.receipt("r1") == "pot/v1/site/out/r1/receipt"
    assert KEYS.params("r1") == "pot/v1/site/out/r1/params"
    assert KEYS.revision == "pot/v1/site/ev/revision"
    assert KEYS.query("points") == "pot/v1/site/q/points"
    assert KEYS.control("drain") == "pot/v1/site/ctl/drain"
    assert KEYS.robot_token("r1") == "@pot/v1/robot/r1/site"
    assert KEYS.server_token("s1") == "@pot/v1/srv/s1/site"
    assert stats_key(DEFAULT_ROOT, "s1") == "pot/v1/srv/s1/stats"


def test_verbs_are_the_contract() -> None:
    assert CONTROL_VERBS == ("save", "load", "clear", "drain", "merge", "forget")


@pytest.mark.parametrize("value", ["a", "0", "robot-1", "r_2.left", "a" * 63])
def test_a_legal_id_is_returned(value: str) -> None:
    assert check_id(value, "robot") == value


@pytest.mark.parametrize(
    "value",
    ["", "A", "-a", ".a", "_a", "a b", "a/b", "a*", "**", "$*", "@a", "a\n", "ä", "a" * 64, "a#", "a?"],
)
def test_an_illegal_id_is_refused_and_named(value: str) -> None:
    with pytest.raises(ValueError, match="robot"):
        check_id(value, "robot")


def test_no_map_is_called_like_the_servers_branch() -> None:
    assert check_map_id("srv2") == "srv2"
    with pytest.raises(ValueError, match="srv"):
        check_map_id("srv")
    with pytest.raises(ValueError, match="is not an id"):
        check_map_id("Srv")
    # why: a server and an operation of the same name would share a key
    assert stats_key(DEFAULT_ROOT, "q") == MapKeys(DEFAULT_ROOT, "srv").query("stats")


@pytest.mark.parametrize("root", ["pot/v1", "pot", "a/b/c/d", "Site 1".replace(" ", "_")])
def test_a_root_may_have_any_depth(root: str) -> None:
    assert check_root(root) == root


@pytest.mark.parametrize(
    "root", ["", "/", "/pot", "pot/", "a//b", "a/*", "a/**", "a$*", "a#", "a?", "@a/b", "a b", "a\n"]
)
def test_a_root_that_no_key_can_start_with_is_refused(root: str) -> None:
    with pytest.raises(ValueError, match="root"):
        check_root(root)


@pytest.mark.parametrize("root", ["pot/v1", "pot", "in/in/in"])
@pytest.mark.parametrize("robot", ["r1", "in", "cloud", "Not An Id"])
def test_the_robot_is_read_back_from_its_keys(root: str, robot: str) -> None:
    keys = MapKeys(root, "m")
    for build in (keys.cloud, keys.pose, keys.integrate, keys.receipt, keys.params, keys.robot_token):
        assert robot_of(build(robot)) == robot


@pytest.mark.parametrize(
    "key",
    ["", "cloud", "r1/cloud", "in/r1/cloud", KEYS.revision, KEYS.query("points"), KEYS.server_token("s1")],
)
def test_a_key_without_a_robot_is_refused(key: str) -> None:
    with pytest.raises(ValueError, match="robot"):
        robot_of(key)


@pytest.mark.parametrize("root", ["pot/v1", "a", "a/b/c"])
def test_the_server_and_the_map_of_a_token(root: str) -> None:
    assert server_of(MapKeys(root, "roof").server_token("s1")) == ("s1", "roof")


@pytest.mark.parametrize("key", ["", "@pot/v1/srv/s1", "@pot/v1/robot/r1/roof", "pot/v1/srv/s1/stats/x"])
def test_keys_that_are_no_token_of_a_server(key: str) -> None:
    with pytest.raises(ValueError, match="not a server's token"):
        server_of(key)
