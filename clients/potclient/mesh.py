"""The surface where the probability of occupancy crosses one half, by marching cubes, coloured by how sure the map is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Float32, Float64
from potclient.cells import CellBox, MapSource, Progress, grid_of
from potclient.errors import UsageError
from potclient.extras import how_to_install
from potclient.files import whole
from potclient.occupancy import Grid, surface_var

_LEVEL = 0.5
_LARGEST_SD = 0.5  # of a probability
# From sure to unsure, as matplotlib's viridis goes.
_COLOURS = np.array([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]], np.float64)


class Mesh(NamedTuple):
    """Triangles in the map frame; free space is on the side from which their corners run anticlockwise."""

    vertices: Float32  # (V, 3) m
    faces: NDArray[np.int64]  # (F, 3)
    sd: Float32  # (V,) standard deviation of the occupancy probability by that of its latent, 0 to 0.5

    @property
    def colours(self) -> NDArray[np.uint8]:
        """(V, 3) red, green, blue: dark blue where the map is sure, yellow where it guesses."""
        return sd_colours(self.sd)

    @classmethod
    def concatenate(cls, meshes: list[Mesh]) -> Mesh:
        """All as one."""
        starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        return cls(
            np.concatenate([np.zeros((0, 3), np.float32), *(m.vertices for m in meshes)]),
            np.concatenate(
                [np.zeros((0, 3), np.int64), *(m.faces + n for m, n in zip(meshes, starts, strict=False))]
            ),
            np.concatenate([np.zeros(0, np.float32), *(m.sd for m in meshes)]),
        )


def sd_colours(sd: Float32) -> NDArray[np.uint8]:
    """(N, 3) colours of standard deviations (N,) of a probability."""
    place = np.clip(np.asarray(sd, np.float64) / _LARGEST_SD, 0, 1) * (len(_COLOURS) - 1)
    channels = [np.interp(place, np.arange(len(_COLOURS)), _COLOURS[:, c]) for c in range(3)]
    return np.rint(np.stack(channels, axis=1)).astype(np.uint8)


def mesh_of(grid: Grid) -> Mesh:
    """The surface inside a grid, between the centres of its cells; what was not observed makes none.

    Raises:
        UsageError: scikit-image is missing.
    """
    try:
        from skimage.measure import marching_cubes
    except ImportError as error:
        raise UsageError(f"surfaces need the package scikit-image: {how_to_install('mesh')}") from error
    none = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64), np.zeros(0, np.float32))
    seen = grid.mean[grid.observed]
    if min(grid.shape) < 2 or not len(seen) or not seen.min() < _LEVEL < seen.max():
        return none
    places, faces, _, _ = marching_cubes(
        grid.mean, _LEVEL, allow_degenerate=False, gradient_direction="ascent"
    )
    low, high, share = _edges(places, grid.shape)
    known = grid.observed[low] & grid.observed[high]  # a crossing beside what was not observed is none
    faces = faces[known[faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    var = (1 - share) * surface_var(grid, low) + share * surface_var(grid, high)
    sd = np.sqrt(np.maximum(var[used], 0)).astype(np.float32)
    places, faces = places[used], faces.reshape(-1, 3)
    vertices = np.asarray(grid.lower, np.float64) + (places + 0.5) * grid.resolution
    return Mesh(vertices.astype(np.float32), faces.astype(np.int64), sd)


def meshes(source: MapSource, box: CellBox, progress: Progress | None = None) -> Iterator[tuple[Mesh, int]]:
    """The surface in a box, tile by tile, and the revision that each tile is of; neighbours meet without a gap.

    Raises:
        UsageError: scikit-image is missing.
        PotclientError: see `MapClient.grid`.
    """
    tiles = box.tiles()
    for done, tile in enumerate(tiles, 1):
        grid = grid_of(source, tile._replace(stop=np.minimum(tile.stop + 1, box.stop)))
        yield mesh_of(grid), grid.revision
        if progress is not None:
            progress(done, len(tiles))


def export_mesh(
    source: MapSource, path: Path, box: CellBox, kind: str, progress: Progress | None = None
) -> tuple[int, tuple[int, ...]]:
    """Write the surface as a mesh with colours: kind "mesh" as PLY, "gltf" as binary glTF, whose y axis is up.

    Returns:
        How many triangles, and the revisions that they are of.
    Raises:
        UsageError: no surface in the box, or a package is missing.
        PotclientError: see `MapClient.grid`; nothing is written then.
    """
    try:
        import trimesh
    except ImportError as error:
        raise UsageError(f"meshes need the package trimesh: {how_to_install('mesh')}") from error
    parts, revisions = [], set()
    for part, revision in meshes(source, box, progress):
        parts.append(part)
        revisions.add(revision)
    mesh = Mesh.concatenate(parts)
    if not len(mesh.faces):
        raise UsageError("no surface in the box: nowhere does the probability cross one half")
    written = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.colours, process=False)
    written.merge_vertices(merge_tex=True, merge_norm=True)  # tiles share the vertices where they meet
    if kind == "gltf":
        written.apply_transform(_Y_UP)
    with whole(path) as file:
        file.write(written.export(file_type="glb" if kind == "gltf" else "ply"))
    return len(written.faces), tuple(sorted(revisions))


_Y_UP: Float64 = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)


def _edges(places: Float32, shape: tuple[int, ...]) -> tuple[Any, Any, Float32]:
    """The two cells that each place (V, 3) lies between, as indices of an array, and the share of the way to the second."""
    low = np.floor(places).astype(np.int64)
    high = np.where(places > low, np.minimum(low + 1, np.array(shape) - 1), low)
    share: Float32 = (places - low).max(axis=1)
    return tuple(low.T), tuple(high.T), share
