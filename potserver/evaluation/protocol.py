"""The one protocol: all scans through all maps, scan by scan, and then questions about beams that none of them saw."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan, Recording
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import Metrics, score
from potclient.towns import Town, TownRecording
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Unknown
from potserver.errors import EmptyError
from potserver.evaluation.mappers import Mapper, Size

_RAYS, _RAYS_AT_A_TIME = 4_000, 500  # of each kind, drawn from the held-out beams
_TRUTH_POINTS = 50_000  # of each kind
_NEAR_SURFACE_M = 0.2  # standard deviation of a point from the held-out hit that it is near
_TRUTH_BAND_M = 3.0  # above the ground: uniform points lie below that
_ANSWER_POINTS = 200_000  # asked at a time


class RayScores(NamedTuple):
    """What a map says about where held-out beams end. NaN where there is no beam of the kind."""

    false_return: float  # mean predicted probability that a beam without an echo returns within its length
    range_error_m: float  # median |expected - measured range| of beams with an echo
    n_free: int
    n_returns: int


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """How one map did."""

    name: str
    is_batch: bool
    size: Size
    scan_ms: list[float]  # by the clock on the wall; a batch fit is shared out evenly
    cpu_ms: list[float]  # processor time of all threads, which other programs on the machine hardly change
    stage_ms: dict[str, float]  # medians
    held_out: Metrics
    rays: RayScores | None  # of maps that can be asked for rays
    truth: dict[str, Metrics]  # of towns: `uniform`, `near_surfaces`

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            "name": self.name,
            "is_batch": self.is_batch,
            **self.size._asdict(),
            "scan_ms": self.scan_ms,
            "cpu_ms": self.cpu_ms,
            "stage_ms": self.stage_ms,
            "held_out": self.held_out._asdict(),
            "rays": None if self.rays is None else self.rays._asdict(),
            "truth": {name: metrics._asdict() for name, metrics in self.truth.items()},
        }


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Evaluation:
    """How all maps did on one recording."""

    dataset: str
    n_scans: int
    n_beams: int  # mapped, of all scans
    path_m: float  # that the sensor travelled
    reach_m: float  # of the longest held-out beam
    rows: list[Row]

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            "dataset": self.dataset,
            "n_scans": self.n_scans,
            "n_beams": self.n_beams,
            "path_m": self.path_m,
            "reach_m": self.reach_m,
            "rows": [row.to_json() for row in self.rows],
        }


class _Took(NamedTuple):
    wall_ms: float
    cpu_ms: float

    @staticmethod
    def now() -> _Took:
        return _Took(time.perf_counter() * 1e3, time.process_time() * 1e3)

    def until_now(self) -> _Took:
        now = _Took.now()
        return _Took(now.wall_ms - self.wall_ms, now.cpu_ms - self.cpu_ms)


class _Beams(NamedTuple):
    """Whole beams, map frame."""

    origins: Float64  # (N, 3) m
    ends: Float64  # (N, 3) m
    is_return: Bool  # (N,)


def evaluate(
    dataset: str,
    recording: Recording,
    numbers: Iterable[int],
    mappers: Sequence[Mapper],
    *,
    hold_out: HoldOut,
    thin: int = 1,
    on_step: Callable[[str], None] = lambda what: None,
) -> Evaluation:
    """Integrate scans into all maps, each scan into one after the other, and score them.

    The first map is the one whose number of kernels the batch fits are given.

    Args:
        dataset: Its name, for people.
        recording: Beams already limited in range.
        numbers: Of the scans, in the order of integration; what is held out of a scan depends on its number.
        mappers: Empty maps.
        hold_out: Says which beams are kept back.
        thin: Every so many beams of a scan are looked at.
        on_step: Told what is done next: once a scan, and before each map is judged.
    Raises:
        EmptyError: no scan, or nothing was held out.
        DatasetError: a scan cannot be read.
        PotserverError: a map refuses a scan.
    """
    times: dict[str, list[_Took]] = {mapper.name: [] for mapper in mappers}
    stages: dict[str, list[dict[str, float]]] = {mapper.name: [] for mapper in mappers}
    labels: list[LabelledPoints] = []
    beams: list[_Beams] = []
    track: list[Float64] = []
    n_beams = 0
    for number in numbers:
        on_step(f"scan {number}")
        whole = _thinned(recording[number], thin)
        if not track:
            for mapper in mappers:
                mapper.warm_up(planar=whole.is_planar)
        scan, held = hold_out.split(whole, number)
        labels.append(held)
        beams.append(_held_beams(whole, hold_out.beams(len(whole), number)))
        track.append(scan.T_map_sensor[:3, 3])
        n_beams += len(scan)
        for mapper in mappers:
            start = _Took.now()
            stages[mapper.name].append(mapper.integrate(scan))
            times[mapper.name].append(start.until_now())
        last = whole
    tests = LabelledPoints.concatenate(labels)
    if not len(tests):
        raise EmptyError(f"{dataset}: no scan, or no beam in range: nothing to judge a map by")
    held_beams = _Beams(*(np.concatenate(column) for column in zip(*beams, strict=True)))
    truth = (
        _truth_points(recording.town, recording.lidar.max_range_m, last, np.stack(track), held_beams)
        if isinstance(recording, TownRecording)
        else {}
    )
    rows: list[Row] = []
    for mapper in mappers:
        on_step(mapper.name)
        start = _Took.now()
        mapper.finish(rows[0].size.cells if rows else 0)
        share = start.until_now() if mapper.is_batch else _Took(0.0, 0.0)
        took = np.array(times[mapper.name]) + np.array(share) / len(track)
        rows.append(
            Row(
                name=mapper.name,
                is_batch=mapper.is_batch,
                size=mapper.size(),
                scan_ms=took[:, 0].tolist(),
                cpu_ms=took[:, 1].tolist(),
                stage_ms=_medians(stages[mapper.name]),
                held_out=_score(mapper, tests),
                rays=None if mapper.kernel_map is None else _score_rays(mapper.kernel_map, held_beams),
                truth={name: _score(mapper, points) for name, points in truth.items()},
            )
        )
    steps = np.diff(np.stack(track), axis=0)
    return Evaluation(
        dataset=dataset,
        n_scans=len(track),
        n_beams=n_beams,
        path_m=float(np.linalg.norm(steps, axis=1).sum()),
        reach_m=float(_lengths(held_beams).max()),
        rows=rows,
    )


def _thinned(scan: RecordedScan, thin: int) -> RecordedScan:
    return dataclasses.replace(scan, points=scan.points[::thin], is_return=scan.is_return[::thin])


def _held_beams(scan: RecordedScan, held: Bool) -> _Beams:
    ends = scan.in_map[held]
    return _Beams(np.broadcast_to(scan.T_map_sensor[:3, 3], ends.shape), ends, scan.is_return[held])


def _lengths(beams: _Beams) -> Float64:
    return np.asarray(np.linalg.norm(beams.ends - beams.origins, axis=1))


def _medians(stages: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.median([s[name] for s in stages])) for name in (stages[0] if stages else {})}


def _score(mapper: Mapper, tests: LabelledPoints) -> Metrics:
    parts = [
        mapper.occupancy(tests.points[start : start + _ANSWER_POINTS])
        for start in range(0, len(tests), _ANSWER_POINTS)
    ]
    mean, observed = (np.concatenate(column) for column in zip(*parts, strict=True))
    return score(mean, tests.occupied, observed)


def _score_rays(kernel_map: KernelMap, beams: _Beams) -> RayScores:
    rng = np.random.default_rng(0)
    returned = _drawn(beams, beams.is_return, rng)
    free = _drawn(beams, ~beams.is_return, rng)
    reach_m = float(_lengths(beams).max())
    return RayScores(
        false_return=_mean(_first_returns(kernel_map, free, reach_m)[0]),
        range_error_m=_median(np.abs(_first_returns(kernel_map, returned, reach_m)[1] - _lengths(returned))),
        n_free=len(free.ends),
        n_returns=len(returned.ends),
    )


def _drawn(beams: _Beams, chosen: Bool, rng: np.random.Generator) -> _Beams:
    rows = np.flatnonzero(chosen)
    if len(rows) > _RAYS:
        rows = np.sort(rng.choice(rows, _RAYS, replace=False))
    return _Beams(beams.origins[rows], beams.ends[rows], beams.is_return[rows])


def _first_returns(kernel_map: KernelMap, beams: _Beams, reach_m: float) -> tuple[Float64, Float64]:
    """(N,) probability of a return within a beam's length (with an echo: within `reach_m`), and (N,) m, the expected range."""
    length = _lengths(beams)
    probability, mean_m = np.zeros(len(length)), np.zeros(len(length))
    for start in range(0, len(length), _RAYS_AT_A_TIME):
        part = slice(start, start + _RAYS_AT_A_TIME)
        ends = kernel_map.first_returns(
            np.ascontiguousarray(beams.origins[part]),
            (beams.ends[part] - beams.origins[part]) / length[part, None],
            np.where(beams.is_return[part], reach_m, length[part]),
            step_m=kernel_map.fine_step_m,
            quantiles=np.zeros(0),
            unknown=Unknown.PRIOR,
            width_m=None,
        )
        probability[part], mean_m[part] = ends.hit_probability, ends.mean_m
    return probability, mean_m


def _truth_points(
    town: Town, reach_m: float, last: RecordedScan, track: Float64, beams: _Beams
) -> dict[str, LabelledPoints]:
    """Points whose state at the time of the last scan is known exactly.

    `uniform` ones lie within half the sensor's reach of its way, up to 3 m above the ground; insides of buildings are among
    them. `near_surfaces` are held-out hits, moved at random.
    """
    rng = np.random.default_rng(0)
    planar = town.slice_m is not None
    half = reach_m / 2
    center = track[rng.integers(0, len(track), _TRUTH_POINTS)]
    angle, radius = rng.uniform(0, 2 * np.pi, _TRUTH_POINTS), half * np.sqrt(rng.random(_TRUTH_POINTS))
    top = _TRUTH_BAND_M if town.style.ceiling_m is None else town.style.ceiling_m
    height = np.zeros(_TRUTH_POINTS) if planar else rng.uniform(0, top, _TRUTH_POINTS)
    uniform = np.stack(
        [center[:, 0] + radius * np.cos(angle), center[:, 1] + radius * np.sin(angle), height], axis=1
    )
    hits = beams.ends[beams.is_return]
    near = hits[rng.permutation(len(hits))[:_TRUTH_POINTS]]
    near = near + rng.normal(0.0, _NEAR_SURFACE_M, near.shape) * ([1, 1, 0] if planar else 1)
    time_s = last.stamp_ns / 1e9
    return {
        name: LabelledPoints(points=points, occupied=town.occupied(points, time_s))
        for name, points in (("uniform", uniform), ("near_surfaces", near))
    }


def _mean(values: Float64) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _median(values: Float64) -> float:
    return float(np.median(values)) if len(values) else float("nan")
