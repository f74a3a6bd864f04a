"""The kernels of the overall map, whole or inside a box."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potschemas.answers import AnswerRule
from potschemas.lean import LeanTiles
from potserver.asking.plan import Plan, checked_box
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Float64, KernelSet
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
        lean = None if snapshot.lean is None else _lean_in(snapshot.lean.told, lower, upper)
        return ParamsPlan(kernels.take(inside), lean, snapshot.rule, snapshot.map_revision, part_kernels)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ParamsPlan(Plan[KernelSet]):
    """Kernels of one revision, and the rule that turns them into its answers."""

    kernels: KernelSet  # map frame
    lean: LeanTiles | None  # of the tiles that the box touches
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

    def lean_of_part(self, i: int) -> LeanTiles | None:
        """The leans that travel with it: each tile's with one part."""
        if self.lean is None:
            return None
        mine = list(self.lean.nodes)[i :: self.n_parts]
        return self.lean._replace(nodes={index: self.lean.nodes[index] for index in mine}) if mine else None


def _lean_in(lean: LeanTiles, lower: Float64 | None, upper: Float64 | None) -> LeanTiles:
    """The leans of the tiles that a box touches."""
    index = np.array(list(lean.nodes), np.float64).reshape(-1, 3)
    inside: NDArray[np.bool_] = np.ones(len(index), np.bool_)
    if lower is not None:
        inside &= ((index + 1.0) * lean.tile_size_m >= lower).all(axis=1)
    if upper is not None:
        inside &= (index * lean.tile_size_m <= upper).all(axis=1)
    pairs = zip(lean.nodes.items(), inside, strict=True)
    return lean._replace(nodes={index: nodes for (index, nodes), is_in in pairs if is_in})
