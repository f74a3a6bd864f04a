"""The kernels of the overall map, whole or inside a box."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potschemas.answers import AnswerRule
from potserver.asking.plan import Plan, checked_box
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet
from potserver.limits import Limits

PART_KERNELS = 20_000  # of a part: 800 kB on the wire


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Params:
    """What is asked: the kernels whose hinge means lie in a box."""

    lower: ArrayLike | None = None  # (3,) m, map frame; None = no bound on that side
    upper: ArrayLike | None = None  # (3,) m, map frame; likewise

    def plan(self, snapshot: KernelMap, limits: Limits, *, part_kernels: int = PART_KERNELS) -> ParamsPlan:
        """Check the question.

        Raises:
            ShapeError, BadPointsError, OutOfRangeError: an illegal corner.
        """
        lower, upper = checked_box(self.lower, self.upper, limits)
        kernels = snapshot.kernels
        inside: NDArray[np.bool_] = np.ones(len(kernels), np.bool_)
        if lower is not None:
            inside &= (kernels.hinge_mean >= lower).all(axis=1)
        if upper is not None:
            inside &= (kernels.hinge_mean <= upper).all(axis=1)
        return ParamsPlan(kernels.take(inside), snapshot.rule, snapshot.map_revision, part_kernels)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ParamsPlan(Plan[KernelSet]):
    """Kernels of one revision, and the rule that turns them into its answers."""

    kernels: KernelSet  # map frame
    rule: AnswerRule
    map_revision: int
    part_size: int

    @property
    def n_items(self) -> int:
        """Kernels."""
        return len(self.kernels)

    def part(self, i: int) -> KernelSet:
        """A run of the kernels."""
        return self.kernels.take(self.items(i))
