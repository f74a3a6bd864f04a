"""The numerics compiled by two processes, where nothing has compiled them before: the first start of a server on a machine.

numba compiles one function at a time in a process, and keeps each one in its cache. A second process that begins elsewhere
saves the first one half of the work: each takes from the cache what the other has compiled. No start waits for what only
those senders need who ask for transported parameters: the second process compiles it when the server is there already.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np

from potserver.adapters.questions import registry
from potserver.log import get_logger
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.numerics import evidence
from potserver.numerics.beams import Beams
from potserver.numerics.geometry import bounds
from potserver.numerics.surface import Normals
from potserver.threads import spawn

log = get_logger("potserver.server")

_warm: set[str] = set()  # profiles whose numerics this process has


class Helper:
    """A process that compiles beside this one; without it all takes longer and is the same."""

    def __init__(self, profile: str) -> None:
        """Start it.

        Raises:
            OSError: the system refuses.
        """
        self.process = subprocess.Popen(
            [sys.executable, "-m", __name__, profile],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the server, which ends its helper
        )
        self._watch = spawn("compile-help", self._wait)

    def end(self) -> None:
        """End it, if it still runs. What it was at is lost: numba puts files into its cache whole."""
        self.process.terminate()
        self._watch.join()

    def _wait(self) -> None:
        code = self.process.wait()
        if code not in (0, -signal.SIGTERM):
            log.warning("compile_helper_failed", detail=f"exit code {code}")


def warm_up(mapper: MappingService) -> Helper | None:
    """Compile or load all that scans and questions need, but for transported parameters.

    Returns:
        Who helped, and may go on with the rest; None where all was compiled before.
    """
    profile = mapper.settings.profile
    helper = _helper(profile) if profile not in _warm and _must_compile() else None
    try:
        mapper.warm_up(transported=False)
        registry.warm_up()
    except BaseException:
        if helper is not None:
            helper.end()
        raise
    _warm.add(profile)
    return helper


def _must_compile() -> bool:
    """Whether a function that all scans need is not in numba's cache."""
    bounds(np.zeros((1, 3)))
    return not bounds.stats.cache_hits


def _helper(profile: str) -> Helper | None:
    try:
        return Helper(profile)
    except OSError as error:
        log.warning("compile_helper_failed", detail=str(error))
        return None


def _help(profile: str) -> None:
    """First what the server comes to last: questions, and the evidence of the map."""
    registry.warm_up()
    _enter_evidence()
    mapper = MappingService(settings=MappingSettings.of_profile(profile), threads=1)
    mapper.warm_up(transported=False)
    os.nice(10)  # the server is there, or about to be
    mapper.warm_up()


def _enter_evidence() -> None:
    """As `mapping.fusion` enters a scan: what its beams see through is taken out, and then rows join."""
    n, fine_m = 100, 0.4
    points = np.random.default_rng(0).normal(0.0, 5.0, (n, 3))
    kind, weight = np.full(n, evidence.HIT, np.uint8), np.ones(n)
    rows = evidence.add(evidence.Rows.empty(), points, kind, weight, fine_m).rows
    beams, faces = Beams(points, np.ones(n, np.bool_)), Normals(points, np.ones(n), np.ones(n))
    evidence.see_through(rows, beams, faces, np.zeros(3), fine_m=fine_m, odds=1.0)
    box = points.min(axis=0), points.max(axis=0)
    joined = evidence.add_sparing(rows, points, kind, weight, fine_m, within=box, turn=1)
    evidence.forget(joined.rows, joined.weight, joined.cells, 1.0)


if __name__ == "__main__":
    _help(sys.argv[1])
