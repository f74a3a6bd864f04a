"""The systemd unit runs a command that exists, and says nothing that systemd does not know."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from potserver.commands.serve import EXIT_OK
from potserver.commands.shared import EXIT_USAGE


def settings_of(unit: Path) -> dict[str, str]:
    lines = [line for line in unit.read_text().splitlines() if line and line[0] not in "#["]
    return dict(line.split("=", 1) for line in lines)


def test_the_service_runs_a_command_that_exists(
    root: Path, command_faults: Callable[[list[str]], list[str]]
) -> None:
    said = settings_of(root / "systemd" / "potserver.service")
    program, *words = said["ExecStart"].split()
    assert command_faults([Path(program).name, *words]) == []
    assert said["RestartPreventExitStatus"] == str(EXIT_USAGE) != str(EXIT_OK)
    assert words[words.index("--store") + 1].startswith(f"/var/lib/{said['StateDirectory']}/")
    assert f"/var/cache/{said['CacheDirectory']}/" in said["Environment"]


def test_systemd_understands_the_service(root: Path, tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd here")
    unit = tmp_path / "potserver.service"
    text = (root / "systemd" / "potserver.service").read_text()
    unit.write_text(text.replace("/usr/local/lib/potserver/bin/potserver", "/bin/true"))
    told = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(unit)], capture_output=True, text=True, timeout=60
    )
    ours = [line for line in (told.stdout + told.stderr).splitlines() if "potserver" in line]
    assert (told.returncode, ours) == (0, [])
