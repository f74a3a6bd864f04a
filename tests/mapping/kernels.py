"""Kernels of two maps, compared."""

from __future__ import annotations

import numpy as np

from potserver.domain.types import KERNEL_ARRAYS, KernelSet


def assert_same(one: KernelSet, other: KernelSet) -> None:
    """To the bit."""
    for name in KERNEL_ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
