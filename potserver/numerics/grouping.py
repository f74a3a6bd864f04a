"""Sorting by small whole numbers, in linear time."""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.arrays import Int64, Ints


def by_number(number: Ints, n: int) -> tuple[Int64, Int64]:
    """Where each of n numbers stands.

    Args:
        number: (N,) from 0 to n - 1.
        n: How many numbers there are.
    Returns:
        order: (N,) so that `number[order]` ascends; equal ones keep their order.
        cuts: (n + 1,) number i stands at `order[cuts[i] : cuts[i + 1]]`.
    """
    order, cuts = _by_number(number, n)
    return np.asarray(order), np.asarray(cuts)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _by_number(number, n):
    cuts = np.zeros(n + 1, np.int64)
    for i in range(len(number)):
        cuts[number[i] + 1] += 1
    for g in range(n):
        cuts[g + 1] += cuts[g]
    at, order = cuts.copy(), np.empty(len(number), np.int64)
    for i in range(len(number)):
        g = number[i]
        order[at[g]] = i
        at[g] += 1
    return order, cuts
