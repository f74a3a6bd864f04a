"""Kernels for `q/tiles`: what many of them share is said once, and only where the very same numbers come back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from potschemas import messages
from potschemas.wire import pack_array
from potserver.domain.types import Float32, Float64, KernelSet

_BYTES_OF_SHAPE = 5 * 4  # hinge_var, gamma_shape, gamma_rate
_BYTES_OF_LATTICE = 4 * 8
_LEAST_ON_LATTICE = 4  # kernels: of fewer, the hinges themselves are shorter than a lattice


def code_kernels(kernels: KernelSet, spacings_m: Sequence[float]) -> messages.CodedKernels:
    """Kernels, relative to the corners of their tiles, for the wire.

    Shapes travel as a table of the distinct ones where that is shorter. Hinges travel as numbers of lattice cells where all
    kernels of a shape lie on one lattice; both are compared bit by bit with what they stand for, as float32.

    Args:
        kernels: Hinges relative to the lower corners of their tiles.
        spacings_m: Lattices to try.
    """
    hinge = kernels.hinge_mean.astype(np.float32)
    shapes = np.column_stack([kernels.hinge_var, kernels.gamma_shape, kernels.gamma_rate])
    first, kind = _distinct_rows(shapes)
    on_lattice = np.zeros(len(hinge), np.bool_)
    cells = np.zeros((len(hinge), 3), np.int64)
    if len(first) * (_BYTES_OF_SHAPE + _BYTES_OF_LATTICE) + len(hinge) < len(hinge) * _BYTES_OF_SHAPE:
        shapes = shapes[first]
        lattices = np.zeros((len(first), 4))
        for number in np.flatnonzero(np.bincount(kind) >= _LEAST_ON_LATTICE):
            members = np.flatnonzero(kind == number)
            found = _lattice_of(hinge[members], spacings_m)
            if found is not None:
                lattices[number], cells[members] = found
                on_lattice[members] = True
    else:
        kind, lattices = None, np.zeros((len(hinge), 4))
    return messages.CodedKernels(
        kinds=pack_array(shapes.T),
        lattices=pack_array(lattices.T),
        kind=None if kind is None else pack_array(_small(kind)),
        cells=pack_array(_small(cells[on_lattice].T)),
        hinge_mean=pack_array(hinge[~on_lattice].T),
        weight_mean=pack_array(kernels.weight_mean),
        weight_var=pack_array(kernels.weight_var),
    )


def _distinct_rows(rows: Float32) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Where each distinct row stands first, and for each row, which of the distinct ones it is; compared bit by bit."""
    number = np.zeros(len(rows), np.int64)
    first = np.zeros(min(len(rows), 1), np.intp)
    for column in np.ascontiguousarray(rows.T).view(np.uint32):
        values, place = np.unique(column, return_inverse=True)
        if len(values) > 1:
            _, first, number = np.unique(
                number * len(values) + place, return_index=True, return_inverse=True
            )
    return first, number


def _lattice_of(hinge: Float32, spacings_m: Sequence[float]) -> tuple[Float64, NDArray[np.int64]] | None:
    """Spacing and offsets, (4,) m, of a lattice that gives exactly these (K, 3) hinges, and their cells; None if there is none."""
    for spacing in spacings_m:
        axes = [_cells_along(axis, spacing) for axis in np.ascontiguousarray(hinge.T)]
        found = [axis for axis in axes if axis is not None]
        if len(found) == 3:
            return np.array([spacing, *(offset for offset, _ in found)]), np.stack([c for _, c in found], axis=1)
    return None


def _cells_along(axis: Float32, spacing: float) -> tuple[float, NDArray[np.int64]] | None:
    """Offset and cells that give exactly these (K,) coordinates.

    Centres of cells, as a rule. In a planar map all heights are the same, but for whole tiles, and fit no centre.
    """
    wide = axis.astype(np.float64)
    for offset in (0.5 * spacing, float(wide[0]), float(wide[0] % spacing)):
        cells = np.rint((wide - offset) / spacing)
        if np.array_equal((offset + cells * spacing).astype(np.float32).view(np.uint32), axis.view(np.uint32)):
            return offset, cells.astype(np.int64)
    return None


def _small(numbers: NDArray[np.int64]) -> NDArray[np.uint8] | NDArray[np.int64]:
    """As bytes where they fit."""
    fits = numbers.min(initial=0) >= 0 and numbers.max(initial=0) <= 255
    return numbers.astype(np.uint8) if fits else numbers
