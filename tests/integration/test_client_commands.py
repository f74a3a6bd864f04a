"""The client's commands against a server: what they print, what they return, and that every mistake is one clear line."""

from __future__ import annotations

import json
import re
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.atoms import Atom
from potclient.client import MapClient
from potclient.errors import NoServerError
from potschemas.messages import Cloud, ErrorCode, Receipt

from .conftest import DEADLINE_S, Run
from .rooms import pose, room
from .scripted import ScriptedServer, free_port, receipt_of

CORNERS = ("--lower", "-2", "-2", "-2", "--upper", "2", "2", "2")


# --- mistakes ------------------------------------------------------------------------------------------------------


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
        (["mirror", "--step", "24"], "0.0001 to 10"),
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["rays"], "give the origin"),
        (["rays", "1", "2"], "need X Y Z"),
        (["rays", "1", "2", "3", "--fan", "0"], "--fan"),
        (["rays", "1", "2", "3", "--max-range", "5", "--quantiles", "0.9", "0.5"], "ascending"),
        (["rays", "--file", "absent.npy"], "absent"),
        (["risk", "--path", "absent.txt", "--sphere", "0", "0", "0", "1"], "absent"),
        (["query", "--file", "absent.txt"], "absent.txt"),
        (["query", "--file", "absent.npy"], "absent.npy"),
        (["export", "bt", "-o", "x"], "--resolution"),
        (["export", "pgm", "-o", "x", "--resolution", "1", *CORNERS], "--above-ground LOW HIGH"),
        (["export", "pgm", "-o", "x", "--resolution", "1", "--band", "1", "0"], "LOW below HIGH"),
        (["export", "mesh", "-o", "x.ply", "--resolution", "1", "--above-ground", "0", "1"], "for pgm"),
        (["export", "mesh", "-o", "x.ply", "--resolution", "1", "--free", "0.2"], "leave out"),
        (["export", "gltf", "-o", "x.ply", "--resolution", "1"], ".glb"),
        (["export", "ply", "-o", "x", "--resolution", "1"], "no cells"),
        (["export", "bt", "-o", "x", "--resolution", "1", "--band", "0", "1"], "--lower"),
        (["query", "1e9", "0", "0"], "out_of_range"),
        (["map", "load", "elsewhere"], "elsewhere"),
        (["info", "--map", "other", "--wait", "0.05"], "maps served here: default"),
    ],
)
def test_other_mistakes_are_one_clear_line_too(run: Run, words: list[str], message: str) -> None:
    status, out, err = run(*words)
    assert status in (1, 2)
    assert out == ""
    assert message in err
    assert len(err.splitlines()) == 1
    assert err.startswith("potclient: ")


def test_no_server_is_status_1_with_a_hint(run_at: Run) -> None:
    status, _, err = run_at(f"tcp/127.0.0.1:{free_port()}", "info")
    assert status == 1
    assert "potserver serve" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "words",
    [
        ["query", "1", "2", "3", "-o", "{}/absent/x.npz"],
        ["query", "1", "2", "3", "--json", "{}/absent/x.json"],
        ["query", "1", "2", "3", "-o", "{}"],
        ["grid", "--resolution", "1", "-o", "{}/absent/x.npz"],
        ["grid", "--resolution", "1", "--png", "{}/absent/x.png"],
        ["rays", "0", "0", "1", "-o", "{}/absent/x.npz"],
        ["risk", "--path", "absent.txt", "--sphere", "0", "0", "0", "1", "--json", "{}/absent/x.json"],
        ["export", "ply", "-o", "{}/absent/x.ply"],
        ["mirror", "--once", "-o", "{}/absent/x.npz"],
        ["atoms", "get", "a", "-o", "{}/absent/a.atom"],
        ["atoms", "--json", "{}/absent/a.json"],
        ["publish", "generated", "--json", "{}/absent/x.json"],
        ["load", "--json", "{}/absent/x.json"],
        ["info", "--json", "{}/absent/x.json"],
    ],
)
def test_unwritable_files_are_one_line_before_anything_is_asked(
    run_at: Run, tmp_path: Path, words: list[str]
) -> None:
    nobody = f"tcp/127.0.0.1:{free_port()}"
    status, out, err = run_at(nobody, *(word.format(tmp_path) for word in words))
    assert (status, out) == (2, "")
    assert err.startswith(f"potclient: cannot write {tmp_path}")
    assert err.count("\n") == 1


def test_a_picture_of_no_known_kind_is_one_line_before_the_question(run_at: Run, tmp_path: Path) -> None:
    nobody = f"tcp/127.0.0.1:{free_port()}"
    status, _, err = run_at(nobody, "grid", "--resolution", "1", "--png", str(tmp_path / "z.txt"))
    assert status == 2
    assert err == f"potclient: cannot draw {tmp_path / 'z.txt'}: a picture ends in .png, .pdf, .svg, .jpg\n"


# --- publish -------------------------------------------------------------------------------------------------------


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
def test_publish_fails_if_a_scan_is_not_accepted(run: Run, how: list[str]) -> None:
    words = ("publish", "generated:2d", "--limit", "2", "--keep-stamps")
    run(*words, "--robot", f"again{len(how)}")
    status, out, _ = run(*words, "--robot", f"again{len(how)}", *how)
    assert status == 1
    assert "0 of 2 scans accepted" in out
    assert "old_seq: cloud " in out


def test_publish_fails_if_a_scan_has_no_receipt(run_at: Run) -> None:
    with ScriptedServer() as server:
        server.on_clouds(lambda robot, cloud: None)
        status, out, _ = run_at(
            server.endpoint, "publish", "generated:2d", "--limit", "2", "--receipt-timeout", "0.1", "-q"
        )
    assert status == 1
    assert "2 unknown" in out


def test_held_out_beams_beyond_the_servers_range_are_told_with_the_flag_that_helps(run: Run) -> None:
    words = ("publish", "generated", "--limit", "3", "--hold-out", "0.2", "-q", "--clear")
    status, _, err = run(*words)
    assert status == 0
    (line,) = [line for line in err.splitlines() if "beyond" in line]
    found = re.match(r"(\d+\.\d)% of the held-out beams end beyond the server's range of 12 m", line)
    assert found is not None
    assert 0.0 < float(found[1]) < 100.0
    assert "--max-range 12" in line
    assert "beyond" not in run(*words, "--max-range", "12")[2]


@pytest.mark.parametrize("how", [[], ["--acknowledged"], ["--json", "-"]])
def test_a_quiet_publish_still_says_why_scans_were_refused(run: Run, how: list[str]) -> None:
    words = ("publish", "generated:2d", "--limit", "3", "--keep-stamps", "--robot", f"quiet{len(how)}", "-q")
    status, _, err = run(*words)
    assert status == 0
    assert "not accepted" not in err
    status, _, err = run(*words, *how)
    assert status == 1
    (line,) = [line for line in err.splitlines() if "not accepted" in line]
    assert line.startswith("not accepted: 3 old_seq (cloud ")


@pytest.mark.parametrize("how", [[], ["--drop", "--rate", "50"]])
def test_publish_ends_soon_after_its_server_died(
    run_at: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: list[str]
) -> None:
    monkeypatch.setattr("potclient.commands.publish.GONE_S", 0.5)
    target = tmp_path / "report.json"
    server, n_clouds = ScriptedServer(), 0

    def die_at_the_third(robot: str, cloud: Cloud) -> Receipt | None:
        nonlocal n_clouds
        n_clouds += 1
        if n_clouds == 3:
            threading.Thread(target=server.close).start()
        return receipt_of(robot, cloud) if n_clouds < 3 else None

    server.on_clouds(die_at_the_third)
    started = time.monotonic()
    words = ("publish", "generated:2d", "-q", "--hold-out", "0.2", "--json", str(target), *how)
    status, out, err = run_at(server.endpoint, *words)
    assert time.monotonic() - started < 10.0
    assert status == 1
    assert "the server is gone; waiting for it for 0.5 s" in err
    assert re.search(r"the server was gone for 0\.5 s; \d+ of \d+ scans had been sent", err.splitlines()[-1])
    assert re.search(r"^2 of \d+ scans accepted", out)
    report = json.loads(target.read_text())
    assert report["counts"]["accepted"] == 2
    assert "the server was gone" in report["failure"]


def test_publish_goes_on_when_its_server_is_back(run_at: Run) -> None:
    with ScriptedServer() as server:

        def leave_and_return(robot: str, cloud: Cloud) -> Receipt:
            if server.n_left == 0:
                server.leave()
                threading.Timer(0.5, server.declare_ready).start()
            return receipt_of(robot, cloud)

        server.on_clouds(leave_and_return)
        words = ("publish", "generated:2d", "--limit", "12", "--rate", "10")
        status, out, err = run_at(server.endpoint, *words)
    assert status == 0
    assert "12 of 12 scans accepted" in out
    assert err.index("the server is gone") < err.index("the server is back")


def test_a_score_that_cannot_be_had_does_not_take_the_report_along(run_at: Run) -> None:
    with ScriptedServer() as server:
        server.on_clouds(receipt_of)
        server.on("info", ErrorCode.INTERNAL)
        status, out, err = run_at(
            server.endpoint, "publish", "generated:2d", "--limit", "2", "--hold-out", "0.2"
        )
    assert status == 1
    assert "2 of 2 scans accepted" in out
    assert "internal" in err


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


# --- questions -----------------------------------------------------------------------------------------------------


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


def test_query_with_gradients(run: Run) -> None:
    status, out, _ = run("query", "0", "0", "0", "--gradient")
    assert status == 0
    assert "dP/dx" in out
    status, out, _ = run("query", "0", "0", "0", "--gradient", "--json", "-")
    assert len(json.loads(out)["gradient"][0]) == 3


def test_grid_writes_a_file_and_a_picture(run: Run, map_client: MapClient, tmp_path: Path) -> None:
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
    status, out, _ = run("grid", "--resolution", "1", "-o", str(out_file))
    assert status == 0, "the box of all kernels"
    map_client.control("clear")
    status, _, err = run("grid", "--resolution", "0.5", "-o", str(out_file))
    assert status == 2
    assert "the map is empty" in err
    status, _, err = run("export", "pgm", "-o", str(tmp_path / "x"), "--resolution", "1")
    assert status == 2
    assert "the map is empty" in err


def test_rays_all_around_and_toward(run: Run, map_client: MapClient, tmp_path: Path) -> None:
    status, out, _ = run("rays", "2", "0", "0", "--fan", "4", "-o", str(tmp_path / "r.npz"))
    assert status == 0
    assert len(out.splitlines()) == 6
    with np.load(tmp_path / "r.npz") as saved:
        assert saved["quantile_m"].shape == (4, 3)
        means = map_client.rays(saved["origins"], saved["directions"], 25.0).mean_m
        np.testing.assert_allclose(saved["mean_m"], means)
    status, out, _ = run("rays", "2", "0", "0", "--toward", "1", "0", "0", "--max-range", "2", "--json", "-")
    tree = json.loads(out)
    assert tree["mean_m"][0] == pytest.approx(2.0, abs=0.1)
    assert tree["unknown_range_m"] == [None]
    np.save(tmp_path / "rays.npy", np.ones((3, 6)))
    status, out, _ = run("rays", "--file", str(tmp_path / "rays.npy"), "--quantiles", "0.5")
    assert status == 0
    assert "q0.5 m" in out


@pytest.mark.parametrize("row", ["1 2 0", "1 2 0 0.5", "1 0 0 1 0 1 0 2 0 0 1 0"])
def test_risk_of_a_path_in_a_file(run: Run, tmp_path: Path, row: str) -> None:
    (tmp_path / "path.txt").write_text(f"{row}\n{row}\n")
    words = ("risk", "--path", str(tmp_path / "path.txt"), "--sphere", "0", "0", "0", "0.3")
    status, out, _ = run(*words)
    assert status == 0
    assert "1.00  2.00  0.00" in out
    tree = json.loads(run(*words, "--json", "-")[1])
    assert f"union {tree['path_union_probability']:.4f}" in out
    assert tree["union_probability"][0] == tree["union_probability"][1] < 0.5
    assert tree["resolution_m"] == 0.15


# --- info, atoms, map ----------------------------------------------------------------------------------------------


def test_info_and_atoms(run: Run, map_client: MapClient, tmp_path: Path) -> None:
    status, out, _ = run("info", "--stats")
    assert status == 0
    assert re.search(r"^server +potserver$", out, re.MULTILINE)
    assert re.search(r"^stats\.uptime_s +\d\d:\d\d:\d\d$", out, re.MULTILINE)
    assert re.search(r"^started_ns +20\d\d-\d\d-\d\dT\d\d:\d\d:\d\dZ$", out, re.MULTILINE)
    assert re.search(r"^stats\.rss_bytes +\d+\.\d [MG]iB$", out, re.MULTILINE)
    assert re.search(r"^limits\.max_cloud_bytes +\d+\.\d MiB$", out, re.MULTILINE)
    status, out, _ = run("info", "--stats", "--json", "-")
    tree = json.loads(out)
    assert tree["server"] == "potserver"
    assert tree["started_ns"] > 10**18, "JSON keeps the numbers"
    assert tree["stats"]["rss_bytes"] > 2**20
    listed = map_client.atoms()
    atom, n = listed[0].atom_id, len(listed)
    status, out, _ = run("atoms")
    assert status == 0
    assert len(out.splitlines()) == n + 1
    assert atom in out
    status, out, _ = run("atoms", "get", atom, "-o", str(tmp_path / "wall.atom"))
    assert status == 0
    assert "source: " in out
    assert len(Atom.load(tmp_path / "wall.atom").kernels) == listed[0].n_kernels
    status, out, _ = run("atoms", "list")
    assert (status, out.count("\n")) == (0, n + 1)
    status, out, _ = run("atoms", "remove", atom)
    assert (status, out) == (0, f"{atom} removed, {n - 1} atoms, until the server restarts\n")
    status, out, _ = run("atoms", "add", str(tmp_path / "wall.atom"), "--json", "-")
    assert status == 0
    assert [(change["atom_id"], change["n_atoms"]) for change in json.loads(out)] == [(atom, n)]


def test_map_verbs(run: Run, map_client: MapClient) -> None:
    def said(*words: str) -> tuple[str, int]:
        status, out, _ = run("map", *words)
        assert status == 0
        found = re.fullmatch(r"(.*) \(revision (\d+)\)\n", out)
        assert found is not None
        return found[1], int(found[2])

    n = map_client.info().n_kernels
    text, revision = said("save", "here")
    assert text.startswith("save: ")
    assert "here" in text
    assert said("clear")[1] == revision + 1
    text, after = said("load", "here")
    assert text.startswith("load: ")
    assert (after, map_client.info().n_kernels) == (revision + 2, n)
    assert said("merge", "here", "--pose", "30", "0", "0", "90")[0].startswith("merge: ")
    turned = room()[:100] @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + np.array([30, 0, 0])
    assert np.median(map_client.occupancy(turned).mean) > 0.6
    assert said("forget", "r1")[0].startswith("forget: ")


def test_a_drained_map_takes_no_more_clouds(run_at: Run, make_rig: Any) -> None:
    rig = make_rig()
    status, out, _ = run_at(rig.server.endpoint, "map", "drain")
    assert status == 0
    assert out.startswith("drain: ")
    assert rig.server.state == "draining"


# --- watch ---------------------------------------------------------------------------------------------------------


def test_watch_ends_by_itself(run: Run) -> None:
    status, out, err = run("watch", "--seconds", "0.05", "--no-stats")
    assert status == 0
    assert "watching map default" in err
    assert out == ""


def test_watch_prints_what_happens(run_at: Run, make_rig: Any) -> None:
    rig = make_rig()
    ended = threading.Event()

    def happen() -> None:
        with MapClient(rig.server.endpoint) as robot:
            while not ended.wait(0.02):
                robot.publish(room(50), pose(), robot="w", wait=True)

    events = threading.Thread(target=happen, daemon=True)
    events.start()
    try:
        status, out, _ = run_at(rig.server.endpoint, "watch", "--seconds", "2.5")
        assert status == 0
        status, lines, _ = run_at(rig.server.endpoint, "watch", "--events", "20", "--json", "--no-stats")
    finally:
        ended.set()
        events.join(DEADLINE_S)
    assert re.search(r"revision \d+: \d+ kernels, 1 tiles changed", out)
    assert re.search(r"w #\d+ accepted, \d+ ms", out)
    assert "potserver serving: default " in out, "the counters come once a second"
    assert len(lines.splitlines()) == 20
    assert {json.loads(line)["event"] for line in lines.splitlines()} == {"revision", "receipt"}


# --- load ----------------------------------------------------------------------------------------------------------


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


def test_load_fails_when_something_is_lost(run_at: Run) -> None:
    words = ("--robots", "1", "--planners", "0", "--hz", "20", "--seconds", "1", "--receipt-timeout", "0.1")
    with ScriptedServer() as server:
        server.on_clouds(lambda robot, cloud: None)
        status, out, _ = run_at(server.endpoint, "load", *words, "--dataset", "generated:2d")
    assert status == 1
    assert "SOMETHING WAS LOST" in out


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
