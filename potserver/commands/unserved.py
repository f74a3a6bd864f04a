"""A saved map that answers like a `MapClient`, as far as exports ask."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.kernels import KernelSet as ClientKernels
from potclient.occupancy import Grid
from potschemas import messages
from potserver.adapters.questions.info import encode_limits, snapshot_fields
from potserver.asking.grid import GridPlan
from potserver.codec.kernels import encode_kernels
from potserver.limits import Limits
from potserver.mapping.settings import MappingSettings
from potserver.storage.map_file import SavedMap


class UnservedMap:
    """The questions that exports ask, answered from a saved map."""

    def __init__(self, saved: SavedMap) -> None:
        self._record = saved.record
        self._map = saved.kernel_map()
        self._parts = [] if saved.tiled is None else [part.kernels for part in saved.tiled.parts.values()]

    def info(self) -> messages.Info:
        """What the map is."""
        r = self._record
        return messages.Info(
            server="unserved",
            version=r.written_by,
            map=r.map_id,
            maps=[r.map_id],
            profile="default" if r.keeps_evidence else "paper",
            n_atoms=0,
            n_scans=r.n_scans,
            tile_size_m=float(r.grid[0] if r.grid else MappingSettings().tile_size_m),
            limits=encode_limits(Limits(), max_range_m=0.0),
            started_ns=r.written_ns,
            durable=True,
            **snapshot_fields(self._map),
        )

    def params_parts(
        self, lower: ArrayLike | None = None, upper: ArrayLike | None = None
    ) -> Iterator[tuple[int, int, ClientKernels]]:
        """Kernels, part by part; those in a box (m, map frame) if there is one."""
        low = np.full(3, -np.inf) if lower is None else np.asarray(lower, np.float64)
        high = np.full(3, np.inf) if upper is None else np.asarray(upper, np.float64)
        lean = None if self._map.lean is None else self._map.lean.told
        for number, kernels in enumerate(self._parts):
            hinge = kernels.hinge_mean
            inside = np.flatnonzero(((hinge >= low) & (hinge <= high)).all(axis=1))
            message = encode_kernels(kernels.take(inside), self._map.rule, lean if number == 0 else None)
            yield (
                number,
                len(self._parts),
                ClientKernels.from_message(message, map_revision=self._map.map_revision),
            )

    def grid(self, lower: ArrayLike, upper: ArrayLike, resolution: float) -> Grid:
        """Occupancy at the cell centres of a box, m, map frame."""
        low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        nx, ny, nz = (int(n) for n in np.ceil((high - low) / resolution - 1e-6))
        plan = GridPlan(self._map, low, resolution, (nx, ny, nz), False, nx * ny * nz)
        o = plan.part(0).occupancy

        def cells(array: NDArray[Any]) -> NDArray[np.float32]:
            return array.astype(np.float32).reshape(nx, ny, nz)

        return Grid(
            lower=low,
            resolution=resolution,
            mean=cells(o.mean),
            var=cells(o.var),
            latent_mean=cells(o.latent_mean),
            latent_var=cells(o.latent_var),
            observed=o.observed.reshape(nx, ny, nz),
            borrowed=cells(o.borrowed),
            revision=self._map.map_revision,
        )
