"""Shell completion of both commands."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence

import pytest

from potclient.cli import main as potclient
from potserver.cli import main as potserver

pytest.importorskip("shtab")
Main = Callable[[Sequence[str]], int]


@pytest.mark.parametrize(("name", "main"), [("potclient", potclient), ("potserver", potserver)])
@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_the_script_knows_commands_and_flags(
    name: str, main: Main, shell: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--print-completion", shell])
    assert ended.value.code == 0
    script = capsys.readouterr().out
    for word in {"potclient": ("publish", "odometry"), "potserver": ("serve", "store")}[name]:
        assert word in script


def test_bash_completes_a_command_and_a_flag(capsys: pytest.CaptureFixture[str]) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash here")
    with pytest.raises(SystemExit):
        potclient(["--print-completion", "bash"])
    script = capsys.readouterr().out
    for words, expected in (
        (["potclient", "publ"], "publish"),
        (["potclient", "publish", "--odom"], "--odometry"),
    ):
        program = f"""{script}
COMP_WORDS=({" ".join(words)}); COMP_CWORD={len(words) - 1}
function=$(complete -p potclient | sed 's/.*-F \\([^ ]*\\).*/\\1/')
$function potclient "{words[-1]}" "{words[-2]}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
        told = subprocess.run([bash, "-c", program], capture_output=True, text=True, timeout=60)
        assert expected in told.stdout.split(), told.stderr


def test_a_missing_package_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert potclient(["--print-completion", "bash"]) == 2
    assert "potserver[completion]" in capsys.readouterr().err
