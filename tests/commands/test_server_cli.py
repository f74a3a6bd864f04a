"""The command line: flags to settings, output, exit codes, and no traceback for a user's mistake."""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.atoms import Atom
from potschemas import __version__
from potserver import cli
from potserver.adapters.session import ZenohSettings
from potserver.commands.config import to_toml
from potserver.commands.serve import StopSignals
from potserver.config import Leaf, Settings, as_tree, load_settings
from potserver.domain.dictionary import AtomDictionary
from potserver.log import configure_logging, get_logger


@pytest.fixture(autouse=True)
def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in list(os.environ):
        if name.startswith(("POTSERVER_", "ZENOH_")):
            monkeypatch.delenv(name)


@pytest.fixture(autouse=True)
def keep_logging() -> Iterator[None]:
    root, ours = logging.getLogger(), logging.getLogger("potserver")
    before = root.handlers[:], root.level, ours.level
    yield
    root.handlers[:] = before[0]
    root.setLevel(before[1])
    ours.setLevel(before[2])


def show(capsys: pytest.CaptureFixture[str], *flags: str) -> dict[str, Any]:
    assert cli.main(["config", "show", "--json", *flags]) == 0
    tree: dict[str, Any] = json.loads(capsys.readouterr().out)
    return tree


def test_config_show_prints_a_file_that_can_be_read_back(
    capsys: pytest.CaptureFixture[str], tmp_path: Any
) -> None:
    flags = [
        "--map",
        "a",
        "--map",
        "b",
        "--cfg",
        'connect/endpoints:["tcp/h:3"]',
        "--dictionary",
        'a "b".atoms',
    ]
    assert cli.main(["config", "show", "--in-memory", *flags]) == 0
    file = tmp_path / "settings.toml"
    file.write_text(capsys.readouterr().out)
    assert cli.main(["config", "show", "--json", "--in-memory", *flags]) == 0
    assert as_tree(load_settings(file=file)) == json.loads(capsys.readouterr().out)


def test_config_show_marks_what_is_not_at_its_default(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["config", "show", "--map", "a", "--threads", "2", "--in-memory"]) == 0
    lines = capsys.readouterr().out.splitlines()
    changed = [line for line in lines if "changed" in line]
    assert changed == [
        'maps = ["a"]  # changed; the default is ["default"]',
        "threads = 2  # changed; the default is none",
        'directory = ""  # changed; the default is none',
    ]
    assert {"[limits]", 'server_id = "potserver"', "# dictionary ="} <= set(lines)


def test_what_a_setting_is_stands_above_it() -> None:
    leaves = [
        Leaf("root", "pot/v1", "pot/v1", "text", "first chunks of all keys"),
        Leaf("zenoh.cfg", {"a/b": 5}, {}, "table", "Zenoh keys"),
        Leaf("zenoh.mode", None, "peer", "text", ""),
    ]
    assert to_toml(leaves).splitlines() == [
        "# first chunks of all keys (text)",
        'root = "pot/v1"',
        "",
        "[zenoh]",
        "# Zenoh keys (table)",
        'cfg = {"a/b" = 5}  # changed; the default is {}',
        "# text",
        '# mode =  # changed; the default is "peer"',
    ]


def test_flags_become_settings(capsys: pytest.CaptureFixture[str]) -> None:
    tree = show(
        capsys,
        *("-m", "router", "-e", "tcp/h:1", "-e", "tcp/h:2", "-l", "tcp/127.0.0.1:0", "-c", "z.json5"),
        *("--cfg", "transport/link/tx/lease:5000", "--cfg", 'connect/endpoints:["tcp/h:3"]', "--no-shm"),
        *("--server-id", "s1", "--root", "r", "--profile", "paper", "--threads", "2", "--drain-timeout", "3"),
        *("--log-level", "debug", "--log-format", "json", "--dictionary", "d.npz"),
        *("--set", "limits.max_cloud_points=7", "--set", "intake.robots=r1,r2"),
    )
    assert tree["zenoh"] == {
        "mode": "router",
        "connect": ["tcp/h:1", "tcp/h:2"],
        "listen": ["tcp/127.0.0.1:0"],
        "config": "z.json5",
        "cfg": {"transport/link/tx/lease": "5000", "connect/endpoints": '["tcp/h:3"]'},
        "shared_memory": False,
    }
    assert (tree["server_id"], tree["root"], tree["threads"]) == ("s1", "r", 2)
    assert (tree["drain_timeout_s"], tree["dictionary"]) == (3.0, "d.npz")
    assert tree["mapping"]["profile"] == "paper"
    assert tree["log"] == {"level": "debug", "format": "json"}
    assert tree["limits"]["max_cloud_points"] == 7
    assert tree["intake"]["robots"] == ["r1", "r2"]


def test_variables_are_read(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POTSERVER_THREADS", "9")
    assert show(capsys)["threads"] == 9
    assert show(capsys, "--set", "threads=10")["threads"] == 10


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["config", "show", "--set", "nothing=1"], "no setting 'nothing'"),
        (["config", "show", "--set", "threads"], "need KEY=VALUE"),
        (["config", "show", "--cfg", "mode"], "need KEY:VALUE"),
        (["config", "show", "--settings", "/no/such.toml"], "cannot read settings file"),
        (["config", "show", "--root", "**"], "chunks"),
        (["atoms", "info", "/no/such.atoms"], "no atom dictionary at"),
        (["atoms", "build", "-o", "x.npz"], "recordings to learn from"),
        (["atoms", "info", "--picture", "x.png", "--limit", "0"], "cannot draw 0 atoms"),
        (["atoms", "export", "nope", "-o", "x"], "no atom 'nope'"),
        (["atoms", "import", "/no/such.atom", "-o", "x.atoms"], "cannot read /no/such.atom"),
        (["config", "show", "--set", "atoms.save=true"], "need the setting `dictionary`"),
        (["config", "show", "--set", "atoms.admission.min_auc=1"], "atoms.admission"),
        (["serve", "--map", "A"], "is not an id"),
        (["demo", "--profile", "none"], "need one of default, paper"),
        (["demo", "/no/such/recording"], "/no/such/recording"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_two(
    capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("potserver: ")
    assert captured.err.count("\n") == 1
    assert message in captured.err


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["serve"],
        ["config"],
        ["config", "show"],
        ["atoms"],
        ["atoms", "info"],
        ["atoms", "build"],
        ["atoms", "export"],
        ["atoms", "import"],
        ["map"],
        ["map", "info"],
        ["map", "check"],
        ["map", "upgrade"],
        ["map", "export"],
        ["map", "import"],
        ["map", "merge"],
        ["eval"],
        ["demo"],
    ],
)
def test_help_is_there_at_every_level(capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        cli.main([*words, "--help"])
    assert caught.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: {' '.join(['potserver', *words])}" in text
    assert max(len(line) for line in text.splitlines()) <= 120


def test_no_command_is_help_and_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 2
    assert "usage: potserver" in capsys.readouterr().out


def test_atoms_info_lists_the_dictionary(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["atoms", "info", "--json"]) == 0
    atoms = json.loads(capsys.readouterr().out)
    assert {atom["dims"] for atom in atoms} == {2, 3}
    assert all(atom["provenance"] for atom in atoms)
    assert cli.main(["atoms", "info"]) == 0
    text = capsys.readouterr().out
    assert text.splitlines()[-1].startswith(f"{len(atoms)} atoms, ")
    head, first = text.splitlines()[:2]
    assert head.split()[:8] == ["atom", "dims", "hits", "free", "kernels", "AUC", "NLL", "ECE"]
    assert first.startswith(atoms[0]["atom_id"])
    assert atoms[0]["provenance"]["held_out_auc"] in first


def test_atoms_info_draws_a_picture(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    picture = tmp_path / "atoms.png"
    assert cli.main(["atoms", "info", "--picture", str(picture), "--limit", "1"]) == 0
    assert f"1 atoms drawn to {picture}" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")
    name = AtomDictionary.builtin().of_dims(2).atoms[0].atom_id
    assert cli.main(["atoms", "info", "--picture", "/no/such/folder/x.png", "--atom", name]) == 2
    assert "cannot write" in capsys.readouterr().err


def test_atoms_leave_a_dictionary_and_come_back(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    builtin = AtomDictionary.builtin()
    names = [atom.atom_id for atom in builtin][:2]
    assert cli.main(["atoms", "export", *names, "-o", str(tmp_path / "out")]) == 0
    files = [str(tmp_path / "out" / f"{name}.atom") for name in names]
    assert Atom.load(files[0]).info.atom_id == names[0]  # robots read the same files
    target = tmp_path / "mine.atoms"
    assert cli.main(["atoms", "import", files[0], "-o", str(target)]) == 0
    assert cli.main(["atoms", "import", files[1], "-o", str(target)]) == 0
    back = AtomDictionary.load(target)
    assert [atom.atom_id for atom in back] == names
    np.testing.assert_allclose(
        back.get(names[0]).kernels.hinge_mean, builtin.get(names[0]).kernels.hinge_mean, atol=2e-6
    )
    before = target.read_bytes()
    capsys.readouterr()
    assert cli.main(["atoms", "import", files[0], "-o", str(target)]) == 2
    assert "the dictionary has an atom" in capsys.readouterr().err
    assert target.read_bytes() == before


@pytest.mark.parametrize("words", [[], ["serve"], ["atoms", "build"], ["map", "export"], ["eval"], ["demo"]])
def test_help_loads_none_of_the_numerics(words: list[str]) -> None:
    code = (
        "import runpy, sys\n"
        f"sys.argv = ['potserver', *{words!r}, '--help']\n"
        "try:\n    runpy.run_module('potserver', run_name='__main__')\n"
        "finally:\n    print('loaded:', *sorted({'numba', 'torch', 'open3d', 'matplotlib'} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith(f"usage: {' '.join(['potserver', *words])} ")
    assert run.stdout.splitlines()[-1] == "loaded:"


def test_the_first_signal_sets_a_flag_and_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    with StopSignals.installed() as stop:
        assert stop.name is None
        signal.raise_signal(signal.SIGTERM)
        stop.wait()
        assert stop.name == "SIGTERM"
    assert (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)) == before
    assert signal.set_wakeup_fd(-1) == -1


def test_a_signal_that_another_thread_gets_ends_the_wait() -> None:
    """As one does that comes just before the wait: neither interrupts it."""
    main = threading.main_thread().ident
    assert main is not None

    def kill() -> None:
        while sys._current_frames()[main].f_code is not StopSignals.wait.__code__:
            threading.Event().wait(0.01)
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)

    with StopSignals.installed() as stop:
        thread = threading.Thread(target=kill)
        thread.start()
        stop.wait()
        thread.join()
    assert stop.name == "SIGTERM"


# --- the log ------------------------------------------------------------------------------------------------


def test_events_are_json_lines_with_their_fields() -> None:
    stream = io.StringIO()
    configure_logging("info", "auto", stream)  # not a terminal
    log = get_logger("potserver.test")
    log.info("scan_integrated", n_tiles=3, map_id="default")
    log.debug("not_shown")
    try:
        raise ZeroDivisionError("x")
    except ZeroDivisionError:
        log.exception("scan_failed")
    logging.getLogger("zenoh.handlers").error("callback error")
    integrated, failed, foreign = (json.loads(line) for line in stream.getvalue().splitlines())
    assert (integrated["event"], integrated["n_tiles"], integrated["level"]) == ("scan_integrated", 3, "info")
    assert "timestamp" in integrated
    assert "ZeroDivisionError" in failed["exception"]
    assert foreign["event"] == "callback error"


def test_no_secret_is_logged() -> None:
    stream = io.StringIO()
    configure_logging("debug", "json", stream)
    cfg = {
        "transport/auth/usrpwd/password": "hush",
        "transport/auth": '{usrpwd: {user: "u", password: "hush"}}',
    }
    settings = Settings(zenoh=ZenohSettings(cfg=cfg))
    get_logger("potserver.test").debug("settings_in_use", settings=as_tree(settings))
    assert "hush" not in stream.getvalue()
    assert "usrpwd" in stream.getvalue()


@pytest.mark.parametrize(
    "words",
    [
        ("--cfg", "transport/auth/usrpwd/password:hush"),
        ("--cfg", 'transport/auth:{usrpwd:{user:"u",password:"hush"}}'),
        ("--set", 'zenoh.cfg={"transport/auth/usrpwd/password"="hush"}'),
        ("--connect", "tls/h:7447#connect_private_key_base64=hush"),
    ],
)
def test_secrets_in_the_command_line_are_refused_with_the_way_to_do_it(
    capsys: pytest.CaptureFixture[str], words: tuple[str, str]
) -> None:
    assert cli.main(["config", "show", *words]) == 2
    told = capsys.readouterr()
    assert "--config" in told.err
    assert "POTSERVER_ZENOH__CFG" in told.err
    assert "hush" not in told.err + told.out


@pytest.mark.parametrize("style", ["json", "console"])
def test_no_secret_is_in_a_traceback_that_is_logged(style: str) -> None:
    """Neither in the error's text, nor as the value of a variable on the way."""
    stream = io.StringIO()
    configure_logging("debug", style, stream)
    password = "".join(("hu", "sh"))
    try:
        raise ValueError(f"Zenoh refuses {{usrpwd: {{password: {password!r}}}")
    except ValueError:
        get_logger("potserver.test").exception("session_failed")
    assert "Zenoh refuses" in stream.getvalue()
    assert "hush" not in stream.getvalue()


def test_no_secret_is_in_an_error_about_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("POTSERVER_ZENOH__CFG", '{"transport/auth/usrpwd/password": "hush"}')  # no TOML
    assert cli.main(["config", "show"]) == 2
    told = capsys.readouterr().err
    assert "zenoh.cfg" in told
    assert "hush" not in told


def test_secrets_of_variables_are_taken_and_not_shown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("POTSERVER_ZENOH__CFG", '{"transport/auth/usrpwd/password" = "hush"}')
    for form in ((), ("--json",)):
        assert cli.main(["config", "show", *form]) == 0
        text = capsys.readouterr().out
        assert "usrpwd/password" in text
        assert "hush" not in text


def test_on_a_console_they_are_for_people() -> None:
    stream = io.StringIO()
    configure_logging("debug", "console", stream)
    get_logger("potserver.test").debug("scan_integrated", n_tiles=3)
    assert "scan_integrated" in stream.getvalue()
    assert "n_tiles=3" in stream.getvalue()


def test_the_settings_that_are_logged_are_json() -> None:
    json.dumps(as_tree(Settings()))


def test_serve_help_says_who_may_write(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["serve", "--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert "Anyone who reaches the port may write: `potserver acl` writes access rules and TLS." in text
    assert "security notes" not in text


def _store(capsys: pytest.CaptureFixture[str], *flags: str) -> str | None:
    assert cli.main(["config", "show", "--json", *flags]) == 0
    directory: str | None = json.loads(capsys.readouterr().out)["store"]["directory"]
    return directory


def test_a_server_keeps_its_maps_in_the_users_state_folder_unless_told_otherwise(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert _store(capsys) == str(tmp_path / "potserver" / "potserver")
    assert _store(capsys, "--server-id", "roof") == str(tmp_path / "potserver" / "roof")
    assert _store(capsys, "--store", "maps") == "maps"
    assert _store(capsys, "--in-memory") == ""
    monkeypatch.setenv("POTSERVER_STORE__DIRECTORY", "/var/maps")
    assert _store(capsys) == "/var/maps"
    assert _store(capsys, "--in-memory") == ""
    monkeypatch.delenv("POTSERVER_STORE__DIRECTORY")
    for relative in ("", "state"):
        monkeypatch.setenv("XDG_STATE_HOME", relative)
        monkeypatch.setenv("HOME", str(tmp_path))
        assert _store(capsys) == str(tmp_path / ".local" / "state" / "potserver" / "potserver")


@pytest.mark.parametrize(
    ("words", "usage"),
    [
        (["serve", "--bogus"], "serve"),
        (["map"], "map"),
        (["map", "info", "x", "--bogus"], "map info"),
        (["map", "merge"], "map merge"),
        (["atoms", "info", "--bogus"], "atoms info"),
        (["atoms", "build", "--bogus", "-o", "x"], "atoms build"),
        (["config", "show", "--bogus"], "config show"),
        (["eval", "x", "--bogus"], "eval"),
        (["demo", "--bogus"], "demo"),
    ],
)
def test_a_word_that_a_verb_does_not_know_is_answered_with_its_own_usage(
    words: list[str], usage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(words)
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(f"usage: potserver {usage} [-h]")
    assert err.splitlines()[-1].startswith(f"potserver {usage}: error: ")


def test_the_version_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"potserver {__version__}\n"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["eval", "nowhere", "--json", "{}/absent/x.json"], "cannot write"),
        (["eval", "nowhere", "--markdown", "{}/absent/x.md"], "cannot write"),
        (["map", "export", "nowhere", "-f", "ply", "-o", "{}/absent/x.ply"], "cannot write"),
        (["map", "import", "nowhere", "-o", "{}"], "it is a folder"),
        (["map", "merge", "nowhere", "nowhere", "-o", "{}/file/x.map"], "file is no folder"),
        (["atoms", "export", "nobody", "-o", "{}/file"], "it is no folder"),
        (["atoms", "import", "nowhere", "-o", "{}/absent/x.atoms"], "cannot write"),
        (["atoms", "build", "nowhere", "-o", "{}/absent/x.atoms"], "cannot write"),
        (["atoms", "info", "nowhere", "--picture", "{}/absent/x.png"], "cannot write"),
        (["atoms", "info", "nowhere", "--picture", "{}/x.txt"], "a picture ends in .png, .pdf, .svg, .jpg"),
        (["demo", "nowhere", "--out", "{}/file"], "it is no folder"),
    ],
)
def test_what_cannot_be_written_is_one_line_before_the_work(
    tmp_path: Path, words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert cli.main([word.format(tmp_path) for word in words]) == 2
    err = capsys.readouterr().err
    assert err.startswith("potserver: cannot ")
    assert told in err
    assert err.count("\n") == 1
