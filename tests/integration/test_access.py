"""Roles over real sessions: what `potserver acl` writes, who can do what under it, and what those are told who cannot."""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from potclient import AccessError, FeedOptions, LostReplyError, MapClient, SessionOptions, UsageError
from potclient.diagnosis import missing_file
from potserver.adapters.access import Roles
from potserver.adapters.access_check import measure
from potserver.adapters.session import ZenohSettings, build_config, open_session
from potserver.cli import main
from potserver.config import load_settings
from potserver.errors import SettingsError
from potserver.server import MapServer

from .scripted import free_port

POINTS = np.random.default_rng(3).uniform(-5, 5, (400, 3)).astype(np.float32)
Client = Callable[..., MapClient]


def write(folder: Path, *options: str) -> int:
    """Ports are free ones, so that several tests may run at once."""
    port = free_port()
    who = ("--robots", "r1,r2", "--planners", "p1", "--operators", "ops", "--port", str(port))
    assert main(["acl", *who, "-o", str(folder), *options]) == 0
    return port


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Configurations with certificates."""
    folder = tmp_path_factory.mktemp("site")
    write(folder)
    subprocess.run(["sh", str(folder / "certificates.sh")], check=True, capture_output=True, timeout=60)
    return folder


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Configurations with passwords."""
    folder = tmp_path_factory.mktemp("lab")
    write(folder, "--auth", "password")
    return folder


@pytest.fixture(scope="module")
def served(site: Path) -> Iterator[MapServer]:
    """A real server under the configuration with certificates."""
    settings = load_settings(
        overrides={
            "zenoh.config": str(site / "server.json5"),
            "mapping.max_range_m": 15.0,
            "mapping.beams_per_scan": 400,
        }
    )
    with MapServer(settings) as server:
        yield server


@pytest.fixture
def as_one(site: Path, served: MapServer) -> Iterator[Client]:
    """Opens clients under the configurations of the site."""
    clients: list[MapClient] = []

    def open_client(name: str, **options: float) -> MapClient:
        feed = FeedOptions(receipt_timeout_s=options.get("receipt_timeout_s", 10.0))
        session = SessionOptions(config_file=site / f"{name}.json5")
        client = MapClient(options=session, feed=feed, timeout_s=10.0)
        clients.append(client)
        client.wait_ready()
        return client

    yield open_client
    for client in clients:
        client.close()


# --- measured -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["site", "lab"])
def test_everybody_can_do_what_the_roles_say_and_no_more(kind: str, request: pytest.FixtureRequest) -> None:
    folder = request.getfixturevalue(kind)
    roles = Roles.from_json((folder / "roles.json").read_text())
    found = measure(roles, folder)
    assert [finding for finding in found if finding.may != finding.can] == []
    assert {finding.who for finding in found} == {"r1", "r2", "p1", "ops", "(nobody)"}
    assert sum(finding.can for finding in found) == 4 * 6 + 2 * 6 + 2
    bounded = [finding for finding in found if "the size" in finding.deed or "the rate" in finding.deed]
    assert len(bounded) == 4 * 7


def test_the_check_finds_what_is_open_and_what_is_shut(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "open"
    shutil.copytree(lab, folder)
    config = json.loads((folder / "server.json5").read_text())
    rules = {rule["id"]: rule for rule in config["access_control"]["rules"]}
    rules["r1-send"]["key_exprs"] = ["pot/v1/*/in/**"]
    rules["ask"]["key_exprs"] = ["pot/v1/srv/**"]
    (folder / "server.json5").write_text(json.dumps(config))
    assert main(["acl", "--check", "-o", str(folder)]) == 1
    said = capsys.readouterr()
    assert "r1 CAN send clouds as another" in said.err
    assert "p1 cannot ask" in said.err
    assert "r2 CAN" not in said.err
    assert said.out.count("ALLOWED") == 1
    assert said.out.count("DENIED") == 8, "asking, and asking much"


def test_the_check_finds_where_sizes_and_rates_are_not_bounded(
    lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "unbounded"
    shutil.copytree(lab, folder)
    config = json.loads((folder / "server.json5").read_text())
    del config["low_pass_filter"], config["downsampling"]
    (folder / "server.json5").write_text(json.dumps(config))
    assert main(["acl", "--check", "-o", str(folder)]) == 1
    said = capsys.readouterr().err
    for what in ("clouds beyond the size", "poses beyond the size", "poses beyond the rate"):
        assert said.count(f"CAN send {what}") == 2, "both robots"
    assert said.count("CAN ask beyond the size") == 4


# --- with a real server -------------------------------------------------------------------------------------


def test_a_robot_feeds_the_map_and_a_planner_asks(as_one: Client) -> None:
    receipt = as_one("r1").integrate(POINTS, np.eye(4), robot="r1")
    assert receipt.status == "accepted"
    robot = as_one("r2")
    robot.publish(POINTS, np.eye(4), robot="r2")
    assert robot.flush(30.0)
    assert robot.counts().accepted == 1
    planner = as_one("p1")
    assert planner.info().n_scans >= 2
    assert len(planner.occupancy(POINTS[:10]).mean) == 10
    assert as_one("ops").control("clear").verb == "clear"


def test_who_is_denied_is_told_the_likely_cause(as_one: Client, caplog: pytest.LogCaptureFixture) -> None:
    planner = as_one("p1")
    with pytest.raises(LostReplyError, match="access control"):
        planner.control("clear", timeout_s=5.0)
    with pytest.raises(LostReplyError, match="access control"):
        planner.integrate(POINTS, np.eye(4), robot="r1")
    robot = as_one("r1", receipt_timeout_s=0.2)
    with caplog.at_level(logging.WARNING, "potclient"):
        robot.publish(POINTS, np.eye(4), robot="r2")
        assert robot.flush(30.0)
    assert robot.counts().unknown == 1
    assert "its access control may not let this client send as 'r2'" in caplog.text


# --- at the door --------------------------------------------------------------------------------------------


def open_with(folder: Path, **overrides: object) -> None:
    pairs = tuple((key, json.dumps(value)) for key, value in overrides.items())
    MapClient(options=SessionOptions(config_file=folder / "r1.json5", overrides=pairs)).close()


TLS = "transport/link/tls"


@pytest.mark.parametrize(
    ("overrides", "why"),
    [
        ({f"{TLS}/connect_certificate": None, f"{TLS}/connect_private_key": None}, "wants a certificate"),
        ({f"{TLS}/root_ca_certificate": "OTHER/ca.pem"}, "the server's certificate is not accepted"),
        (
            {f"{TLS}/connect_certificate": "OTHER/r1.pem", f"{TLS}/connect_private_key": "OTHER/r1.key"},
            "does not accept the certificate",
        ),
        ({"connect/endpoints": ["tcp/localhost:PORT"]}, "speaks TLS"),
    ],
)
def test_what_is_wrong_with_a_certificate_is_named(
    site: Path, served: MapServer, tmp_path: Path, overrides: dict[str, object], why: str
) -> None:
    write(tmp_path)
    subprocess.run(["sh", str(tmp_path / "certificates.sh")], check=True, capture_output=True, timeout=60)
    port = served.endpoint.rsplit(":", 1)[1]
    text = json.dumps(overrides).replace("OTHER", str(tmp_path)).replace("PORT", port)
    with pytest.raises(AccessError, match=why):
        open_with(site, **json.loads(text))


def test_a_certificate_that_is_not_there_is_named(site: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"cannot read .*gone.pem .*connect_certificate.*No such file"):
        open_with(site, **{f"{TLS}/connect_certificate": "gone.pem"})
    config = json.loads((site / "server.json5").read_text())
    config["transport"]["link"]["tls"]["listen_private_key"] = str(tmp_path / "gone.key")
    (tmp_path / "server.json5").write_text(json.dumps(config))
    settings = ZenohSettings(config=str(tmp_path / "server.json5"))
    built = build_config(settings, root="pot/v1", wire_guard_bytes=1000)
    assert "gone.key" in str(missing_file(built))
    with pytest.raises(SettingsError, match=r"gone.key .*listen_private_key"):
        open_session(built)


def test_a_wrong_password_is_named(lab: Path) -> None:
    settings = ZenohSettings(config=str(lab / "server.json5"))
    session, _ = open_session(build_config(settings, root="pot/v1", wire_guard_bytes=1000))
    with session:
        open_with(lab)
        with pytest.raises(AccessError, match="the user or the password is wrong"):
            open_with(lab, **{"transport/auth/usrpwd/password": "guessed"})
        with pytest.raises(AccessError, match="wants a user and a password"):
            open_with(lab, **{"transport/auth/usrpwd": {}})
