"""`q/grid`: occupancy at the cell centres of a box, in parts."""

from __future__ import annotations

from potschemas import messages
from potserver.adapters.questions.question import Asked, Question
from potserver.asking.grid import Grid, GridPlan, GridRun
from potserver.codec.base import MAX_SMALL_BYTES
from potserver.codec.occupancy import encode_occupancy
from potserver.domain.kernel_map import KernelMap
from potserver.limits import Limits


def _plan(asked: Asked, query: messages.GridQuery) -> GridPlan:
    grid = Grid(query.lower, query.upper, query.resolution, query.evidence_only is True)
    return grid.plan(asked.snapshot, asked.limits)


def encode_part(plan: GridPlan, number: int, run: GridRun) -> messages.GridPart:
    """One part of the reply."""
    return messages.GridPart(
        part=number,
        n_parts=plan.n_parts,
        shape=list(plan.shape),
        first_cell=run.first_cell,
        lower=plan.lower.tolist(),
        resolution=plan.resolution,
        occupancy=encode_occupancy(run.occupancy),
    )


def _warm_up(kernels: KernelMap) -> None:
    Grid([0.0, 0.0, 0.0], [1.0, 1.0, 1.0], 0.5).plan(kernels, Limits()).part(0)


QUESTION = Question(
    op="grid",
    query=messages.GridQuery,
    plan=_plan,
    each=encode_part,
    max_bytes=MAX_SMALL_BYTES,
    warm_up=_warm_up,
)
