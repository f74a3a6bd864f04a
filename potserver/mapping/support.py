"""How sure the weight of a kernel is: by how much was seen around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potserver.domain.types import Float32
from potserver.numerics import evidence
from potserver.numerics.arrays import UInt8
from potserver.numerics.feature_blocks import Blocks, two_diagonals

_SUPPORT_OF_NOTHING = 0.05  # of a kernel; with so much support its variance is half the prior's
_WORTH_OF_HALF = 0.25  # of a row in a voxel of half the edge, which has an eighth of the volume


class Support(NamedTuple):
    """How much evidence stands behind each of K kernels."""

    seen: Float32  # (K,) sum over seen rows of their worth times phi^2
    unseen: Float32  # (K,) the same over shadows

    def variance(self, prior_var: Float32) -> Float32:
        """(K,) log-odds^2: the prior's where nothing was seen, and the less the more was.

        The curvature of the loss would do for a wide posterior. Here labels part cleanly: sure rows have no curvature, and
        those of one look would leave a kernel as uncertain as those of none.
        """
        unseen = self.unseen + np.float32(_SUPPORT_OF_NOTHING)
        return prior_var * unseen / (unseen + self.seen)


def support_of(
    blocks: Blocks, kind: UInt8, counts: Float32, threads: int, scale: NDArray[np.int8] | int = 0
) -> Support:
    """The support of a block's kernels by rows of these kinds and counts; `scale` (K,) is of the kernels."""
    is_shadow = kind & evidence.KIND_MASK == evidence.SHADOW
    worth = np.minimum(counts, np.float32(1.0)) * np.float32(_WORTH_OF_HALF) ** evidence.halvings_of(kind)
    seen, unseen = (
        weight[blocks.order].astype(np.float32)
        for weight in (np.where(is_shadow, np.float32(0), worth), is_shadow & (counts > 0))
    )
    narrower = np.float32(1.0 / _WORTH_OF_HALF) ** scale  # they reach as many rows of their own scale
    return Support(*(sums * narrower for sums in two_diagonals(blocks, seen, unseen, threads=threads)))
