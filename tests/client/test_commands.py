"""The client's command line without a server: help, wrong usage, and mistakes that are found before anything is sent."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from potclient.cli import main
from potschemas.keys import CONTROL_VERBS

COMMANDS = (
    "publish",
    "query",
    "grid",
    "rays",
    "risk",
    "export",
    "mirror",
    "view",
    "watch",
    "load",
    "info",
    "atoms",
    "atoms",
    "map",
)


@pytest.mark.parametrize("command", [*COMMANDS, *(f"map {verb}" for verb in CONTROL_VERBS)])
def test_help_teaches(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*command.split(), "--help"])
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


def test_help_names_the_verbs_of_a_map(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert f"the map as a whole: {', '.join(CONTROL_VERBS)}" in text


def test_the_help_lists_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = re.findall(r"^    (\w+) {2,}", capsys.readouterr().out, re.MULTILINE)
    assert set(listed) == {*COMMANDS, "town"}, "town needs no server; its help is tested with the towns"


def test_the_client_imports_nothing_heavy() -> None:
    program = """
import sys, potclient, potclient.cli, potclient.loadtest, potclient.play
heavy = {"torch", "open3d", "numba", "potserver", "matplotlib", "rich", "pypcd4", "plyfile", "scipy", "rerun",
         "skimage", "trimesh", "pyarrow", "laspy", "kiss_icp"} & set(sys.modules)
sys.exit(f"imported {sorted(heavy)}" if heavy else 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], timeout=60, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("words", "usage"),
    [
        (["info", "--bogus"], "info"),
        (["map"], "map"),
        (["map", "save", "--bogus"], "map save"),
        (["map", "load"], "map load"),
        (["map", "merge"], "map merge"),
        (["map", "forget"], "map forget"),
        (["map", "clear", "here"], "map clear"),
        (["map", "load", "here", "--pose", "0", "0", "0", "0"], "map load"),
        (["atoms", "-o", "x.atom"], "atoms"),
        (["atoms", "list", "a"], "atoms list"),
        (["atoms", "list", "-o", "x.atom"], "atoms list"),
        (["atoms", "get"], "atoms get"),
        (["atoms", "add"], "atoms add"),
        (["atoms", "remove"], "atoms remove"),
        (["town", "suburb", "-o", "absent", "--bogus"], "town"),
    ],
)
def test_a_word_that_a_verb_does_not_know_is_answered_with_its_own_usage(
    words: list[str], usage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert err.startswith(f"usage: potclient {usage} [-h]")
    assert err.splitlines()[-1].startswith(f"potclient {usage}: error: ")


@pytest.mark.parametrize(
    ("verb", "has", "lacks"),
    [
        ("map merge", ["--pose", "degrees", "NAME"], []),
        ("map save", ["[NAME]"], ["--pose"]),
        ("map clear", [], ["NAME", "--pose"]),
        ("atoms get", ["ID", "--out"], ["FILE [FILE"]),
        ("atoms add", ["FILE"], ["--out"]),
    ],
)
def test_each_verb_has_its_own_help(
    verb: str, has: list[str], lacks: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*verb.split(), "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: potclient {verb} [-h]")
    assert [word for word in has if word not in text] == []
    assert [word for word in lacks if word in text] == []


def test_flags_of_the_server_may_stand_before_a_verb(capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["-e", "tcp/127.0.0.1:1", "--wait", "0.1"]
    for words in (
        ["map", *flags, "clear"],
        ["map", "clear", *flags],
        ["atoms", *flags, "list"],
        ["atoms", *flags],
    ):
        assert main(words) == 1
        assert "nobody listens at tcp/127.0.0.1:1 within 0.1 s" in capsys.readouterr().err


def test_a_town_goes_into_a_new_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path, tmp_path / "file", tmp_path / "file" / "drive"):
        assert main(["town", "no-such-style", "-o", str(folder)]) == 2
        assert capsys.readouterr().err.startswith(f"potclient: cannot write {folder}: ")


def test_a_folder_without_permission_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)
    assert main(["query", "1", "2", "3", "-o", str(tmp_path / "x.npz")]) == 2
    assert f"no permission to write in {tmp_path}" in capsys.readouterr().err
