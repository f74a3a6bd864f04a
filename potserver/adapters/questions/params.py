"""`q/params`: the kernels of the overall map, whole or inside a box, in parts."""

from __future__ import annotations

from collections.abc import Iterator

from potschemas import messages
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.params import Params
from potserver.codec.base import MAX_SMALL_BYTES
from potserver.codec.kernels import encode_kernels


def _answer(asked: Asked, query: messages.ParamsQuery) -> Iterator[messages.Message]:
    plan = Params(query.lower, query.upper).plan(asked.snapshot, asked.limits)
    for number, kernels in enumerate(asked.parts(plan)):
        yield messages.ParamsPart(
            part=number,
            n_parts=plan.n_parts,
            map_revision=plan.map_revision,
            kernels=encode_kernels(kernels, plan.rule),
        )


QUESTION = Question(op="params", query=messages.ParamsQuery, answer=_answer, max_bytes=MAX_SMALL_BYTES)
