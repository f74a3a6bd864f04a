"""A second process compiles the other half of the numerics at a first start."""

from __future__ import annotations

import signal
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
def test_the_helper_ends_when_it_is_told_to() -> None:
    mapper = MappingService(settings=MappingSettings(), threads=1)
    helper = compiling.warm_up(mapper)
    assert helper is not None
    helper.end()
    assert helper.process.returncode in (0, -signal.SIGTERM)
    assert compiling.warm_up(mapper) is None  # once in a process
    assert mapper.n_scans == 0


@pytest.mark.usefixtures("cold")
def test_the_helper_ends_with_a_warm_up_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[compiling.Helper] = []

    class Noted(compiling.Helper):
        def __init__(self, profile: str) -> None:
            super().__init__(profile)
            started.append(self)

    def fail() -> None:
        raise MemoryError

    monkeypatch.setattr(compiling, "Helper", Noted)
    monkeypatch.setattr(compiling.registry, "warm_up", fail)
    with pytest.raises(MemoryError):
        compiling.warm_up(MappingService(settings=MappingSettings(), threads=1))
    (helper,) = started
    assert helper.process.returncode == -signal.SIGTERM


def test_a_helper_that_fails_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    helper = compiling.Helper("no such profile")
    helper.process.wait()
    helper.end()
    assert caplog.text.count("compile_helper_failed") == 1


@pytest.mark.usefixtures("cold")
def test_without_a_helper_the_server_compiles_alone_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    compiling.warm_up(MappingService(settings=MappingSettings(), threads=1))
    assert caplog.text.count("compile_helper_failed") == 1
