"""The height model of a dictionary: learned from the labels of all its scans."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from potserver.domain.types import Scan
from potserver.numerics.beams import Beams, beam_weights, label_beams, limit_range
from potserver.numerics.heights import HeightModel, fit_heights, ground_of

_BEAMS = 8_000  # of a scan
_GAP_M = 0.05  # before a hit, where nothing is free: the noise of a range
_LOWEST_EYE_M = 0.3  # a sensor on the ground itself tells nothing about heights


def learn_heights(scans: Iterable[Scan], *, max_range_m: float, seed: int) -> HeightModel | None:
    """What labelled points of scans say of heights and ranges; None if no scan can tell.

    Args:
        scans: Of any place; planar ones are left out.
        max_range_m: Longer beams are cut.
        seed: Of the beams drawn, and of free points.
    """
    rng = np.random.default_rng(seed)
    heights, ranges, labels, weights = [], [], [], []
    for scan in scans:
        beams = limit_range(scan.beams, 0.0, max_range_m)
        if scan.is_planar or not beams.is_return.any():
            continue
        ground = ground_of(beams.ends[beams.is_return])
        if -ground.height_m < _LOWEST_EYE_M:
            continue
        drawn = np.sort(rng.permutation(len(beams.ends))[:_BEAMS])
        labelled = label_beams(
            Beams(beams.ends[drawn], beams.is_return[drawn]), free_per_beam=1, gap_m=_GAP_M, rng=rng
        )
        heights.append(ground.below(labelled.points))
        ranges.append(np.hypot(labelled.points[:, 0], labelled.points[:, 1]))
        labels.append(labelled.occupied)
        weights.append(beam_weights(labelled))
    if not heights:
        return None
    return fit_heights(*(np.concatenate(columns) for columns in (heights, ranges, labels, weights)))
