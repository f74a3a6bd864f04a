"""The height models of a dictionary: one a recording, learned from the labels of its scans."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from potserver.domain.types import Scan
from potserver.numerics.beams import Beams, beam_weights, label_beams, limit_range
from potserver.numerics.heights import HeightLabels, HeightModels, fit_heights, ground_of

_BEAMS = 8_000  # of a scan
_GAP_M = 0.05  # before a hit, where nothing is free: the noise of a range
_LOWEST_EYE_M = 0.3  # a sensor on the ground itself tells nothing about heights


def learn_heights(
    recordings: Iterable[Iterable[Scan]], *, max_range_m: float, seed: int
) -> HeightModels | None:
    """What the labelled points of each recording say of heights and ranges; None if none can tell.

    Args:
        recordings: Some scans of each; planar ones are left out.
        max_range_m: Longer beams are cut.
        seed: Of the beams drawn, and of free points.
    """
    rng = np.random.default_rng(seed)
    models = []
    for scans in recordings:
        told = [labels for scan in scans if (labels := _labels_of(scan, max_range_m, rng)) is not None]
        if told:
            joined = HeightLabels(*(np.concatenate(columns) for columns in zip(*told, strict=True)))
            models.append(fit_heights(joined))
    if not models:
        return None
    return HeightModels(
        models[0].heights_m, models[0].ranges_m, np.stack([model.log_odds for model in models])
    )


def _labels_of(scan: Scan, max_range_m: float, rng: np.random.Generator) -> HeightLabels | None:
    beams = limit_range(scan.beams, 0.0, max_range_m)
    if scan.is_planar or not beams.is_return.any():
        return None
    ground = ground_of(beams.ends[beams.is_return])
    if -ground.height_m < _LOWEST_EYE_M:
        return None
    drawn = np.sort(rng.permutation(len(beams.ends))[:_BEAMS])
    taken = Beams(beams.ends[drawn], beams.is_return[drawn])
    labelled = label_beams(taken, free_per_beam=1, gap_m=_GAP_M, rng=rng)
    reach = np.hypot(labelled.points[:, 0], labelled.points[:, 1])
    return HeightLabels(ground.below(labelled.points), reach, labelled.occupied, beam_weights(labelled))
