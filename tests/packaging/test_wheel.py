"""The wheel, the sdist and the wheel from the sdist hold the three packages and nothing else."""

from __future__ import annotations

import configparser
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from potschemas import __version__

SOURCES = {"potserver": "potserver", "potclient": "clients/potclient", "potschemas": "schemas/potschemas"}
CLIENT_PACKAGES = {"potclient", "potschemas"}
LEFT_BY_RUNS = {".pyc", ".pyo", ".nbc", ".nbi"}


def names_in(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if not name.endswith("/")}


def packaged(names: set[str]) -> set[str]:
    return {name for name in names if ".dist-info/" not in name}


def read(wheel: Path, name: str) -> str:
    with zipfile.ZipFile(wheel) as archive:
        (path,) = (path for path in archive.namelist() if path.endswith(f".dist-info/{name}"))
        return archive.read(path).decode()


def files_under(root: Path, package: str) -> set[str]:
    """The package's files in the source tree, by the names that they must have in a wheel."""
    folder = root / SOURCES[package]
    return {
        f"{package}/{path.relative_to(folder).as_posix()}"
        for path in folder.rglob("*")
        if path.is_file() and path.suffix not in LEFT_BY_RUNS and "__pycache__" not in path.parts
    }


def test_the_wheel_is_the_three_packages_file_by_file(root: Path, wheel: Path) -> None:
    expected = set().union(*(files_under(root, package) for package in SOURCES))
    assert packaged(names_in(wheel)) == expected


@pytest.mark.parametrize("package", SOURCES)
def test_each_package_is_typed(wheel: Path, package: str) -> None:
    assert {f"{package}/__init__.py", f"{package}/py.typed"} <= names_in(wheel)


@pytest.mark.parametrize("folder", ["potschemas/json", "potschemas/vectors", "potserver/data"])
def test_the_wheel_carries_data(wheel: Path, folder: str) -> None:
    assert [name for name in names_in(wheel) if name.startswith(f"{folder}/") and not name.endswith(".py")]


def test_the_wheel_carries_its_licences_and_both_commands(wheel: Path) -> None:
    assert "Apache License" in read(wheel, "licenses/LICENSE")
    assert "Kenji Koide" in read(wheel, "licenses/NOTICE")
    points = configparser.ConfigParser()
    points.read_string(read(wheel, "entry_points.txt"))
    assert dict(points["console_scripts"]) == {
        "potserver": "potserver.cli:main",
        "potclient": "potclient.cli:main",
    }


def test_both_wheels_have_the_one_version(wheel: Path, client_wheel: Path) -> None:
    for artifact, name in ((wheel, "potserver"), (client_wheel, "potclient")):
        metadata = Parser().parsestr(read(artifact, "METADATA"))
        assert (metadata["Name"], metadata["Version"]) == (name, __version__)


def test_the_sdist_makes_the_same_wheel(wheel: Path, wheel_from_sdist: Path) -> None:
    assert packaged(names_in(wheel_from_sdist)) == packaged(names_in(wheel))
    assert read(wheel_from_sdist, "METADATA") == read(wheel, "METADATA")


def test_the_sdist_can_be_set_up_and_tested(unpacked_sdist: Path) -> None:
    for name in (
        "Makefile",
        "constraints.txt",
        "clients/pyproject.toml",
        "docker/compose.yaml",
        "tests/conftest.py",
    ):
        assert (unpacked_sdist / name).is_file(), name
    assert not (unpacked_sdist / "out").exists()
    assert not (unpacked_sdist / ".venv").exists()


def test_the_client_wheel_is_potclient_and_potschemas_only(root: Path, client_wheel: Path) -> None:
    expected = set().union(*(files_under(root, package) for package in CLIENT_PACKAGES))
    assert packaged(names_in(client_wheel)) - {"potclient/LICENSE"} == expected
    points = configparser.ConfigParser()
    points.read_string(read(client_wheel, "entry_points.txt"))
    assert dict(points["console_scripts"]) == {"potclient": "potclient.cli:main"}
