"""`q/rays`: where rays first return."""

from __future__ import annotations

from potschemas import messages
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.rays import QUANTILES, Rays, RaysPlan
from potserver.codec.base import FLOATS, decode_array, float32_fields
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Unknown
from potserver.limits import Limits
from potserver.numerics.rays import FirstReturns


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
        evidence_only=query.evidence_only is True,
    )


def _plan(asked: Asked, query: messages.RaysQuery) -> RaysPlan:
    return decode_rays(query).plan(asked.snapshot, asked.limits)


def _encode(plan: RaysPlan, parts: list[FirstReturns]) -> messages.Rays:
    return messages.Rays(**float32_fields(plan.result(parts)))


def _warm_up(kernels: KernelMap) -> None:
    Rays([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], max_range_m=1.0).plan(kernels, Limits()).part(0)


QUESTION = Question(op="rays", query=messages.RaysQuery, plan=_plan, whole=_encode, warm_up=_warm_up)
