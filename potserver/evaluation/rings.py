"""Rings of a scan, to leave whole ones out: beams between learned beams of one ring are easy to answer.

The rings of a 3D scan are clusters of its beams' elevations. Where these run into each other (a sensor whose beams do not
start in one point), rings are told apart by the order of the beams: ring after ring, each once round. A planar scan is cut into
sectors.
"""

from __future__ import annotations

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan
from potserver.errors import SettingsError
from potserver.numerics.arrays import Int64

SECTOR_RAD = np.radians(5.0)  # of planar scans
_GAP_RAD = np.radians(0.05)  # between the elevations of two rings, at least
_BACK_RAD = np.pi  # a step back in azimuth by more than this begins a new ring
_FEWEST, _MOST = 4, 256
_LEAST_BEAMS = 8  # of a ring, on average
_LARGEST = 3.0  # a ring's beams over those of the average one


class LeftOutRings:
    """Every so many rings of a scan, the same ones in every scan.

    Args:
        every: One ring of so many, at least 2.
    Raises:
        SettingsError: fewer than 2.
    """

    def __init__(self, every: int) -> None:
        if every < 2:
            raise SettingsError(f"rings: leave out one of {every}; need at least 2")
        self._every = every

    def beams(self, scan: RecordedScan) -> Bool:
        """(N,) which beams of a scan lie in rings that are left out.

        Raises:
            SettingsError: no rings can be told apart.
        """
        return np.asarray(ring_numbers(scan) % self._every == self._every // 2)


def ring_numbers(scan: RecordedScan) -> Int64:
    """(N,) the ring of each beam, from 0.

    Raises:
        SettingsError: no rings can be told apart.
    """
    x, y, z = scan.points.astype(np.float64).T
    azimuth = np.arctan2(y, x)
    if scan.is_planar:
        sectors: Int64 = np.floor((azimuth + np.pi) / SECTOR_RAD).astype(np.int64)
        return sectors
    ways: list[Int64] = []
    if len(azimuth) > 1:
        ways = [_by_elevation(np.arctan2(z, np.hypot(x, y))), _by_order(azimuth)]
    for rings in ways:
        sizes = np.bincount(rings)
        if (
            _FEWEST <= len(sizes) <= min(_MOST, len(rings) // _LEAST_BEAMS)
            and sizes.max() <= _LARGEST * sizes.mean()
        ):
            return rings
    raise SettingsError(f"{scan.name}: no rings can be told apart, by elevation or by the order of the beams")


def _by_elevation(elevation: Float64) -> Int64:
    order = np.argsort(elevation, kind="stable")
    rings = np.empty(len(order), np.int64)
    rings[order] = np.cumsum(np.diff(elevation[order], prepend=elevation[order][:1]) > _GAP_RAD)
    return rings


def _by_order(azimuth: Float64) -> Int64:
    step = (np.diff(azimuth) + np.pi) % (2 * np.pi) - np.pi
    onwards = -1.0 if np.median(step) < 0 else 1.0
    seam = np.median(np.abs(step)) / 2  # before the azimuth of the first beam: rings begin at about that
    turned = (onwards * (azimuth - azimuth[0]) + seam) % (2 * np.pi)
    rings: Int64 = np.cumsum(np.diff(turned, prepend=turned[:1]) < -_BACK_RAD)
    return rings
