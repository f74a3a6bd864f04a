"""What a map says just before surfaces: at the ends of held-out beams, and within half a metre before them.

Only beams that meet their surface at less than 60 degrees are asked: half a metre of a grazing beam is close to the surface all
the way. The surface is the plane through the nearest hits of the scan; ends that lie in no plane are left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from potclient.metrics import score
from potserver.evaluation.beams import Beams
from potserver.evaluation.mappers import Mapper

BINS_M = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.3), (0.3, 0.5))  # before the end
_LEAST_COSINE = 0.5
_LEAST_LENGTH_M = 0.6
_MOST_BEAMS = 20_000


class NearBin(NamedTuple):
    """Free points at a distance before the end; the ends themselves: from 0 to 0 m."""

    from_m: float
    to_m: float
    nll: float
    mean: float  # P(occupied)


class NearScores(NamedTuple):
    """Of beams that meet their surface at less than 60 degrees."""

    n_beams: int
    nll: float  # N: of the ends (occupied) and one point each, uniform in 0.05 to 0.5 m before (free)
    auc: float
    ends: NearBin
    bins: list[NearBin]

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            **self._asdict(),
            "ends": self.ends._asdict(),
            "bins": [found._asdict() for found in self.bins],
        }


class NearQuestions:
    """The points, the same for every map; a beam gives one to each bin.

    Args:
        beams: That no map was given.
    """

    def __init__(self, beams: Beams) -> None:
        rng = np.random.default_rng(1)
        with np.errstate(invalid="ignore"):
            chosen = beams.is_return & (beams.cosine > _LEAST_COSINE) & (beams.lengths > _LEAST_LENGTH_M)
        self._beams = beams.drawn(chosen, _MOST_BEAMS, rng)
        self._n = len(self._beams.ends)
        spans = [(0.0, 0.0), (BINS_M[0][0], BINS_M[-1][1]), *BINS_M]
        self._points = np.concatenate(
            [self._beams.before(rng.uniform(low, high, self._n)) for low, high in spans]
        )

    def score(self, mapper: Mapper) -> NearScores | None:
        """How a map does; None if there is no such beam."""
        if not self._n:
            return None
        n = self._n
        answer = mapper.ask(self._points)
        together = score(answer.mean[: 2 * n], np.arange(2 * n) < n, answer.observed[: 2 * n])

        def binned(part: int, low: float, high: float) -> NearBin:
            rows = slice(part * n, (part + 1) * n)
            truth = np.full(n, high == 0.0)
            scores = score(answer.mean[rows], truth, answer.observed[rows])
            return NearBin(low, high, scores.nll, float(answer.mean[rows].mean()))

        return NearScores(
            n_beams=n,
            nll=together.nll,
            auc=together.auc,
            ends=binned(0, 0.0, 0.0),
            bins=[binned(2 + k, low, high) for k, (low, high) in enumerate(BINS_M)],
        )
