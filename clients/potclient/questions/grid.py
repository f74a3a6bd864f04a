"""`q/grid`: occupancy at the cell centres of a box, streamed in parts."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arguments import corner
from potclient.errors import BadReplyError, IncompleteReplyError, UsageError
from potclient.link import Link
from potclient.occupancy import Grid, Occupancy
from potclient.parts import PartCheck
from potschemas import messages

ProgressCallback = Callable[[int, int], None]  # (parts received, parts in all)


class Wanted(NamedTuple):
    """What is asked; see `MapClient.grid`."""

    lower: ArrayLike
    upper: ArrayLike
    resolution: float
    evidence_only: bool


def grid(link: Link, wanted: Wanted, *, progress: ProgressCallback | None, timeout_s: float | None) -> Grid:
    """See `MapClient.grid`."""
    lower_m, upper_m, resolution = (
        corner(wanted.lower, "lower"),
        corner(wanted.upper, "upper"),
        wanted.resolution,
    )
    if not (upper_m > lower_m).all() or not (math.isfinite(resolution) and resolution > 0):
        raise UsageError(
            f"grid: lower {lower_m.tolist()} must be below upper {upper_m.tolist()}, resolution positive"
        )
    request = messages.GridQuery(
        lower=lower_m.tolist(),
        upper=upper_m.tolist(),
        resolution=resolution,
        deadline_ms=link.deadline_ms(timeout_s),
        evidence_only=True if wanted.evidence_only else messages.ABSENT,
    )
    assembly: _Assembly | None = None
    cells = np.ceil((upper_m - lower_m) / resolution - 1e-6)
    for part in link.stream(link.keys.query("grid"), request, messages.GridPart, timeout_s):
        if assembly is None:
            if np.abs(np.asarray(part.shape) - cells).max() > 1:
                raise BadReplyError(
                    f"grid: asked for about {cells.astype(int).tolist()} cells, got {part.shape}"
                )
            assembly = _Assembly(part)
        assembly.add(part)
        if progress is not None:
            progress(assembly.parts.n_came, part.n_parts)
    assert assembly is not None, "a stream has at least one part, or raises"
    return assembly.finish()


class _Assembly:
    """A grid in the making; refuses what does not fit."""

    def __init__(self, first: messages.GridPart) -> None:
        self.parts = PartCheck("grid")
        self._first = first
        n = math.prod(first.shape)
        self._arrays: dict[str, NDArray[Any]] = {
            name: np.zeros(n, np.float32) for name in ("mean", "var", "latent_mean", "latent_var", "borrowed")
        }
        self._arrays["observed"] = np.zeros(n, np.bool_)
        self._filled = np.zeros(n, np.bool_)

    def add(self, part: messages.GridPart) -> None:
        self.parts.add(
            part.part,
            part.n_parts,
            map_revision=part.occupancy.map_revision,
            shape=part.shape,
            lower=part.lower,
            resolution=part.resolution,
        )
        n = part.occupancy.mean.shape[0] if part.occupancy.mean.shape else 0
        run = slice(part.first_cell, part.first_cell + n)
        if run.stop > len(self._filled):
            raise BadReplyError(f"grid: part {part.part} ends at cell {run.stop} of {len(self._filled)}")
        if self._filled[run].any():
            raise IncompleteReplyError(f"grid: cells of part {part.part} came twice")
        occupancy = Occupancy.from_message(part.occupancy, n, f"grid part {part.part}")
        for name, array in self._arrays.items():
            array[run] = getattr(occupancy, name)
        self._filled[run] = True

    def finish(self) -> Grid:
        self.parts.finish()
        if missing := int((~self._filled).sum()):
            raise IncompleteReplyError(f"grid: all parts came, and {missing} cells are missing")
        nx, ny, nz = self._first.shape
        return Grid(
            lower=np.asarray(self._first.lower, np.float64),
            resolution=self._first.resolution,
            revision=self._first.occupancy.map_revision,
            **{name: array.reshape(nx, ny, nz) for name, array in self._arrays.items()},
        )
