"""Kernels for the wire: as they are, or coded. Coding states once what many kernels share, and loses no bit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from potschemas import messages
from potschemas.answers import AnswerRule
from potschemas.lean import LeanTiles
from potschemas.wire import pack_array
from potserver.asking.lattices import LEAST_ON_LATTICE, distinct_rows, lattice_of, shapes_of
from potserver.asking.tile_codes import Steps, code_tile
from potserver.asking.tiles import Change
from potserver.codec.base import float32_fields
from potserver.codec.tile_changes import code_changes
from potserver.domain.types import Float64, KernelSet, OwnMap

_BYTES_OF_SHAPE = 5 * 4  # hinge_var, gamma_shape, gamma_rate
_BYTES_OF_LATTICE = 4 * 8
_OWN_STEP = 0.25  # log-odds, of a scan's own map: off by an eighth at most


def encode_kernels(kernels: KernelSet, rule: AnswerRule, lean: LeanTiles | None = None) -> messages.Kernels:
    """Kernels as they are: float64 hinges become float32 offsets from their centroid, in whole metres."""
    origin = np.round(kernels.hinge_mean.mean(axis=0)) if len(kernels) else np.zeros(3)
    return _kernels(kernels.moved(-origin), origin, rule, lean)


def encode_own_map(own: OwnMap, rule: AnswerRule) -> messages.Kernels:
    """What one scan says: fitted kernels as nodes in whole steps, carried ones as they are."""
    if not own.spacings_m:
        return _kernels(own.kernels, own.origin, rule, own.lean)
    steps = Steps.of(_OWN_STEP, rule.prior_var)
    codes = code_tile(own.kernels, own.spacings_m, own.size_m, steps)
    told = _kernels(codes.others, own.origin, rule, own.lean)
    return msgspec.structs.replace(told, nodes=code_changes([Change(codes, None)], steps))


def _kernels(
    kernels: KernelSet, origin: Float64, rule: AnswerRule, lean: LeanTiles | None
) -> messages.Kernels:
    """Kernels relative to an origin, (3,) m, map frame."""
    fields: dict[str, Any] = {**float32_fields(kernels), **rule.fields()}
    told = messages.ABSENT if lean is None else encode_lean(lean)
    return messages.Kernels(origin=origin.tolist(), **fields, lean=told)


def encode_lean(lean: LeanTiles, revisions: Sequence[int] | None = None) -> messages.Lean:
    """The leans of at least one tile; where revisions do not matter they are 0."""
    index = np.array(list(lean.nodes), np.int64)
    revision = np.zeros(len(index), np.int64) if revisions is None else np.array(revisions, np.int64)
    return messages.Lean(
        tile_size_m=lean.tile_size_m,
        tiles=pack_array(np.column_stack([index, revision]).T),
        nodes=pack_array(np.stack(list(lean.nodes.values())), repeats=True),
    )


def code_kernels(kernels: KernelSet, spacings_m: Sequence[float]) -> messages.CodedKernels:
    """Kernels, relative to the corners of their tiles, for the wire.

    Shapes travel as a table of the distinct ones where that is shorter, and then hinges as numbers of lattice cells where they
    lie on a lattice. Both are compared bit by bit with the float32 numbers that they stand for.

    Args:
        kernels: Hinges relative to the lower corners of their tiles.
        spacings_m: Lattices to try.
    """
    hinge = kernels.hinge_mean.astype(np.float32)
    shapes = shapes_of(kernels)
    lattices = np.zeros((len(hinge), 4))
    cells = np.zeros((len(hinge), 3), np.int64)
    first, kind = distinct_rows(shapes)
    is_coded = len(first) * (_BYTES_OF_SHAPE + _BYTES_OF_LATTICE) + len(hinge) < len(hinge) * _BYTES_OF_SHAPE
    if is_coded:
        shapes, lattices = shapes[first], lattices[first]
        for number in np.flatnonzero(np.bincount(kind) >= LEAST_ON_LATTICE):
            members = np.flatnonzero(kind == number)
            found = lattice_of(hinge[members], spacings_m)
            if found is not None:
                lattices[number], cells[members] = found
    on_lattice = lattices[kind, 0] > 0
    return messages.CodedKernels(
        kinds=pack_array(shapes.T),
        lattices=pack_array(lattices.T),
        kind=pack_array(_small(kind)) if is_coded else None,
        cells=pack_array(_small(cells[on_lattice].T)),
        hinge_mean=pack_array(hinge[~on_lattice].T),
        weight_mean=pack_array(kernels.weight_mean),
        weight_var=pack_array(kernels.weight_var),
    )


def _small(numbers: NDArray[np.int64]) -> NDArray[np.uint8] | NDArray[np.int64]:
    """As bytes where they fit."""
    fits = numbers.min(initial=0) >= 0 and numbers.max(initial=0) <= 255
    return numbers.astype(np.uint8) if fits else numbers
