"""How true a map of a surveyed place is: claims by volume, space that nobody saw, and errors beside variances."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.holdout import LabelledPoints
from potclient.metrics import Metrics, score
from potserver.evaluation.mappers import Answer, Mapper
from potserver.evaluation.surroundings import Surroundings

SURE = 0.9  # a claim: occupied above it, free below one minus it
SD_EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
_UNIFORM, _UNIFORM_REACH_M = 60_000, 12.0  # points, and how far from the way
_BALL, _BALL_M = 40_000, 0.5
_LEAST_IN_A_BIN = 50


class VolumeScores(NamedTuple):
    """Of points of a volume. A claim is an observed point with p above 0.9 or below 0.1. NaN: there is no such point."""

    metrics: Metrics
    wrong: float  # share of points that are claimed and claimed wrongly
    called_occupied: float  # share of points
    called_occupied_true: float  # share of those that are
    called_free: float
    called_free_true: float
    unseen: float  # share of points in no scan's line of sight and more than 0.3 m from any hit
    unseen_observed: float  # share of those that the map calls observed
    unseen_sure: float  # share of those that the map makes a claim of

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {**self._asdict(), "metrics": self.metrics._asdict()}


class SdBin(NamedTuple):
    """Observed points of either volume, answered with a standard deviation of p in a range. NaN if they are too few."""

    from_sd: float
    to_sd: float
    n: int
    share: float  # of the observed points
    rms_sd: float
    claimed_brier: float  # mean p (1 - p)
    brier: float  # mean squared error


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TruthScores:
    """How one map did."""

    uniform: VolumeScores  # within 12 m of the way, up to 3 m or the ceiling above the ground
    ball: VolumeScores  # within 0.5 m of held-out hits
    sd: list[SdBin]  # none for maps without variances

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            "uniform": self.uniform.to_json(),
            "ball": self.ball.to_json(),
            "sd": [found._asdict() for found in self.sd],
        }


class _Volume:
    def __init__(self, points: Float64, around: Surroundings) -> None:
        self.points = points
        self.occupied = around.occupied(points)
        self.unseen = around.unseen(points)

    def score(self, answer: Answer) -> VolumeScores:
        as_occupied = answer.observed & (answer.mean > SURE)
        as_free = answer.observed & (answer.mean < 1.0 - SURE)
        return VolumeScores(
            metrics=score(answer.mean, self.occupied, answer.observed),
            wrong=_share((as_occupied & ~self.occupied) | (as_free & self.occupied)),
            called_occupied=_share(as_occupied),
            called_occupied_true=_share(self.occupied[as_occupied]),
            called_free=_share(as_free),
            called_free_true=_share(~self.occupied[as_free]),
            unseen=_share(self.unseen),
            unseen_observed=_share(answer.observed[self.unseen]),
            unseen_sure=_share((as_occupied | as_free)[self.unseen]),
        )


class TruthQuestions:
    """The points, the same for every map."""

    def __init__(self, around: Surroundings) -> None:
        rng = np.random.default_rng(3)
        uniform = around.uniform_points(_UNIFORM, _UNIFORM_REACH_M, rng)
        hits = around.hits_to_draw_from(_BALL, rng)
        away = rng.normal(size=hits.shape) * ([1, 1, 0] if around.planar else 1)
        away /= np.linalg.norm(away, axis=1)[:, None]
        away *= (_BALL_M * rng.random(len(hits)) ** (1 / 2 if around.planar else 1 / 3))[:, None]
        self._uniform, self._ball = _Volume(uniform, around), _Volume(hits + away, around)

    @property
    def labels(self) -> LabelledPoints:
        """The points of both volumes, and what is true of them."""
        volumes = [LabelledPoints(points=v.points, occupied=v.occupied) for v in (self._uniform, self._ball)]
        return LabelledPoints.concatenate(volumes)

    def score(self, mapper: Mapper) -> TruthScores:
        """How a map does."""
        volumes = (self._uniform, self._ball)
        answers = [mapper.ask(volume.points) for volume in volumes]
        uniform, ball = (volume.score(answer) for volume, answer in zip(volumes, answers, strict=True))
        bins = [
            _sd_bin(low, high, answers, [volume.occupied for volume in volumes])
            for low, high in itertools.pairwise(SD_EDGES)
            if answers[0].var is not None
        ]
        return TruthScores(uniform=uniform, ball=ball, sd=bins)


def _sd_bin(low: float, high: float, answers: list[Answer], truths: list[Bool]) -> SdBin:
    observed = np.concatenate([answer.observed for answer in answers])
    p = np.concatenate([answer.mean for answer in answers])[observed]
    var = np.concatenate([answer.var for answer in answers if answer.var is not None])[observed]
    occupied = np.concatenate(truths)[observed]
    sd = np.sqrt(var)
    rows = (sd >= low) & ((sd < high) | (high == SD_EDGES[-1]))
    n = int(rows.sum())
    rms_sd = claimed = brier = float("nan")
    if n >= _LEAST_IN_A_BIN:
        rms_sd = float(np.sqrt(var[rows].mean()))
        claimed = float((p[rows] * (1 - p[rows])).mean())
        brier = float(np.square(p[rows] - occupied[rows]).mean())
    return SdBin(low, high, n, _share(rows), rms_sd, claimed, brier)


def _share(chosen: Bool) -> float:
    return float(chosen.mean()) if len(chosen) else float("nan")
