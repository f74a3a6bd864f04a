"""The client's command line without a server: help, wrong usage, and mistakes that are found before anything is sent."""

from __future__ import annotations

import re
import subprocess
import sys

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
    "watch",
    "load",
    "info",
    "atoms",
    "map",
)


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
heavy = {"torch", "open3d", "numba", "potserver", "matplotlib", "rich", "pypcd4", "plyfile", "scipy"} & set(sys.modules)
sys.exit(f"imported {sorted(heavy)}" if heavy else 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], timeout=60, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
