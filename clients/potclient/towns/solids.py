"""Convex solids: what a town is made of, for exact membership and for ray casting from the same vertices."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Bool, Float64

Int64 = NDArray[np.int64]

_CELL_M = 3.0  # of the grid that finds the solids near a point
_CHUNK = 50_000  # points tested at once
_NO_PLANE = (0.0, 0.0, 0.0, -1.0)  # pads the planes of a solid: every point is inside


class Kind(enum.IntEnum):
    """What a solid belongs to, for pictures and statistics."""

    PAVEMENT = 0
    BUILDING = 1
    ROOF = 2
    WALL = 3  # garden walls, fences, inner walls
    HEDGE = 4
    TREE = 5
    POLE = 6
    CAR = 7
    FURNITURE = 8
    PERSON = 9


class Shape:
    """The faces of a convex solid, as polygons over its vertices; winding does not matter."""

    def __init__(self, *faces: Sequence[int]) -> None:
        self.n_vertices = 1 + max(max(face) for face in faces)
        # (F, 3) three vertices that span each face
        self.corners: Int64 = np.array([face[:3] for face in faces])
        self.triangles: Int64 = np.array(
            [(face[0], face[k], face[k + 1]) for face in faces for k in range(1, len(face) - 1)]
        )


# Vertices: the lower polygon counter-clockwise, then the upper one.
BOX = Shape((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
# Four eaves as the lower face of a box, then the two ends of the ridge: one over the edge 3-0, one over 1-2.
ROOF = Shape((0, 1, 2, 3), (0, 1, 5, 4), (2, 3, 4, 5), (3, 0, 4), (1, 2, 5))


def _prism(n: int) -> Shape:
    sides = [(k, (k + 1) % n, n + (k + 1) % n, n + k) for k in range(n)]
    return Shape(tuple(range(n)), tuple(range(n, 2 * n)), *sides)


PRISM = _prism(8)
_turn = 2 * math.pi * (np.arange(8) + 0.5) / 8
OCTAGON: Float64 = np.stack([np.cos(_turn), np.sin(_turn)], axis=1)  # (8, 2), corners on the unit circle

_g = (1 + math.sqrt(5)) / 2
_ico = np.array(
    [(0, s, t * _g) for s in (-1, 1) for t in (-1, 1)]
    + [(s, t * _g, 0) for s in (-1, 1) for t in (-1, 1)]
    + [(t * _g, 0, s) for s in (-1, 1) for t in (-1, 1)],
    np.float64,
)
_near = np.linalg.norm(_ico[:, None] - _ico, axis=2) < 2.1  # neighbours: edges have length 2
BLOB = Shape(
    *[
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if _near[a, b] and _near[b, c] and _near[a, c]
    ]
)
ICOSAHEDRON: Float64 = _ico / math.hypot(1, _g)  # (12, 3), corners on the unit sphere

Part = tuple[Shape, Float64, Kind]  # a solid: its faces, (V, 3) m vertices, and what it is


class SolidSet:
    """Some solids, ready to be asked and to be cast against.

    Args:
        parts: The solids; each is the convex hull of its vertices.

    Attributes:
        vertices: (V, 3) m, of all solids in turn.
        triangles: (T, 3) rows of `vertices`.
        triangle_solid: (T,) the solid of each triangle.
        planes: (S, F, 4) outward normals and offsets: n . p + d <= 0 inside; padded with planes that hold everywhere.
        lower, upper: (S, 3) m, bounds.
        kind: (S,) of `Kind`.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self.kind: Int64 = np.array([kind for _, _, kind in parts], np.int64)
        n = len(parts)
        self.lower, self.upper = np.zeros((n, 3)), np.zeros((n, 3))
        n_faces = max((len(shape.corners) for shape, _, _ in parts), default=1)
        self.planes: Float64 = np.tile(_NO_PLANE, (n, n_faces, 1))
        counts = np.array([shape.n_vertices for shape, _, _ in parts], np.int64)
        self._first: Int64 = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.vertices: Float64 = np.concatenate([v for _, v, _ in parts]) if parts else np.zeros((0, 3))
        triangles, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
        of_shape: dict[int, list[int]] = {}
        for k, (shape, _, _) in enumerate(parts):
            of_shape.setdefault(id(shape), []).append(k)
        for members in of_shape.values():
            shape, rows = parts[members[0]][0], np.array(members)
            corners = np.stack([parts[k][1] for k in members])  # (M, V, 3)
            self.lower[rows], self.upper[rows] = corners.min(axis=1), corners.max(axis=1)
            self.planes[rows, : len(shape.corners)] = _planes(corners, shape)
            triangles.append((self._first[rows][:, None, None] + shape.triangles).reshape(-1, 3))
            owners.append(np.repeat(rows, len(shape.triangles)))
        self.triangles: Int64 = np.concatenate(triangles)
        self.triangle_solid: Int64 = np.concatenate(owners)

    def __len__(self) -> int:
        return len(self.kind)

    def corners(self, k: int) -> Float64:
        """(V, 3) m: the vertices of solid k."""
        return self.vertices[self._first[k] : self._first[k + 1]]

    def contains(self, points: Float64) -> Bool:
        """(N,) whether points (N, 3) m lie in a solid, its surface included."""
        found = np.zeros(len(points), np.bool_)
        if len(self):
            for start in range(0, len(points), _CHUNK):
                found[start : start + _CHUNK] = self._contains(points[start : start + _CHUNK])
        return found

    def _contains(self, points: Float64) -> Bool:
        origin, shape, first, members = self._cells
        cell = np.floor((points[:, :2] - origin) / _CELL_M).astype(np.int64)
        inside = np.flatnonzero(((cell >= 0) & (cell < shape)).all(axis=1))
        key = cell[inside, 0] * shape[1] + cell[inside, 1]
        count = first[key + 1] - first[key]
        point = np.repeat(inside, count)
        start = np.cumsum(count) - count
        solid = members[np.arange(len(point)) - np.repeat(start - first[key], count)]
        p = points[point]
        near = ((p >= self.lower[solid]) & (p <= self.upper[solid])).all(axis=1)
        p, point, planes = p[near], point[near], self.planes[solid[near]]
        distance = np.einsum("nfd,nd->nf", planes[:, :, :3], p) + planes[:, :, 3]
        found = np.zeros(len(points), np.bool_)
        found[point[(distance <= 0).all(axis=1)]] = True
        return found

    @cached_property
    def _cells(self) -> tuple[Float64, Int64, Int64, Int64]:
        """Origin and shape of a grid over x and y, and for each cell the solids whose bounds touch it (CSR)."""
        origin = self.lower[:, :2].min(axis=0)
        low = np.floor((self.lower[:, :2] - origin) / _CELL_M).astype(np.int64)
        high = np.floor((self.upper[:, :2] - origin) / _CELL_M).astype(np.int64)
        shape = high.max(axis=0) + 1
        size = high - low + 1
        n = size.prod(axis=1)
        solid = np.repeat(np.arange(len(self)), n)
        k = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
        ix = low[solid, 0] + k // size[solid, 1]
        iy = low[solid, 1] + k % size[solid, 1]
        key = ix * shape[1] + iy
        first = np.concatenate([[0], np.cumsum(np.bincount(key, minlength=shape.prod()))])
        return origin, shape, first, solid[np.argsort(key, kind="stable")]


def _planes(corners: Float64, shape: Shape) -> Float64:
    """(M, F, 4) outward unit planes of M solids of one shape with vertices (M, V, 3)."""
    a, b, c = (corners[:, shape.corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    offset = -(normal * a).sum(axis=2)
    middle = corners.mean(axis=1)
    outward = np.where(np.einsum("mfd,md->mf", normal, middle) + offset > 0, -1.0, 1.0)
    return np.concatenate([normal * outward[..., None], (offset * outward)[..., None]], axis=2)


# --- parts -----------------------------------------------------------------------------------------------------------


def placed(parts: Sequence[Part], x_m: float, y_m: float, yaw_rad: float) -> list[Part]:
    """The same solids turned about the vertical and then moved."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([x_m, y_m, 0.0])
    return [(shape, vertices @ turn + shift, kind) for shape, vertices, kind in parts]


def box(lower: Sequence[float], upper: Sequence[float], kind: Kind, *, taper: float = 0.0) -> Part:
    """An upright box; its upper face is `taper` m smaller on every side."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    t = taper
    return (
        BOX,
        np.array(
            [
                (x0, y0, z0),
                (x1, y0, z0),
                (x1, y1, z0),
                (x0, y1, z0),
                (x0 + t, y0 + t, z1),
                (x1 - t, y0 + t, z1),
                (x1 - t, y1 - t, z1),
                (x0 + t, y1 - t, z1),
            ]
        ),
        kind,
    )


def roof(
    lower: Sequence[float], upper: Sequence[float], kind: Kind = Kind.ROOF, *, hip_m: float = 0.0
) -> Part:
    """A roof with its ridge along x; `hip_m` is how far each end of the ridge stands back (0: a gable)."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    middle = (y0 + y1) / 2
    return (
        ROOF,
        np.array(
            [
                (x0, y0, z0),
                (x1, y0, z0),
                (x1, y1, z0),
                (x0, y1, z0),
                (x0 + hip_m, middle, z1),
                (x1 - hip_m, middle, z1),
            ]
        ),
        kind,
    )


def post(
    x_m: float,
    y_m: float,
    z0: float,
    z1: float,
    radius_m: float,
    kind: Kind,
    *,
    top_radius_m: float | None = None,
) -> Part:
    """An upright octagonal post or cone stump."""
    lower = np.column_stack([OCTAGON * radius_m + (x_m, y_m), np.full(8, z0)])
    upper = np.column_stack(
        [OCTAGON * (radius_m if top_radius_m is None else top_radius_m) + (x_m, y_m), np.full(8, z1)]
    )
    return PRISM, np.concatenate([lower, upper]), kind


def slab(lower: Sequence[float], upper: Sequence[float], cut_m: float, kind: Kind) -> Part:
    """A box whose four upright edges are cut off by `cut_m`: a pavement with its corners."""
    (x0, y0, z0), (x1, y1, z1) = lower, upper
    c = cut_m
    outline = [
        (x0 + c, y0),
        (x1 - c, y0),
        (x1, y0 + c),
        (x1, y1 - c),
        (x1 - c, y1),
        (x0 + c, y1),
        (x0, y1 - c),
        (x0, y0 + c),
    ]
    return PRISM, np.array([(x, y, z) for z in (z0, z1) for x, y in outline]), kind


def blob(center: Sequence[float], radii: Sequence[float], rng: np.random.Generator, kind: Kind) -> Part:
    """An icosahedron stretched to three radii and turned at random about the vertical."""
    angle = rng.uniform(0, 2 * math.pi)
    c, s = math.cos(angle), math.sin(angle)
    turned = ICOSAHEDRON @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return BLOB, turned * np.asarray(radii, np.float64) + np.asarray(center, np.float64), kind


def triangles_of(solids: Sequence[SolidSet]) -> tuple[Float64, NDArray[Any], NDArray[Any]]:
    """Vertices (V, 3), triangles (T, 3) and kinds (T,) of several sets together."""
    shift = np.cumsum([0, *(len(s.vertices) for s in solids)])
    return (
        np.concatenate([np.zeros((0, 3)), *(s.vertices for s in solids)]),
        np.concatenate(
            [np.zeros((0, 3), np.int64), *(s.triangles + k for s, k in zip(solids, shift, strict=False))]
        ),
        np.concatenate([np.zeros(0, np.int64), *(s.kind[s.triangle_solid] for s in solids)]),
    )
