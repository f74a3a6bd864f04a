"""`q/params`: the kernels of the overall map, whole or inside a box, in parts."""

from __future__ import annotations

from potschemas import messages
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.params import Params, ParamsPlan
from potserver.codec.base import MAX_SMALL_BYTES
from potserver.codec.kernels import encode_kernels
from potserver.domain.types import KernelSet


def _plan(asked: Asked, query: messages.ParamsQuery) -> ParamsPlan:
    return Params(query.lower, query.upper).plan(asked.snapshot, asked.limits)


def _encode(plan: ParamsPlan, number: int, kernels: KernelSet) -> messages.ParamsPart:
    return messages.ParamsPart(
        part=number,
        n_parts=plan.n_parts,
        map_revision=plan.map_revision,
        kernels=encode_kernels(kernels, plan.rule, plan.lean_of_part(number)),
    )


# the plan puts all kernels of the map together, if nobody asked for them before
QUESTION = Question(
    op="params",
    query=messages.ParamsQuery,
    plan=_plan,
    each=_encode,
    is_quick=False,
    max_bytes=MAX_SMALL_BYTES,
)
