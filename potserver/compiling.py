"""The numerics compiled by two processes, where nothing has compiled them before: the first start of a server on a machine.

numba compiles one function at a time in a process, which takes half a minute for all, and keeps each one in its cache. A
second process that begins at the other end therefore saves the first one half of the work: each takes from the cache what the
other has compiled.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator

import numpy as np

from potserver.adapters.questions import registry
from potserver.log import get_logger
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.numerics.geometry import bounds

log = get_logger("potserver.server")

_warm: set[str] = set()  # profiles whose numerics this process has


def warm_up(mapper: MappingService) -> None:
    """Compile or load all that scans and questions need, with help if it must be compiled."""
    profile = mapper.settings.profile
    with _helped(profile) if profile not in _warm and _must_compile() else contextlib.nullcontext():
        mapper.warm_up()
        registry.warm_up()
    _warm.add(profile)


def _must_compile() -> bool:
    """Whether a function that all scans need is not in numba's cache."""
    bounds(np.zeros((1, 3)))
    return not bounds.stats.cache_hits


@contextlib.contextmanager
def _helped(profile: str) -> Iterator[None]:
    """A second process compiles during the block; without it the block takes longer and does the same."""
    try:
        helper = subprocess.Popen(
            [sys.executable, "-m", __name__, profile],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the server, which ends its helper
        )
    except OSError as error:
        log.warning("compile_helper_failed", detail=str(error))
        yield
        return
    try:
        yield
    finally:
        # what it is at now is compiled already; numba puts files into its cache whole
        if helper.poll() is None:
            helper.terminate()
        elif helper.returncode:
            log.warning("compile_helper_failed", detail=f"exit code {helper.returncode}")
        helper.wait()


def _help(profile: str) -> None:
    registry.warm_up()
    MappingService(settings=MappingSettings.of_profile(profile), threads=1).warm_up()


if __name__ == "__main__":
    _help(sys.argv[1])
