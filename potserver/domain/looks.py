"""Some of the scans of a place, to learn from: spread over all of it, and no more than so many."""

from __future__ import annotations

import dataclasses

import numpy as np

from potserver.domain.types import Scan

MOST_LOOKS = 64
MOST_BEAMS = 30_000  # of each
_FIRST_GAP_M = 0.5  # between two looks


class Looks:
    """Keeps a scan if none was kept so near. Where they become too many, every other one goes, and the gap is doubled.

    One thread takes and forgets; any may read `scans`.
    """

    def __init__(self) -> None:
        self._kept: tuple[Scan, ...] = ()  # as they came; replaced, never changed
        self._gap_m = _FIRST_GAP_M

    @property
    def scans(self) -> tuple[Scan, ...]:
        """Each robot's together, in order."""
        return tuple(sorted(self._kept, key=lambda scan: scan.robot_id))

    def take(self, scan: Scan) -> bool:
        """A scan comes; whether it is kept."""
        if scan.is_planar or any(
            np.linalg.norm(scan.origin - kept.origin) < self._gap_m for kept in self._kept
        ):
            return False
        kept = (*self._kept, _thinned(scan, len(self._kept)))
        if len(kept) > MOST_LOOKS:
            kept, self._gap_m = kept[::2], 2.0 * self._gap_m
        self._kept = kept
        return True

    def forget(self, robot_id: str) -> None:
        """What one robot saw is not learned from."""
        self._kept = tuple(scan for scan in self._kept if scan.robot_id != robot_id)


def _thinned(scan: Scan, seed: int) -> Scan:
    n = len(scan.points)
    if n <= MOST_BEAMS:
        return scan
    drawn = np.sort(np.random.default_rng(seed).choice(n, MOST_BEAMS, replace=False))
    return dataclasses.replace(scan, points=scan.points[drawn], is_return=scan.is_return[drawn])
