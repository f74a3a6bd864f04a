"""Protocol 2: all scans through all maps, scan by scan, and then the same questions to each, about what none of them saw."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from potclient.datasets import Recording
from potclient.holdout import HoldOut
from potserver.errors import EmptyError
from potserver.evaluation.mappers import Mapper, Size
from potserver.evaluation.questions import KeptBack, Scores
from potserver.evaluation.rings import LeftOutRings


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """How one map did."""

    name: str
    is_batch: bool
    size: Size
    scan_ms: list[float]  # by the clock on the wall; a batch fit is shared out evenly
    cpu_ms: list[float]  # processor time of all threads, which other programs on the machine hardly change
    stage_ms: dict[str, float]  # medians
    scores: Scores

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            "name": self.name,
            "is_batch": self.is_batch,
            **self.size._asdict(),
            "scan_ms": self.scan_ms,
            "cpu_ms": self.cpu_ms,
            "stage_ms": self.stage_ms,
            **self.scores.to_json(),
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


def evaluate(
    dataset: str,
    recording: Recording,
    numbers: Iterable[int],
    mappers: Sequence[Mapper],
    *,
    hold_out: HoldOut,
    left_out: LeftOutRings | None = None,
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
        left_out: Says which rings are left out of every scan; default: none.
        thin: Every so many beams of a scan are looked at.
        on_step: Told what is done next: once a scan, and before each map is judged.
    Raises:
        EmptyError: no scan, or nothing was held out.
        DatasetError: a scan cannot be read.
        PotserverError: a map refuses a scan.
        SettingsError: a scan has no rings to leave out.
    """
    times: dict[str, list[_Took]] = {mapper.name: [] for mapper in mappers}
    stages: dict[str, list[dict[str, float]]] = {mapper.name: [] for mapper in mappers}
    kept_back = KeptBack(hold_out, left_out)
    n_scans = n_beams = 0
    for number in numbers:
        on_step(f"scan {number}")
        whole = recording[number]
        whole = dataclasses.replace(whole, points=whole.points[::thin], is_return=whole.is_return[::thin])
        if not n_scans:
            for mapper in mappers:
                mapper.warm_up(planar=whole.is_planar)
        scan = kept_back.split(whole, number)
        n_scans += 1
        n_beams += len(scan)
        for mapper in mappers:
            start = _Took.now()
            stages[mapper.name].append(mapper.integrate(scan))
            times[mapper.name].append(start.until_now())
    questions = kept_back.questions(recording)
    if questions is None:
        raise EmptyError(f"{dataset}: no scan, or no beam in range: nothing to judge a map by")
    rows: list[Row] = []
    for mapper in mappers:
        on_step(mapper.name)
        start = _Took.now()
        mapper.finish(rows[0].size.cells if rows else 0)
        share = start.until_now() if mapper.is_batch else _Took(0.0, 0.0)
        took = np.array(times[mapper.name]) + np.array(share) / n_scans
        rows.append(
            Row(
                name=mapper.name,
                is_batch=mapper.is_batch,
                size=mapper.size(),
                scan_ms=took[:, 0].tolist(),
                cpu_ms=took[:, 1].tolist(),
                stage_ms=_medians(stages[mapper.name]),
                scores=questions.score(mapper),
            )
        )
    steps = np.diff(np.stack(kept_back.visits.poses)[:, :3, 3], axis=0)
    return Evaluation(
        dataset=dataset,
        n_scans=n_scans,
        n_beams=n_beams,
        path_m=float(np.linalg.norm(steps, axis=1).sum()),
        reach_m=float(questions.beams.lengths.max()),
        rows=rows,
    )


def _medians(stages: list[dict[str, float]]) -> dict[str, float]:
    return {name: float(np.median([s[name] for s in stages])) for name in (stages[0] if stages else {})}
