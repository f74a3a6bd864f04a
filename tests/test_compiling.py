"""A second process compiles the other half of the numerics at a first start."""

from __future__ import annotations

import subprocess
import sys

import pytest

from potserver import MappingService, MappingSettings, compiling


@pytest.fixture
def cold(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if nothing had been compiled yet."""
    monkeypatch.setattr(compiling, "_warm", set())
    monkeypatch.setattr(compiling, "_must_compile", lambda: True)


def test_the_helper_does_its_half() -> None:
    for profile in ("default", "paper"):
        done = subprocess.run(
            [sys.executable, "-m", "potserver.compiling", profile],
            capture_output=True,
            timeout=600,
            check=True,
        )
        assert done.stderr == b""


@pytest.mark.usefixtures("cold")
def test_the_helper_ends_with_the_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    class Noted(subprocess.Popen):  # type: ignore[type-arg]
        def __init__(self, *args: object, **options: object) -> None:
            super().__init__(*args, **options)  # type: ignore[call-overload]
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    mapper = MappingService(settings=MappingSettings(), threads=1)
    compiling.warm_up(mapper)
    (helper,) = started
    assert helper.returncode is not None
    compiling.warm_up(mapper)
    assert len(started) == 1  # once in a process
    assert mapper.n_scans == 0


@pytest.mark.usefixtures("cold")
def test_without_a_helper_the_server_compiles_alone_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    compiling.warm_up(MappingService(settings=MappingSettings(), threads=1))
    assert caplog.text.count("compile_helper_failed") == 1
