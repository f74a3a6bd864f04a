"""The client's command line: what it prints, what it returns, and that every mistake is one clear line."""

from __future__ import annotations

import argparse
import json
import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from potclient.atoms import Atom
from potclient.cli import build_parser, main
from potclient.client import MapClient
from potclient.errors import NoServerError, UsageError
from potclient.session import (
    SessionOptions,
    add_zenoh_arguments,
    build_config,
    open_session,
    options_from_arguments,
)
from potclient.zenoh_config import DEFAULT_ENDPOINT
from potschemas.keys import CONTROL_VERBS
from potschemas.messages import ErrorCode, ReceiptStatus
from tests.integration.fake_server import FakeServer, free_port

COMMANDS = (
    "publish",
    "query",
    "grid",
    "rays",
    "risk",
    "export",
    "mirror",
    "watch",
    "load",
    "info",
    "atoms",
    "map",
)


@pytest.fixture(scope="module")
def server() -> Any:
    with FakeServer() as server:
        yield server


@pytest.fixture(autouse=True)
def fresh(server: FakeServer) -> None:
    server.script.receipts = lambda cloud: ReceiptStatus.ACCEPTED
    server.script.fail.clear()
    server.script.fail_once.clear()


class Run:
    """One command line run in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str], server: FakeServer) -> None:
        self._capsys, self._server = capsys, server

    def __call__(self, *words: str, connect: bool = True) -> tuple[int, str, str]:
        endpoint = ("-e", self._server.endpoint) if connect else ()
        status = main([*words, *endpoint])
        captured = self._capsys.readouterr()
        return status, captured.out, captured.err


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], server: FakeServer) -> Run:
    return Run(capsys, server)


# --- help and usage ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert "--connect" in text
    assert "--map" in text
    assert "%" not in re.sub(r"\d+ ?%", "", text), "argparse formats %; none may be left over"
    if command != "info":
        assert f"potclient {command}" in text.split("examples:")[1]


def test_help_without_a_command_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    for flag, expected in (("--help", "potclient publish generated"), ("--version", "potclient ")):
        with pytest.raises(SystemExit) as ended:
            main([flag])
        assert ended.value.code == 0
        assert expected in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["fly"],
        ["publish"],
        ["publish", "x", "--rate", "0"],
        ["publish", "x", "--rate", "5", "--as-fast"],
        ["publish", "x", "--drop", "--acknowledged"],
        ["grid", "--lower", "0", "0"],
        ["load", "--hz", "nan"],
    ],
)
def test_wrong_usage_ends_with_status_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_file_that_is_not_there_is_named(
    server: FakeServer, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    for suffix in ("txt", "npy"):
        missing = str(tmp_path / f"none.{suffix}")
        assert main(["query", "--file", missing, "-e", server.endpoint]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"potclient: {missing}")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["publish", "/nonexistent"], "no such file"),
        (["publish", "generated", "--limit", "0"], "--limit"),
        (["publish", "generated", "--skip", "1000"], "leaves none"),
        (["publish", "generated", "--hold-out", "2"], "fraction"),
        (["publish", "generated", "--robot", "No Way"], "robot"),
        (["query"], "give coordinates"),
        (["query", "1", "2"], "not whole points"),
        (["query", "1", "2", "nan"], "NaN"),
        (["grid", "--resolution", "1"], "-o FILE or --png FILE"),
        (
            ["grid", "--resolution", "1", "--lower", "1", "1", "1", "--upper", "0", "0", "0", "-o", "x"],
            "lower",
        ),
        (["mirror", "--updates", "0"], "--updates"),
        (["mirror", "--lower", "0", "0", "0"], "both corners"),
        (["mirror", "--lower", "0", "0", "0", "--upper", "1", "-1", "1"], "above upper"),
        (["mirror", "--mantissa-bits", "24"], "2 to 23"),
        (["atoms", "-o", "x.atom"], "-o saves the atom"),
        (["atoms", "list", "a"], "potclient atoms get a"),
        (["atoms", "get"], "one ID"),
        (["atoms", "add"], "name FILEs"),
        (["atoms", "remove"], "name IDs"),
        (["atoms", "add", "/nonexistent.atom"], "No such file"),
        (["info", "--map", "No Way"], "not an id"),
        (["info", "--cfg", "nonsense"], "KEY:VALUE"),
        (["info", "--cfg", "no/such/key:1"], "no/such/key"),
        (["info", "--cfg", "mode:teapot"], "mode"),
        (["info", "-c", "/nonexistent.json5"], "nonexistent"),
        (["load", "--robots", "0", "--planners", "0"], "at least one"),
        (["load", "--points", "0"], "at least one point"),
    ],
)
def test_mistakes_are_one_clear_line_and_status_2(run: Run, words: list[str], message: str) -> None:
    status, out, err = run(*words)
    assert status == 2
    assert message in err
    lines = [line for line in err.splitlines() if line.startswith("potclient: ")]
    assert len(lines) == 1
    assert "Traceback" not in err + out


def test_no_server_is_status_1_with_a_hint(run: Run) -> None:
    status, _, err = run("info", "-e", f"tcp/127.0.0.1:{free_port()}", connect=False)
    assert status == 1
    assert "potserver serve" in err
    assert err.count("\n") == 1


def test_what_the_server_refuses_is_status_1_with_its_code(run: Run, server: FakeServer) -> None:
    server.script.fail["points"] = ErrorCode.OUT_OF_RANGE
    status, _, err = run("query", "1", "2", "3")
    assert status == 1
    assert "out_of_range" in err


def test_unwritable_files_are_one_line(run: Run, tmp_path: Path) -> None:
    status, _, err = run("query", "1", "2", "3", "-o", str(tmp_path / "absent" / "x.npz"))
    assert status == 1
    assert "No such file" in err
    assert err.count("\n") == 1


# --- commands ------------------------------------------------------------------------------------------------------


def test_publish_shows_a_receipt_a_scan_and_scores_held_out_beams(run: Run, tmp_path: Path) -> None:
    target = tmp_path / "report.json"
    status, out, err = run(
        "publish", "generated:2d", "--limit", "3", "--hold-out", "0.2", "--clear", "--json", str(target)
    )
    assert status == 0
    assert out.count("accepted") == 4, "three receipts and the summary"
    assert "3 of 3 scans accepted" in out
    assert re.search(r"ACC 0\.\d+  AUC 0\.\d+  NLL \d", out)
    assert "made-up 2D scene" in err
    report = json.loads(target.read_text())
    assert report["counts"]["accepted"] == 3
    assert [s["status"] for s in report["scans"]] == ["accepted"] * 3
    assert set(report["held_out"]) == {"n", "accuracy", "auc", "nll", "brier", "ece", "share_unknown"}


@pytest.mark.parametrize("how", [[], ["--acknowledged"], ["--drop", "--rate", "100"]])
def test_publish_fails_if_a_scan_is_not_accepted(run: Run, server: FakeServer, how: list[str]) -> None:
    server.script.receipts = lambda cloud: ReceiptStatus.REJECTED
    status, out, _ = run("publish", "generated:2d", "--limit", "2", *how)
    assert status == 1
    assert "0 of 2 scans accepted" in out
    assert "overloaded: scripted" in out


def test_publish_fails_if_a_scan_has_no_receipt(run: Run, server: FakeServer) -> None:
    server.script.receipts = lambda cloud: None
    status, out, _ = run("publish", "generated:2d", "--limit", "2", "--receipt-timeout", "0.1", "-q")
    assert status == 1
    assert "2 unknown" in out


def test_query_in_its_forms(run: Run, tmp_path: Path) -> None:
    status, out, _ = run("query", "1", "2", "-0.5", "3", "4", "5")
    assert status == 0
    assert "P(occupied)" in out
    assert len(out.splitlines()) == 4
    points = np.random.default_rng(0).normal(size=(30, 3))
    np.save(tmp_path / "p.npy", points)
    np.savetxt(tmp_path / "p.txt", points[:, :2])
    status, out, _ = run("query", "--file", str(tmp_path / "p.npy"), "-o", str(tmp_path / "a.npz"))
    assert status == 0
    assert "and 10 more" in out
    with np.load(tmp_path / "a.npz") as answers:
        assert answers["mean"].shape == answers["observed"].shape == (30,)
    status, out, _ = run("query", "--file", str(tmp_path / "p.txt"), "--json", "-")
    assert status == 0
    assert len(json.loads(out)["mean"]) == 30
    (tmp_path / "bad.npy").write_bytes(b"nonsense")
    status, _, err = run("query", "--file", str(tmp_path / "bad.npy"))
    assert status == 2
    assert "not an array of points" in err


def test_grid_writes_a_file_and_a_picture(run: Run, tmp_path: Path) -> None:
    out_file, picture = tmp_path / "g.npz", tmp_path / "g.png"
    box = ("--lower", "-1", "-1", "0", "--upper", "1", "1", "1", "--resolution", "0.5")
    status, out, _ = run("grid", *box, "-o", str(out_file), "--png", str(picture))
    assert status == 0
    assert "4 x 4 x 2 cells" in out
    with np.load(out_file) as grid:
        assert grid["mean"].shape == (4, 4, 2)
        assert float(grid["resolution"]) == 0.5
    assert picture.read_bytes().startswith(b"\x89PNG")
    status, _, err = run("grid", *box, "--png", str(picture), "--level", "9")
    assert status == 2
    assert "outside the grid" in err
    status, _, err = run("grid", "--resolution", "0.5", "-o", str(out_file))
    assert status == 2, "the fake server gives no bounds"
    assert "the map is empty" in err


def test_info_and_atoms(run: Run, tmp_path: Path) -> None:
    status, out, _ = run("info", "--stats")
    assert status == 0
    assert re.search(r"^server +fake$", out, re.MULTILINE)
    assert "stats.uptime_s" in out
    status, out, _ = run("info", "--json", "-")
    assert json.loads(out)["server"] == "fake"
    status, out, _ = run("atoms")
    assert status == 0
    assert "wall.1" in out
    status, out, _ = run("atoms", "get", "wall.1", "-o", str(tmp_path / "wall.atom"))
    assert status == 0
    assert "source: fake" in out
    assert len(Atom.load(tmp_path / "wall.atom").kernels) == 2
    status, out, _ = run("atoms", "add", str(tmp_path / "wall.atom"))
    assert (status, out) == (0, "wall.1 added, 2 atoms, saved\n")
    status, out, _ = run("atoms", "remove", "wall.1", "wall.2", "--json", "-")
    assert status == 0
    assert [change["atom_id"] for change in json.loads(out)] == ["wall.1", "wall.2"]
    status, out, _ = run("atoms", "remove", "wall.1")
    assert out == "wall.1 removed, 0 atoms, until the server restarts\n"


def test_map_verbs(run: Run) -> None:
    def said(*words: str) -> tuple[str, int]:
        status, out, _ = run("map", *words)
        assert status == 0
        text, revision = re.fullmatch(r"(.*) \(revision (\d+)\)\n", out).groups()
        return text, int(revision)

    text, revision = said("save", "here")
    assert text == "save: saved as here"
    assert said("load", "here") == ("load: loaded here", revision + 1)
    assert said("clear") == ("clear: cleared", revision + 2)
    assert said("drain") == ("drain: drained", revision + 2)
    assert said("merge", "here", "--pose", "1", "2", "0", "90")[0] == "merge: merged here at [1.0, 2.0, 0.0]"
    assert said("forget", "rover-1")[0] == "forget: forgot rover-1"
    status, _, err = run("map", "load", "elsewhere")
    assert status == 1
    assert "no map elsewhere" in err
    status, _, err = run("map", "load")
    assert (status, "name a saved map" in err) == (2, True)
    status, _, err = run("map", "clear", "here")
    assert (status, "clear takes no name" in err) == (2, True)
    for words, why in (
        (("merge",), "name a saved map"),
        (("forget",), "name a robot"),
        (("load", "here", "--pose", "0", "0", "0", "0"), "load takes no pose"),
    ):
        status, _, err = run("map", *words)
        assert (status, why in err) == (2, True)


def test_watch_ends_by_itself(run: Run) -> None:
    status, out, err = run("watch", "--seconds", "0.05")
    assert status == 0
    assert "watching map default" in err
    assert out == ""


def test_watch_prints_what_happens(run: Run, server: FakeServer) -> None:
    ended = threading.Event()

    def happen() -> None:
        with MapClient(server.endpoint) as robot:
            while not ended.is_set():
                server.publish_stats()
                robot.publish(np.ones((3, 3)), np.eye(4), robot="w", wait=True)

    events = threading.Thread(target=happen, daemon=True)
    events.start()
    try:
        status, out, _ = run("watch", "--events", "200")
        assert status == 0
        assert len(out.splitlines()) == 200
        status, lines, _ = run("watch", "--events", "200", "--json", "--no-stats")
    finally:
        ended.set()
        events.join()
    assert re.search(r"revision \d+: \d+ kernels, 1 tiles changed", out)
    assert re.search(r"w #\d+ accepted, 1 ms", out)
    assert "fake serving: default " in out
    assert {json.loads(line)["event"] for line in lines.splitlines()} == {"revision", "receipt"}


def test_waiting_for_a_server_that_never_comes_ends(run: Run) -> None:
    status, _, err = run("info", "--map", "other", "--wait", "0.05")
    assert status == 1
    assert "maps served here: default" in err


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), 130), (NoServerError("gone"), 1)])
def test_publish_that_ends_early_still_reports(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, status: int
) -> None:
    publish, n = MapClient.publish, 0

    def fail_at_the_third(self: MapClient, *args: Any, **kwargs: Any) -> int:
        nonlocal n
        n += 1
        if n == 3:
            assert self.flush(30)
            raise error
        return publish(self, *args, **kwargs)

    monkeypatch.setattr(MapClient, "publish", fail_at_the_third)
    target = tmp_path / "report.json"
    got, out, err = run("publish", "generated:2d", "--limit", "5", "--json", str(target))
    assert got == status
    assert "2 of 2 scans accepted" in out
    assert err.splitlines()[-1]
    report = json.loads(target.read_text())
    assert (report["n_scans"], report["failure"]) == (2, str(error) or "interrupted")


def test_an_interrupted_load_reports_and_says_so(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    join, is_first = threading.Thread.join, True

    def interrupted_once(self: threading.Thread, timeout: float | None = None) -> None:
        nonlocal is_first
        if is_first and threading.current_thread() is threading.main_thread():
            is_first = False
            raise KeyboardInterrupt
        join(self, timeout)

    monkeypatch.setattr("potclient.loadtest.threading.Thread.join", interrupted_once)
    words = ["--robots", "1", "--planners", "0", "--seconds", "600", "--dataset", "generated:2d"]
    status, out, err = run("load", *words)
    assert status == 130
    assert "clouds" in out
    assert "interrupted" in err


def test_help_names_the_verbs_of_a_map(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert f"the map as a whole: {', '.join(CONTROL_VERBS)}" in text


def test_load_prints_a_table_and_accounts_for_everything(run: Run, tmp_path: Path) -> None:
    words = ("--robots", "1", "--planners", "1", "--hz", "40", "--seconds", "0.3", "--points", "50")
    status, out, _ = run(
        "load",
        *words,
        "--query-points",
        "20",
        "--dataset",
        "generated:2d",
        "--json",
        str(tmp_path / "l.json"),
    )
    assert status == 0
    assert "every cloud is accounted for" in out
    assert re.search(r"^receipt +\d+ +[\d.]+ +[\d.]+ +[\d.]+ +[\d.]+$", out, re.MULTILINE)
    report = json.loads((tmp_path / "l.json").read_text())
    c = report["clouds"]
    assert c["offered"] == sum(
        c[k] for k in ("dropped_by_client", "accepted", "dropped", "rejected", "unknown")
    )


def test_load_fails_when_something_is_lost(run: Run, server: FakeServer) -> None:
    server.script.receipts = lambda cloud: None
    words = ("--robots", "1", "--planners", "0", "--hz", "20", "--seconds", "0.1", "--receipt-timeout", "0.1")
    status, out, _ = run("load", *words, "--dataset", "generated:2d")
    assert status == 1
    assert "SOMETHING WAS LOST" in out


def test_the_flags_of_all_commands_are_explained() -> None:
    parsers = next(a for a in build_parser()._actions if isinstance(a, argparse._SubParsersAction)).choices
    assert set(parsers) == {*COMMANDS, "town"}, "town needs no server; its help is tested with the towns"


# --- sessions ------------------------------------------------------------------------------------------------------


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
    assert value(config, "transport/shared_memory/enabled") is True


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
        options_of("--cfg", 'mode:"router"', "-m", "peer", "--no-shm", "-l", "tcp/127.0.0.1:0")
    )
    assert value(config, "mode") == "peer"
    assert value(config, "transport/shared_memory/enabled") is False
    assert value(config, "listen/endpoints") == ["tcp/127.0.0.1:0"]


def test_a_word_in_cfg_needs_no_quotes() -> None:
    assert value(build_config(options_of("--cfg", "mode:peer")), "mode") == "peer"


def build_config_with_environment(monkeypatch: pytest.MonkeyPatch, file: Path) -> zenoh.Config:
    monkeypatch.setenv("ZENOH_CONFIG", str(file))
    config = build_config(options_of())
    monkeypatch.delenv("ZENOH_CONFIG")
    return config


def test_sessions_that_cannot_open_say_why() -> None:
    with pytest.raises(NoServerError, match="nobody listens"):
        open_session(SessionOptions(connect=(f"tcp/127.0.0.1:{free_port()}",)))
    for endpoint in ("carrier-pigeon/127.0.0.1:1", "localhost:7447", "tcp/", ""):
        with pytest.raises(UsageError, match="PROTOCOL/ADDRESS"):
            open_session(SessionOptions(connect=(endpoint,)))
