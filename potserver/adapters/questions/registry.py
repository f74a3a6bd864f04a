"""All kinds of questions: a new one is a file beside this one, and a line here."""

from __future__ import annotations

from typing import Any

from potserver.adapters.questions import atoms, grid, info, params, points, rays, risk, tiles
from potserver.adapters.questions.question import Question
from potserver.domain.kernel_map import KernelMap

QUESTIONS: tuple[Question[Any], ...] = (
    points.QUESTION,
    grid.QUESTION,
    rays.QUESTION,
    risk.QUESTION,
    params.QUESTION,
    tiles.QUESTION,
    atoms.QUESTION,
    info.QUESTION,
)


def warm_up() -> None:
    """Compile what the answers use, so that the first question of a kind does not wait for that."""
    kernels = KernelMap.from_arrays([[0.0, 0.0, 0.0]], [1.0], [1.0], [1.0], threads=1)
    for question in QUESTIONS:
        if question.warm_up is not None:
            question.warm_up(kernels)
