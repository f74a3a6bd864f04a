"""What all tests share: places, optional data, the commands' help, and how Hypothesis runs."""

from __future__ import annotations

import functools
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import hypothesis
import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]

# Before anything imports numba or pyplot; the Makefile sets the same cache.
os.environ.setdefault("NUMBA_CACHE_DIR", str(Path(sys.prefix) / "numba-cache"))
os.environ.setdefault("MPLBACKEND", "Agg")

_slow_is_fine = [hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.data_too_large]
hypothesis.settings.register_profile(
    "dev", deadline=None, max_examples=50, suppress_health_check=_slow_is_fine
)
hypothesis.settings.register_profile("ci", hypothesis.settings.get_profile("dev"), derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "dev")


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository's root."""
    return ROOT


@pytest.fixture(scope="session")
def project_file() -> dict:
    """pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture(scope="session")
def project(project_file: dict) -> dict:
    """The `project` table of pyproject.toml."""
    return project_file["project"]


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """The path of an optional data set beside the checkout; skips the test where it is not."""

    def path_of(name: str) -> Path:
        path = ROOT.parent / "shared" / "data" / name
        if not path.exists():
            pytest.skip(f"optional data ../shared/data/{name} not present")
        return path

    return path_of


@pytest.fixture(scope="session")
def make_targets() -> set[str]:
    """The targets that `make` knows."""
    return set(re.findall(r"^([a-z][a-z-]*):(?!=)", (ROOT / "Makefile").read_text(), re.MULTILINE))


@pytest.fixture(scope="session")
def command_faults(project: dict) -> Callable[[list[str]], list[str]]:
    """What is wrong with a command line of ours: its `--help` knows no such sub-command or flag."""

    @functools.cache
    def help_of(*words: str) -> tuple[int, str]:
        module, _, function = project["scripts"][words[0]].partition(":")
        code = (
            f"import sys; from {module} import {function}; sys.argv[0] = {words[0]!r}; sys.exit({function}())"
        )
        run = subprocess.run(
            [sys.executable, "-c", code, *words[1:], "--help"],
            capture_output=True,
            text=True,
            timeout=120,
            env=os.environ | {"COLUMNS": "200", "NO_COLOR": "1"},
        )
        return run.returncode, run.stdout + run.stderr

    def faults(words: list[str]) -> list[str]:
        if words[0] not in project["scripts"]:
            return [f"{words[0]}: not in project.scripts"]
        n_leading = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
        leading, rest = words[:n_leading], words[n_leading:]
        status, text = help_of(*leading)
        line = " ".join(words)
        if status != 0:
            return [f"{line}: `{' '.join(leading)} --help` ends with {status}: {text.strip()[-300:]}"]
        if len(leading) > 1 and " ".join(leading[:2]) not in text:
            return [f"{line}: no sub-command {leading[1]}"]
        known = set(re.findall(r"(?<![\w-])--?[A-Za-z][\w-]*", text))
        return [f"{line}: no flag {word}" for word in rest if _flag(word) and _flag(word) not in known]

    return faults


def _flag(word: str) -> str | None:
    match = re.match(r"--?[A-Za-z][\w-]*", word)
    return match.group() if match else None
