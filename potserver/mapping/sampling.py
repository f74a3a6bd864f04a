"""Which beams of a scan are learned, which are only asked about, and which points of them transport sees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.domain.types import Scan
from potserver.errors import EmptyError
from potserver.mapping.settings import MappingSettings
from potserver.numerics.beams import Beams, LabelledPoints, cut_range, long_enough

_MOST_CHECKED = 100  # beams a scan, about


class BeamLimits(NamedTuple):
    """What of a scan is used; the settings of the same names say more."""

    min_range_m: float
    max_range_m: float
    beams_per_scan: int
    check_share: float

    @staticmethod
    def of(settings: MappingSettings) -> BeamLimits:
        """What drawing beams needs of the settings."""
        return BeamLimits(
            settings.min_range_m, settings.max_range_m, settings.beams_per_scan, settings.check_share
        )


class Draws(NamedTuple):
    """The random choices of one scan. Each use has a generator of its own, so that none changes another."""

    learn: np.random.Generator
    check: np.random.Generator
    surface: np.random.Generator
    own: np.random.Generator  # of the scan's own map: what its sender asks for never changes the overall map

    @staticmethod
    def of(seed: int, n_scans: int) -> Draws:
        """Those of the scan that comes after `n_scans` others."""
        keys: list[tuple[int, ...]] = [(seed, n_scans), *((seed, n_scans, use) for use in (1, 2, 3))]
        return Draws(*(np.random.default_rng(key) for key in keys))


class DrawnBeams(NamedTuple):
    """A scan's beams, limited in range and number; the sensor is the origin, the axes are the map's."""

    learned: Beams
    checked: Beams  # never learned, only asked about


def draw_beams(scan: Scan, limits: BeamLimits, draws: Draws) -> DrawnBeams:
    """Limit a scan's beams, and keep some of them for the self-check.

    Raises:
        EmptyError: no beam is long enough.
    """
    drawn = long_enough(scan.points, limits.min_range_m)
    if len(drawn) == 0:
        raise EmptyError(
            f"none of {len(scan.points)} beams is longer than {limits.min_range_m} m: nothing to learn from"
        )
    if len(drawn) > limits.beams_per_scan:
        drawn = drawn[np.sort(draws.learn.choice(len(drawn), limits.beams_per_scan, replace=False))]
    is_checked = draws.check.random(len(drawn)) < min(limits.check_share, _MOST_CHECKED / len(drawn))
    is_checked[0] &= not is_checked.all()  # something must be learned
    beams = cut_range(scan.beams_at(drawn), limits.max_range_m)
    return DrawnBeams(beams.take(~is_checked), beams.take(is_checked))


def thin_beams(labelled: LabelledPoints, n_beams: int, limit: int, draws: Draws) -> LabelledPoints:
    """The points of at most `limit` of the `n_beams` beams."""
    if n_beams <= limit:
        return labelled
    drawn = np.zeros(n_beams, bool)
    drawn[draws.learn.choice(n_beams, limit, replace=False)] = True
    members = drawn[labelled.beam]
    return LabelledPoints(labelled.points[members], labelled.occupied[members], labelled.beam[members])
