"""Lattices read off kernels: where kernels of one shape stand exactly on a grid, bit by bit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potserver.domain.types import Float32, Float64, KernelSet

LEAST_ON_LATTICE = 4  # kernels: of fewer, the hinges themselves are shorter than a lattice
_CELL_LIMIT = 2.0**31  # far beyond a tile; every float64 below is exact


def shapes_of(kernels: KernelSet) -> Float32:
    """(K, 5) hinge_var along x, y, z, gamma_shape and gamma_rate: what kernels of one kind share."""
    return np.column_stack([kernels.hinge_var, kernels.gamma_shape, kernels.gamma_rate])


def distinct_rows(rows: Float32) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Where each distinct row stands first, and for each row, which of the distinct ones it is; compared bit by bit."""
    number = np.zeros(len(rows), np.int64)
    first = np.zeros(min(len(rows), 1), np.intp)
    for column in _bits(rows.T):
        values, place = np.unique(column, return_inverse=True)
        if len(values) > 1:
            _, first, number = np.unique(number * len(values) + place, return_index=True, return_inverse=True)
    return first, number


def lattice_of(hinge: Float32, spacings_m: Sequence[float]) -> tuple[Float64, NDArray[np.int64]] | None:
    """Spacing and offsets, (4,) m, of a lattice that gives exactly these (K, 3) hinges, and their cells; None without one."""
    for spacing in spacings_m:
        axes = [found for axis in hinge.T if (found := _cells_along(axis, spacing)) is not None]
        if len(axes) == 3:
            offsets, cells = zip(*axes, strict=True)
            return np.array([spacing, *offsets]), np.stack(cells, axis=1)
    return None


def _cells_along(axis: Float32, spacing: float) -> tuple[float, NDArray[np.int64]] | None:
    """Offset and cells that give exactly these (K,) coordinates: centres of cells, or the one height of a planar map."""
    wide = axis.astype(np.float64)
    for offset in (0.5 * spacing, float(wide[0])):
        cells = np.rint((wide - offset) / spacing)
        if (
            np.abs(cells).max() < _CELL_LIMIT
            and (_bits((offset + cells * spacing).astype(np.float32)) == _bits(axis)).all()
        ):
            return offset, cells.astype(np.int64)
    return None


def _bits(values: Float32) -> NDArray[np.uint32]:
    """What tells -0 from 0, and is the same only where nothing was lost."""
    return np.ascontiguousarray(values).view(np.uint32)
