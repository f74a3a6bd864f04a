"""What every map of an evaluation is asked: collected while scans are read, and the same for all maps."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from potclient.datasets import RecordedScan, Recording
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import Metrics
from potclient.towns import GauntletRecording, SurveyedRecording
from potserver.evaluation.beams import Beams, labels_of, score_labels
from potserver.evaluation.faces import FaceQuestions, FaceScores
from potserver.evaluation.mappers import Mapper
from potserver.evaluation.near import NearQuestions, NearScores
from potserver.evaluation.openings import OpeningQuestions, OpeningScores
from potserver.evaluation.protocol_1 import Protocol1, Protocol1Scores
from potserver.evaluation.rays import RayScores, score_rays
from potserver.evaluation.rings import LeftOutRings
from potserver.evaluation.surroundings import Visits
from potserver.evaluation.truth import TruthQuestions, TruthScores


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class BeamScores:
    """What a map says about beams that it never saw."""

    metrics: Metrics  # of the ends (occupied) and a point each, uniform from the sensor to 0.05 m before the end (free)
    near: NearScores | None  # none if no beam meets a plane of hits steeply

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {"metrics": self.metrics._asdict(), "near": _json(self.near)}


class BeamQuestions:
    """The points of some beams."""

    def __init__(self, beams: Beams) -> None:
        self._labels, self._near = labels_of(beams), NearQuestions(beams)

    def score(self, mapper: Mapper) -> BeamScores:
        """How a map does."""
        return BeamScores(metrics=score_labels(mapper, self._labels), near=self._near.score(mapper))


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Scores:
    """How one map did."""

    beams: BeamScores
    rings: BeamScores | None  # of rings left out of every scan, if any are
    rays: RayScores | None  # of maps that can be asked for rays
    truth: TruthScores | None  # of places whose truth is known
    faces: FaceScores | None  # likewise
    openings: OpeningScores | None  # of the gauntlet
    protocol_1: Protocol1Scores

    @property
    def headline(self) -> float:
        """(H + N) / 2: NLLs of held-out beams by protocol 1, which thick walls help, and near ends, which they harm."""
        near = self.beams.near
        return float("nan") if near is None else (self.protocol_1.held_out.nll + near.nll) / 2

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        return {
            "headline": self.headline,
            "beams": self.beams.to_json(),
            "rings": _json(self.rings),
            "rays": None if self.rays is None else self.rays._asdict(),
            "truth": _json(self.truth),
            "faces": _json(self.faces),
            "openings": _json(self.openings),
            "protocol_1": self.protocol_1.to_json(),
        }


def _json(scores: Any) -> dict[str, Any] | None:
    return None if scores is None else scores.to_json()


class Questions:
    """What every map is asked after the last scan.

    Args:
        recording: Where the scans are from; if its truth is known, that is asked for too.
        labels: Of the held-out beams, by protocol 1.
        beams: The held-out beams.
        rings: The beams of rings that were left out; none: no rings were.
        visits: All scans.
    """

    def __init__(
        self,
        recording: Recording,
        labels: LabelledPoints,
        beams: Beams,
        rings: Beams | None,
        visits: Visits,
    ) -> None:
        around = visits.of(recording, beams) if isinstance(recording, SurveyedRecording) else None
        self.beams = beams
        self._held_out = BeamQuestions(beams)
        self._rings = None if rings is None else BeamQuestions(rings)
        self.truth = None if around is None else TruthQuestions(around)
        self._faces = None if around is None else FaceQuestions(around)
        self._openings = (
            OpeningQuestions(recording, around.hits)
            if isinstance(recording, GauntletRecording) and around is not None
            else None
        )
        self._protocol_1 = Protocol1(labels, around)

    def __len__(self) -> int:
        return len(self._protocol_1.held_out)

    def score(self, mapper: Mapper) -> Scores:
        """How a map does."""
        return Scores(
            beams=self._held_out.score(mapper),
            rings=None if self._rings is None else self._rings.score(mapper),
            rays=None if mapper.kernel_map is None else score_rays(mapper.kernel_map, self.beams),
            truth=None if self.truth is None else self.truth.score(mapper),
            faces=None if self._faces is None else self._faces.score(mapper),
            openings=None if self._openings is None else self._openings.score(mapper),
            protocol_1=self._protocol_1.score(mapper),
        )


class KeptBack:
    """Splits scan after scan into what maps are given and what they are asked about.

    Args:
        hold_out: Says which beams are kept back.
        left_out: Says which rings are kept back before that, if any.
    """

    def __init__(self, hold_out: HoldOut, left_out: LeftOutRings | None) -> None:
        self._hold_out, self._left_out = hold_out, left_out
        self._labels: list[LabelledPoints] = []
        self._beams: list[Beams] = []
        self._rings: list[Beams] = []
        self.visits = Visits()

    def split(self, scan: RecordedScan, number: int) -> RecordedScan:
        """The part of a scan that maps are given.

        Raises:
            SettingsError: the scan has no rings that can be told apart.
        """
        self.visits.add(scan)
        rest = np.ones(len(scan), np.bool_)
        if self._left_out is not None:
            out = self._left_out.beams(scan)
            self._rings.append(Beams.of_scan(scan, out))
            rest = ~out
        kept = dataclasses.replace(scan, points=scan.points[rest], is_return=scan.is_return[rest])
        given, labels = self._hold_out.split(kept, number)
        self._labels.append(labels)
        held = np.zeros(len(scan), np.bool_)
        held[rest] = self._hold_out.beams(len(kept), number)
        self._beams.append(Beams.of_scan(scan, held))
        return given

    def questions(self, recording: Recording) -> Questions | None:
        """What there is to ask; None if nothing was kept back."""
        labels = LabelledPoints.concatenate(self._labels)
        if not len(labels):
            return None
        rings = Beams.concatenate(self._rings) if self._rings else None
        return Questions(recording, labels, Beams.concatenate(self._beams), rings, self.visits)
