"""Ray casting; the only module of the client that imports open3d, and only when a ray is cast."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Float32, Float64
from potclient.errors import DatasetError
from potclient.extras import how_to_install
from potclient.towns.solids import Int64, SolidSet, triangles_of

HOW_TO_INSTALL = f"towns are ray cast by open3d: {how_to_install('towns')}"


def require() -> None:
    """Look for open3d without loading it.

    Raises:
        DatasetError: it is not installed.
    """
    if importlib.util.find_spec("open3d") is None:
        raise DatasetError(HOW_TO_INSTALL)


def _open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:  # OSError: a system library that it needs is missing
        raise DatasetError(f"{HOW_TO_INSTALL} ({error})") from error
    return open3d


class Hits(NamedTuple):
    """What rays met first."""

    range_m: Float64  # (N,) inf: nothing
    kind: Int64  # (N,) of `Kind`; -1: nothing
    normals: Float32  # (N, 3) of either side


class RayScene:
    """Solids to cast rays at.

    Args:
        solids: All that is there.
        origin: (2,) m, map: near the solids, so that single precision loses nothing.
    Raises:
        DatasetError: open3d is missing.
    """

    def __init__(self, solids: Sequence[SolidSet], origin: Float64) -> None:
        self._open3d = _open3d()
        vertices, triangles, self._kind = triangles_of(solids)
        self._origin = np.array([*origin, 0.0])
        self._scene = self._open3d.t.geometry.RaycastingScene(nthreads=1)
        self._empty = len(triangles) == 0
        if not self._empty:
            self._scene.add_triangles(
                self._tensor(vertices - self._origin, np.float32), self._tensor(triangles, np.uint32)
            )

    def cast(self, origin: Float64, directions: Float64) -> Hits:
        """Rays from one point (3,) m along unit directions (N, 3), map frame."""
        n = len(directions)
        if self._empty:
            return Hits(np.full(n, np.inf), np.full(n, -1), np.zeros((n, 3), np.float32))
        rays = np.empty((n, 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin - self._origin, directions
        answer = self._scene.cast_rays(self._open3d.core.Tensor(rays), nthreads=1)
        range_m = answer["t_hit"].numpy().astype(np.float64)
        # a miss has an id beyond all triangles
        triangle = np.minimum(answer["primitive_ids"].numpy(), len(self._kind)).astype(np.int64)
        return Hits(range_m, np.append(self._kind, -1)[triangle], answer["primitive_normals"].numpy())

    def _tensor(self, array: Any, dtype: Any) -> Any:
        return self._open3d.core.Tensor(np.ascontiguousarray(array, dtype))
