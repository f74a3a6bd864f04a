"""What the packages import is what they declare, and each dependency has one pin on every Python."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

OURS = {"potserver", "potclient", "potschemas"}
PYTHONS = ["3.10", "3.11", "3.12", "3.13"]


def requirements(table: dict, *extras: str) -> list[Requirement]:
    lines = list(table["dependencies"])
    for extra in extras:
        lines += table["optional-dependencies"][extra]
    return [Requirement(line) for line in lines]


def names(found: list[Requirement]) -> set[str]:
    return {canonicalize_name(requirement.name) for requirement in found}


def imports(folder: Path, *, top_level_only: bool) -> Iterator[tuple[Path, str]]:
    for path in sorted(folder.rglob("*.py")):
        tree = ast.parse(path.read_text())
        for node in tree.body if top_level_only else ast.walk(tree):
            if isinstance(node, ast.Import):
                yield from ((path, alias.name.partition(".")[0]) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                yield path, node.module.partition(".")[0]


def distributions_imported(*folders: Path, top_level_only: bool = False) -> dict[str, str]:
    """Distribution name -> one file that imports it; ours and the standard library left out."""
    providers = importlib.metadata.packages_distributions()
    found = {}
    for folder in folders:
        for path, module in imports(folder, top_level_only=top_level_only):
            if module not in sys.stdlib_module_names and module not in OURS and module != "tomli":
                found[canonicalize_name(providers.get(module, [module])[0])] = path.name
    return found


@pytest.fixture(scope="module")
def client_project(root: Path) -> dict:
    return tomllib.loads((root / "clients" / "pyproject.toml").read_text())["project"]


def test_the_client_imports_only_what_its_wheel_declares(root: Path, client_project: dict) -> None:
    folders = (root / "clients" / "potclient", root / "schemas" / "potschemas")
    extras = client_project["optional-dependencies"]
    allowed = names(requirements(client_project, *extras))
    undeclared = {
        name: file for name, file in distributions_imported(*folders).items() if name not in allowed
    }
    assert undeclared == {}


def test_the_client_loads_with_no_extra_installed(root: Path, client_project: dict) -> None:
    folders = (root / "clients" / "potclient", root / "schemas" / "potschemas")
    needed = distributions_imported(*folders, top_level_only=True)
    allowed = names(requirements(client_project))
    assert {name: file for name, file in needed.items() if name not in allowed} == {}


def test_the_client_declares_nothing_that_it_does_not_use(root: Path, client_project: dict) -> None:
    used = distributions_imported(root / "clients" / "potclient", root / "schemas" / "potschemas")
    declared = requirements(client_project, *client_project["optional-dependencies"])
    here = [r for r in declared if r.marker is None or r.marker.evaluate({"extra": ""})]
    assert names(here) - set(used) == set()


def test_the_server_imports_only_what_it_declares(root: Path, project: dict) -> None:
    allowed = names(requirements(project))
    found = distributions_imported(root / "potserver")
    of_extras = names(requirements(project, "learn", "web"))
    assert {name: file for name, file in found.items() if name not in allowed | of_extras} == {}


def test_the_server_loads_with_no_extra_installed() -> None:
    program = """
import sys
sys.modules |= dict.fromkeys(("starlette", "uvicorn", "prometheus_client", "torch", "open3d"))
import potserver.server, potserver.cli
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


def test_the_client_needs_nothing_that_the_server_does_not(project: dict, client_project: dict) -> None:
    for extra in client_project["optional-dependencies"]:
        theirs = {str(requirement) for requirement in requirements(client_project, extra)}
        ours = [extra] if extra in project["optional-dependencies"] else []
        assert theirs <= {str(requirement) for requirement in requirements(project, *ours)}, extra


def test_extras_that_are_named_where_a_package_is_missing_exist(
    root: Path, project: dict, client_project: dict
) -> None:
    """What a robot's program asks for, both wheels have; what the server's does, the server's has."""
    theirs = set(client_project["optional-dependencies"])
    ours = set(project["optional-dependencies"])
    n_named = 0
    for folder, known in ((root / "clients", ours & theirs), (root / "potserver", ours)):
        for path in folder.rglob("*.py"):
            named = set(re.findall(r"how_to_install\('(\w+)'\)", path.read_text()))
            assert named <= known, path
            n_named += len(named)
    assert n_named > 8


@pytest.mark.parametrize("python", PYTHONS)
def test_every_dependency_has_one_pin_that_fits(
    root: Path, project: dict, client_project: dict, python: str
) -> None:
    machine = {"python_version": python, "python_full_version": f"{python}.1", "platform_system": "Linux"}
    machine |= {"sys_platform": "linux", "platform_machine": "x86_64", "extra": ""}
    lines = [line for line in (root / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    pins: dict[str, Version] = {}
    for pin in map(Requirement, lines):
        if pin.marker is None or pin.marker.evaluate(machine):
            name = canonicalize_name(pin.name)
            assert name not in pins, f"{name} is pinned twice for Python {python}"
            (specifier,) = pin.specifier
            assert specifier.operator == "==", pin
            pins[name] = Version(specifier.version)
    wanted = requirements(project, "dev") + requirements(
        client_project, *client_project["optional-dependencies"]
    )
    for requirement in wanted:
        if requirement.marker is None or requirement.marker.evaluate(machine):
            pinned = pins.get(canonicalize_name(requirement.name))
            assert pinned is not None, f"{requirement.name} has no pin for Python {python}"
            assert pinned in requirement.specifier, f"{requirement} against {pinned}"
