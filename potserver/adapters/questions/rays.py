"""`q/rays`: where rays first return."""

from __future__ import annotations

from collections.abc import Iterator

from potschemas import messages
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.rays import QUANTILES, Rays
from potserver.codec.base import FLOATS, decode_array, float32_fields
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Unknown
from potserver.limits import Limits


def decode_rays(query: messages.RaysQuery) -> Rays:
    """What is asked.

    Raises:
        ShapeError: an array has the wrong dtype, shape or byte count.
    """
    origins = decode_array(query.origins, "origins", FLOATS, (None, (2, 3)))
    return Rays(
        origins=origins,
        directions=decode_array(query.directions, "directions", FLOATS, origins.shape),
        max_range_m=query.max_range_m,
        quantiles=QUANTILES if query.quantiles is None else query.quantiles,
        unknown=Unknown(query.unknown.value),
        width_m=query.width_m,
        step_m=query.step_m,
    )


def _answer(asked: Asked, query: messages.RaysQuery) -> Iterator[messages.Message]:
    plan = decode_rays(query).plan(asked.snapshot, asked.limits)
    yield messages.Rays(**float32_fields(plan.result(asked.parts(plan))))


def _warm_up(kernels: KernelMap) -> None:
    Rays([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], max_range_m=1.0).plan(kernels, Limits()).part(0)


QUESTION = Question(op="rays", query=messages.RaysQuery, answer=_answer, warm_up=_warm_up)
