"""Beams that no map was given, and what they say: the end is occupied, the way to it is free."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan
from potclient.holdout import LabelledPoints
from potclient.metrics import Metrics, score
from potserver.evaluation.mappers import Mapper
from potserver.evaluation.neighbours import cosines_of_incidence
from potserver.numerics.arrays import Int64

GAP_M = 0.05  # before a beam's end, where no free point lies: the noise of a range


class Beams(NamedTuple):
    """Whole beams, map frame."""

    origins: Float64  # (N, 3) m
    ends: Float64  # (N, 3) m
    is_return: Bool  # (N,)
    cosine: Float64  # (N,) |cosine| of incidence by the hits around; NaN: no echo, or no plane

    @property
    def lengths(self) -> Float64:
        """(N,) m."""
        return np.asarray(np.linalg.norm(self.ends - self.origins, axis=1))

    @property
    def hits(self) -> Float64:
        """(M, 3) m: the ends with an echo."""
        return self.ends[self.is_return]

    def before(self, distance_m: Float64) -> Float64:
        """(N, 3) m: points (N,) m before the ends."""
        return self.ends + (self.origins - self.ends) * (distance_m / self.lengths)[:, None]

    def take(self, rows: Bool | Int64) -> Beams:
        """Some of them, by a mask (N,) or by their numbers."""
        return Beams(self.origins[rows], self.ends[rows], self.is_return[rows], self.cosine[rows])

    def drawn(self, chosen: Bool, most: int, rng: np.random.Generator) -> Beams:
        """Those that a mask (N,) chooses, or so many of them."""
        rows = np.flatnonzero(chosen)
        if len(rows) > most:
            rows = np.sort(rng.choice(rows, most, replace=False))
        return self.take(rows)

    @staticmethod
    def of_scan(scan: RecordedScan, chosen: Bool) -> Beams:
        """Some beams of a scan, by a mask (N,); the planes that they meet are those of all its hits."""
        eye, ends = scan.T_map_sensor[:3, 3], scan.in_map
        cosine = np.full(int(chosen.sum()), np.nan)
        cosine[scan.is_return[chosen]] = cosines_of_incidence(
            ends[scan.is_return], ends[chosen & scan.is_return], eye, planar=scan.is_planar
        )
        return Beams(np.broadcast_to(eye, ends[chosen].shape), ends[chosen], scan.is_return[chosen], cosine)

    @staticmethod
    def concatenate(parts: list[Beams]) -> Beams:
        """All beams in order."""
        return Beams(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def labels_of(beams: Beams) -> LabelledPoints:
    """The ends with an echo (occupied), and a point on each beam, uniform from the sensor to 0.05 m before the end (free)."""
    beams_long = beams.take(beams.lengths > GAP_M)
    lengths = beams_long.lengths
    along = np.random.default_rng(0).random(len(lengths))
    free = beams_long.before(lengths - along * (lengths - GAP_M))
    points = np.concatenate([beams.hits, free])
    return LabelledPoints(points=points, occupied=np.arange(len(points)) < len(beams.hits))


def score_labels(mapper: Mapper, labels: LabelledPoints) -> Metrics:
    """What a map says about points of known state."""
    answer = mapper.ask(labels.points)
    return score(answer.mean, labels.occupied, answer.observed)
