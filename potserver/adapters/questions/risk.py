"""`q/risk`: how likely a robot on a path touches something."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from potschemas import messages
from potschemas.messages import DType
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.risk import Risk
from potserver.codec.base import FLOATS, decode_array, float32_fields
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Unknown
from potserver.limits import Limits


def decode_risk(query: messages.RiskQuery) -> Risk:
    """What is asked.

    Raises:
        ShapeError: an array has the wrong dtype, shape or byte count.
    """
    return Risk(
        path=decode_array(query.path, "path", (DType.FLOAT64,), (None, 4, 4)),
        spheres=decode_array(query.spheres, "spheres", FLOATS, (None, 4)),
        unknown=Unknown(query.unknown.value),
        resolution_m=query.resolution_m,
        correlation_m=query.correlation_m,
        dims=query.dims,
    )


def _answer(asked: Asked, query: messages.RiskQuery) -> Iterator[messages.Message]:
    plan = decode_risk(query).plan(asked.snapshot, asked.limits)
    yield messages.Risk(**float32_fields(plan.result(asked.parts(plan))))


def _warm_up(kernels: KernelMap) -> None:
    Risk(np.eye(4)[None], [[0.0, 0.0, 0.0, 1.0]], resolution_m=1.0).plan(kernels, Limits())


QUESTION = Question(op="risk", query=messages.RiskQuery, answer=_answer, warm_up=_warm_up)
