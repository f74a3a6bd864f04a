"""The wheels in fresh environments: they import, their commands answer, the client stays small."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = ["torch", "open3d", "numba", "scipy", "matplotlib", "potserver"]

# Imports every module of the packages that are named, and tells what that loaded, and from where.
IMPORT_ALL = """
import importlib, json, pkgutil, sys
for package in {packages!r}:
    module = importlib.import_module(package)
    for found in pkgutil.walk_packages(module.__path__, package + "."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
print(json.dumps({{"heavy": sorted(set({heavy!r}) & set(sys.modules)),
                  "files": [sys.modules[package].__file__ for package in {packages!r}]}}))
"""


def import_all(venv, packages: list[str]) -> dict:
    done = venv.run("python", "-c", IMPORT_ALL.format(packages=packages, heavy=HEAVY))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_every_module_imports_from_the_wheel(full_venv) -> None:
    loaded = import_all(full_venv, ["potserver", "potclient", "potschemas"])
    assert all(Path(file).is_relative_to(full_venv.folder) for file in loaded["files"]), loaded["files"]


@pytest.mark.parametrize("package", ["potclient", "potschemas"])
def test_every_module_of_the_robots_half_stays_light(full_venv, package: str) -> None:
    assert import_all(full_venv, [package])["heavy"] == []


@pytest.mark.parametrize("command", ["potserver", "potclient"])
def test_the_commands_tell_what_they_do(full_venv, command: str) -> None:
    done = full_venv.run(command, "--help")
    assert done.returncode == 0, done.stderr
    assert command in done.stdout
    assert done.stderr == ""


def test_the_schemas_are_readable_from_the_wheel(full_venv) -> None:
    code = (
        "import json, importlib.resources as r\n"
        "folder = r.files('potschemas') / 'json'\n"
        "print(len([json.loads(f.read_text()) for f in folder.iterdir() if f.name.endswith('.json')]))"
    )
    done = full_venv.run("python", "-c", code)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 0


def test_the_client_wheel_works_alone(client_venv) -> None:
    loaded = import_all(client_venv, ["potclient", "potschemas"])
    assert loaded["heavy"] == []
    assert all(Path(file).is_relative_to(client_venv.folder) for file in loaded["files"]), loaded["files"]
    done = client_venv.run("potclient", "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert not (client_venv.folder / "bin" / "potserver").exists()


@pytest.mark.parametrize(
    ("which", "extras"),
    [
        ("full_venv", ["ros", "view", "web", "odometry", "learn", "towns", "mesh", "files"]),
        ("client_venv", ["ros", "view"]),
    ],
)
def test_the_command_that_is_named_for_a_missing_package_works_before_a_release(
    which: str, extras: list[str], request: pytest.FixtureRequest
) -> None:
    """Without an index: pip knows what an extra needs from the wheel that is installed. Here all of it is there."""
    venv = request.getfixturevalue(which)
    told = venv.run(
        "python", "-c", f"from potclient.extras import how_to_install as h; print(h({','.join(extras)!r}))"
    )
    program, verb, wanted = shlex.split(told.stdout)
    assert (program, verb) == ("pip", "install")
    pip = [sys.executable, "-m", "pip", "--python", str(venv.folder / "bin" / "python")]
    done = subprocess.run(
        [*pip, verb, "--no-index", "--dry-run", wanted],
        capture_output=True,
        text=True,
        timeout=240,
        cwd=venv.folder,
    )
    assert done.returncode == 0, done.stderr
    distribution = wanted.partition("[")[0]
    assert f"{distribution} 0" not in done.stderr, "no extra that the wheel does not have"
