"""Where a map puts the faces of a surveyed place: the first point along held-out beams where p is 0.5 or more, or unknown."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Float64
from potserver.evaluation.mappers import Mapper
from potserver.evaluation.surroundings import Surroundings

_MOST_BEAMS = 2_500
_REACH_M, _STEP_M = 1.2, 0.02  # before and behind the surface
_SAME_SURFACE_M = 0.15  # between the measured and the true range
_LEAST_CROSSINGS = 20
_UPRIGHT = 0.5  # |z| of a face's normal, at most
_RANGES_M = (5.0, 10.0)
_COSINES = (0.7, 0.35)  # of incidence: some 45 and 70 degrees


class Crossings(NamedTuple):
    """Of beams; cm before the true face, negative behind it. NaN if there are few.

    Beams that are over 0.5 already 1.2 m before the face, and those that never are, have no crossing.
    """

    n: int  # beams
    median_cm: float
    p95_cm: float
    iqr_cm: float
    early: float  # share of beams that are over 0.5 already 1.2 m before
    missed: float  # share that are not, up to 1.2 m behind

    @staticmethod
    def of(crossing_m: Float64, early: Bool, missed: Bool) -> Crossings:
        """The statistics of beams (N,)."""
        n = len(crossing_m)
        cm = 100.0 * crossing_m[~early & ~missed]
        q25, median, q75, p95 = (
            np.percentile(cm, [25, 50, 75, 95]) if len(cm) >= _LEAST_CROSSINGS else np.full(4, np.nan)
        ).tolist()
        shares = (float(early.mean()), float(missed.mean())) if n else (float("nan"), float("nan"))
        return Crossings(n, median, p95, q75 - q25, *shares)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FaceScores:
    """How one map did."""

    upright: Crossings
    level: Crossings  # grounds, roofs, ceilings
    upright_by_range: dict[str, Crossings]
    upright_by_incidence: dict[str, Crossings]

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            "upright": self.upright._asdict(),
            "level": self.level._asdict(),
            "upright_by_range": {k: found._asdict() for k, found in self.upright_by_range.items()},
            "upright_by_incidence": {k: found._asdict() for k, found in self.upright_by_incidence.items()},
        }


class FaceQuestions:
    """The points along beams, the same for every map. Beams that meet something that has gone since are left out."""

    def __init__(self, around: Surroundings) -> None:
        rng = np.random.default_rng(2)
        beams = around.beams.drawn(around.beams.is_return, 2 * _MOST_BEAMS, rng)
        measured = beams.lengths
        rays = (beams.ends - beams.origins) / measured[:, None]
        true, normals = around.surfaces(beams.origins, rays)
        good = np.flatnonzero((np.abs(true - measured) < _SAME_SURFACE_M) & (true > _REACH_M))
        good = np.sort(rng.permutation(good)[:_MOST_BEAMS])
        origins, rays, normals, self._range_m = beams.origins[good], rays[good], normals[good], true[good]
        self._cosine = np.abs(np.einsum("nd,nd->n", rays, normals))
        self._upright: Bool = np.asarray(np.abs(normals[:, 2]) < _UPRIGHT)
        self._before_m = np.arange(_REACH_M, -_REACH_M - _STEP_M / 2, -_STEP_M)
        along = self._range_m[:, None] - self._before_m
        self._points = (origins[:, None] + along[..., None] * rays[:, None]).reshape(-1, 3)

    def score(self, mapper: Mapper) -> FaceScores:
        """How a map does."""
        p = mapper.ask(self._points).mean.reshape(-1, len(self._before_m))
        over = p >= 0.5
        early: Bool = np.asarray(over[:, 0])
        missed: Bool = np.asarray(~over.any(axis=1))
        after = np.maximum(over.argmax(axis=1), 1)
        rows = np.arange(len(p))
        below, above = p[rows, after - 1], p[rows, after]
        share = np.clip((0.5 - below) / np.maximum(above - below, 1e-9), 0.0, 1.0)
        crossing_m = self._before_m[after - 1] - _STEP_M * share

        def of(chosen: Bool) -> Crossings:
            return Crossings.of(crossing_m[chosen], early[chosen], missed[chosen])

        upright, cosine = self._upright, self._cosine
        nearest, farthest = self._range_m < _RANGES_M[0], self._range_m >= _RANGES_M[1]
        steep, grazing = cosine > _COSINES[0], cosine <= _COSINES[1]
        return FaceScores(
            upright=of(upright),
            level=of(~upright),
            upright_by_range={
                "0-5 m": of(upright & nearest),
                "5-10 m": of(upright & ~nearest & ~farthest),
                "10- m": of(upright & farthest),
            },
            upright_by_incidence={
                "0-45 deg": of(upright & steep),
                "45-70 deg": of(upright & ~steep & ~grazing),
                "70-90 deg": of(upright & grazing),
            },
        )
