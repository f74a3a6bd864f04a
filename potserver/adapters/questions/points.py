"""`q/points`: occupancy at any points."""

from __future__ import annotations

from potschemas import messages
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.points import Points, PointsPlan
from potserver.codec.base import FLOATS, decode_array
from potserver.codec.occupancy import encode_occupancy
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Occupancy
from potserver.limits import Limits


def decode_points(query: messages.PointsQuery) -> Points:
    """What is asked.

    Raises:
        ShapeError: the array has the wrong dtype, shape or byte count.
    """
    points = decode_array(query.points, "points", FLOATS, (None, (2, 3)))
    return Points(
        points,
        with_gradient=query.with_gradient is True,
        evidence_only=query.evidence_only is True,
    )


def _plan(asked: Asked, query: messages.PointsQuery) -> PointsPlan:
    return decode_points(query).plan(asked.snapshot, asked.limits)


def _encode(plan: PointsPlan, parts: list[Occupancy]) -> messages.Occupancy:
    return encode_occupancy(plan.result(parts))


def _warm_up(kernels: KernelMap) -> None:
    Points([[0.0, 0.0, 0.0]], with_gradient=True).plan(kernels, Limits()).part(0)


QUESTION = Question(op="points", query=messages.PointsQuery, plan=_plan, whole=_encode, warm_up=_warm_up)
