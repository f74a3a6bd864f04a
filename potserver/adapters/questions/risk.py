"""`q/risk`: how likely a robot on a path touches something."""

from __future__ import annotations

import numpy as np

from potschemas import messages
from potschemas.messages import DType
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.risk import CellRisk, Risk, RiskPlan
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
        evidence_only=query.evidence_only is True,
    )


def _plan(asked: Asked, query: messages.RiskQuery) -> RiskPlan:
    return decode_risk(query).plan(asked.snapshot, asked.limits)


def _encode(plan: RiskPlan, parts: list[CellRisk]) -> messages.Risk:
    return messages.Risk(**float32_fields(plan.result(parts)))


def _warm_up(kernels: KernelMap) -> None:
    Risk(np.eye(4)[None], [[0.0, 0.0, 0.0, 1.0]], resolution_m=1.0).plan(kernels, Limits())


# the plan counts the cells of the whole swept volume: up to a second of work
QUESTION = Question(
    op="risk", query=messages.RiskQuery, plan=_plan, whole=_encode, is_quick=False, warm_up=_warm_up
)
