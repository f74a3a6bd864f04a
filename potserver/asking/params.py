"""The kernels of the overall map, whole or inside a box."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potschemas.answers import AnswerRule
from potschemas.lean import LeanTiles
from potserver.asking.plan import Plan, checked_box, pieces
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
        low, high = (-np.inf if lower is None else lower), (np.inf if upper is None else upper)
        runs = []
        for part in snapshot.parts:
            if (part.box[1] < low).any() or (part.box[0] > high).any():
                continue
            is_inside = bool((part.box[0] >= low).all() and (part.box[1] <= high).all())
            for kernels, shift in part.members:
                if is_inside:
                    runs.append(Run(kernels, shift, None))
                else:
                    hinge = kernels.hinge_mean + shift
                    runs.append(
                        Run(kernels, shift, np.flatnonzero(((hinge >= low) & (hinge <= high)).all(axis=1)))
                    )
        lean = None if snapshot.lean is None else _lean_in(snapshot.lean.told, lower, upper)
        return ParamsPlan(tuple(runs), lean, snapshot.rule, snapshot.map_revision, part_kernels)


class Run(NamedTuple):
    """Some of the kernels that lie together in the map."""

    kernels: KernelSet
    shift: Float64  # (3,) m, what moves them into the map frame
    chosen: NDArray[np.intp] | None  # which of them; all

    @property
    def size(self) -> int:
        """How many."""
        return len(self.kernels) if self.chosen is None else len(self.chosen)

    def take(self, cut: slice) -> KernelSet:
        """A run of them, map frame."""
        return self.kernels.take(cut if self.chosen is None else self.chosen[cut]).moved(self.shift)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ParamsPlan(Plan[KernelSet]):
    """Kernels of one revision, and the rule that turns them into its answers."""

    runs: tuple[Run, ...]
    lean: LeanTiles | None  # of the tiles that the box touches
    rule: AnswerRule
    map_revision: int
    part_size: int

    @property
    def n_items(self) -> int:
        """Kernels."""
        return sum(run.size for run in self.runs)

    def part(self, i: int) -> KernelSet:
        """Some of the kernels, map frame; only now they are put together."""
        sizes = np.array([run.size for run in self.runs], np.int64)
        found = pieces(sizes, self.items(i))
        return KernelSet.concatenate([self.runs[number].take(cut) for number, cut in found])

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
