"""`potserver acl`: the files that it writes, without a network."""

from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest

from potserver.cli import main

WHO = ("--robots", "r1,r2", "--planners", "p1", "--operators", "ops")


def write(folder: Path, *options: str) -> None:
    assert main(["acl", *WHO, "-o", str(folder), *options]) == 0


def test_everybody_has_a_configuration_that_nobody_else_can_read(tmp_path: Path) -> None:
    folder = tmp_path / "conf"
    write(folder)
    names = {"server", "r1", "r2", "p1", "ops"}
    assert {path.name for path in folder.iterdir()} == {
        *(f"{name}.json5" for name in names),
        "roles.json",
        "certificates.sh",
    }
    for path in (folder, *folder.iterdir()):
        assert stat.S_IMODE(path.stat().st_mode) & 0o077 == 0


def test_where_everything_is_and_will_lie(tmp_path: Path) -> None:
    write(tmp_path, "--host", "maps.example", "--port", "9000", "--at", "/etc/pot", "--root", "site/v1")
    server = json.loads((tmp_path / "server.json5").read_text())
    assert server["listen"]["endpoints"] == ["tls/0.0.0.0:9000"]
    robot = json.loads((tmp_path / "r1.json5").read_text())
    assert robot["connect"]["endpoints"] == ["tls/maps.example:9000"]
    assert robot["transport"]["link"]["tls"]["connect_private_key"] == "/etc/pot/r1.key"
    keys = [key for rule in server["access_control"]["rules"] for key in rule["key_exprs"]]
    assert all(key.removeprefix("@").startswith("site/v1/") for key in keys)
    assert "DNS:maps.example" in (tmp_path / "certificates.sh").read_text()
    write(tmp_path)
    assert json.loads((tmp_path / "server.json5").read_text())["listen"]["endpoints"] == [
        "tls/127.0.0.1:7447"
    ]


def test_passwords_stay_when_a_robot_comes(tmp_path: Path) -> None:
    write(tmp_path, "--auth", "password")
    before = dict(line.split(":", 1) for line in (tmp_path / "users").read_text().splitlines())
    assert len(set(before.values())) == 4
    assert min(map(len, before.values())) >= 32
    assert main(["acl", "--robots", "r1,r3", "--auth", "password", "-o", str(tmp_path)]) == 0
    after = dict(line.split(":", 1) for line in (tmp_path / "users").read_text().splitlines())
    assert after.keys() == {"r1", "r3"}
    assert after["r1"] == before["r1"]
    assert json.loads((tmp_path / "r3.json5").read_text())["transport"]["auth"]["usrpwd"] == {
        "user": "r3",
        "password": after["r3"],
    }


@pytest.mark.parametrize(
    ("who", "why"),
    [
        (("--robots", "r1", "--planners", "r1"), "stands once"),
        (("--robots", "server"), "none is called 'server'"),
        (("--robots", "R 1"), "is not an id"),
        ((), "name at least one"),
    ],
)
def test_identities_are_checked(
    who: tuple[str, ...], why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["acl", *who, "-o", str(tmp_path)]) == 2
    assert why in capsys.readouterr().err


def test_a_check_needs_what_it_checks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["acl", "--check", "-o", str(tmp_path)]) == 2
    assert "write them first" in capsys.readouterr().err
    (tmp_path / "roles.json").write_text("{}")
    assert main(["acl", "--check", "-o", str(tmp_path)]) == 2
    assert "not the roles" in capsys.readouterr().err
