"""`q/points`: occupancy at any points."""

from __future__ import annotations

from collections.abc import Iterator

from potschemas import messages
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.points import Points
from potserver.codec.base import FLOATS, decode_array
from potserver.codec.occupancy import encode_occupancy
from potserver.domain.kernel_map import KernelMap
from potserver.limits import Limits


def decode_points(query: messages.PointsQuery) -> Points:
    """What is asked.

    Raises:
        ShapeError: the array has the wrong dtype, shape or byte count.
    """
    points = decode_array(query.points, "points", FLOATS, (None, (2, 3)))
    return Points(points, with_gradient=query.with_gradient is True)


def _answer(asked: Asked, query: messages.PointsQuery) -> Iterator[messages.Message]:
    plan = decode_points(query).plan(asked.snapshot, asked.limits)
    for occupancy in asked.parts(plan):
        yield encode_occupancy(occupancy)


def _warm_up(kernels: KernelMap) -> None:
    Points([[0.0, 0.0, 0.0]], with_gradient=True).plan(kernels, Limits()).part(0)


QUESTION = Question(op="points", query=messages.PointsQuery, answer=_answer, warm_up=_warm_up)
