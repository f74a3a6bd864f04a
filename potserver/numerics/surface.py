"""What a scan says about space next to the faces that it hit: normals, free space before the faces, space behind them.

Few beams see a face from one place: a scan of 16 rings has no normals of its own. So the points of the map around count too.
Points are summed in cells at several levels. Each hit takes a level at which the points around it are surely a plane.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Bool, Float64, Int32, Int64
from potserver.numerics.geometry import bounds
from potserver.numerics.voxel_hash import empty_table, enter, find, pack

_FIRST_M = 0.2  # cells asked first, then finer ones for what is small, then coarser ones for what is sparse
_COARSEST_M = 0.8  # cells that see two rings of a sparse scan at 20 m
_BITS = 12  # a voxel has 2^12 steps along an edge: sums of whole steps are exact, so no order of points changes them
_LEAST_POINTS = 6  # around a cell; three of them fix a plane
_LEAST_POINTS_2D = 4
_MOST_SIGMA_M = 0.06  # noise of range sensors is below; a curb or a corner of a room is above
_LEAST_RATIO = 8.0  # of the variance along a face to that across it
_LEAST_WIDTH_M = 0.05  # standard deviation along a face: noise alone makes a ring or a pole no wider
_LEAST_WIDTH = 0.3  # the same, in edges of a cell
_FULL_WIDTH = 0.87  # the same of three cells in a row that are evenly filled
_MOST_TILT = 0.03  # standard deviation of a normal, rad, at which no other level is asked
_MOST_SIGMAS = 3.0  # of a voxel's own point from the plane: a pole before a wall is no part of it
_OWN_M = 0.01  # the same for planes without noise
_COSINE_UNKNOWN = 0.7  # the mean over a hemisphere seen from far is 2/3
_SIGMA_UNKNOWN_M = 0.05
_ROOM_UNKNOWN_M = (
    0.15  # of near samples: beams alone do not say how the face lies, nor where between them it goes on
)
_LEAST_COSINE = 0.05
_MOST_OF_BEAM = 0.9


class Normals(NamedTuple):
    """The faces that hits lie on. Hits without a plane have minus their ray, a cosine of .7 and a sigma of 5 cm."""

    normal: Float64  # (H, 3) unit, towards the sensor, in the frame of the hits
    cosine: Float64  # (H,) of the angle between ray and normal, in [0, 1]
    sigma_m: Float64  # (H,) standard deviation of the points about their plane

    @property
    def is_plane(self) -> Bool:
        """(H,) whether the hit has one."""
        found: Bool = self.sigma_m != _SIGMA_UNKNOWN_M
        return found


def normals(hits: Float64, rays: Float64, known: Float64, voxel_m: float, *, planar: bool) -> Normals:
    """Normals of the faces that a scan hit, one a voxel.

    A voxel first looks at the cells of about 20 cm around it, then at finer ones, then at coarser ones, until the direction of
    a plane is sure to .03 rad. If none is, it takes the surest. Points are a plane where they spread far along two axes
    (2D: one) and less than 6 cm across, and where the voxel's own point lies on it.

    The order of the hits and of the known points changes nothing, to the bit.

    Args:
        hits: (H, 3) m, of one scan, in any frame. Along an axis they span less than 2^19 voxels.
        rays: (H, 3) unit, from the sensor to the hits, in the same frame.
        known: (R, 3) m, points of faces that the map knows around the hits, in the same frame; may be empty.
        voxel_m: Edge of a voxel. The hits of a voxel count as one point, their mean; each known point counts as one.
        planar: All points lie in a horizontal plane, so normals are horizontal too.
    """
    # copies: the loops are compiled for writable arrays, and arrays that were received are read-only
    hits, rays, known = (np.array(a, np.float64, order="C") for a in (hits, rays, known))
    out = Normals(-rays, np.full(len(hits), _COSINE_UNKNOWN), np.full(len(hits), _SIGMA_UNKNOWN_M))
    if len(hits) == 0:
        return out
    lower, upper = bounds(hits)
    n_levels, step_m = _level_of(_COARSEST_M, voxel_m) + 1, voxel_m / (1 << _BITS)
    corner = np.floor(lower / voxel_m) * voxel_m
    voxel_of, points, n_voxels = _points(hits, known, corner, upper, n_levels, step_m, empty_table(len(hits)))
    levels = [_finest_cells(points, empty_table(len(points)))]
    cell_of = [levels[0].number[:n_voxels]]
    for level in range(n_levels):
        levels.append(_coarser_cells(levels[level], level, empty_table(len(levels[level].cell))))
        cell_of.append(levels[-1].number[cell_of[level]])
    planes = _Planes(np.full(n_voxels, np.inf), np.zeros((n_voxels, 3)), np.zeros(n_voxels))
    first = _level_of(_FIRST_M, voxel_m)
    for level in (*range(first, -1, -1), *range(first + 1, n_levels)):
        if _FULL_WIDTH * voxel_m * 2**level > _LEAST_WIDTH_M:
            _fit_planes(
                points, levels[level], levels[level + 1], cell_of[level], level, step_m, planar, planes
            )
    _take_planes(rays, voxel_of, planes, out)
    return out


def near_free(
    hits: Float64,
    origin: Float64,
    normals: Normals,
    *,
    low_m: float,
    high_m: float,
    sigmas: float,
    rng: np.random.Generator,
) -> tuple[Float64, Int64]:
    """Free samples on the beams, so far before the hits that their clearance from the face is as asked.

    The clearance, along the normal, is U(low_m, high_m) + sigmas * sigma, without a plane U(low_m, high_m) + .15 m. Cosines
    below .05 count as .05. A sample that would lie more than .9 of its beam before the hit is left out.

    Args:
        hits: (H, 3) m, in any frame.
        origin: (3,) m, of the beams, in the same frame.
        normals: Of the hits.
        low_m, high_m: Range of the clearance.
        sigmas: How many standard deviations of the face are added to it.
        rng: Draws H numbers.
    Returns:
        points: (N, 3) m, in the frame of the hits, and index: (N,) ascending, the hit of each.
    """
    noise = np.where(normals.is_plane, sigmas * normals.sigma_m, _ROOM_UNKNOWN_M)
    clearance = rng.uniform(low_m, high_m, len(hits)) + noise
    back = clearance / np.maximum(normals.cosine, _LEAST_COSINE)
    beam = hits - origin
    length = np.sqrt(np.einsum("ij,ij->i", beam, beam))
    index = np.flatnonzero(back < _MOST_OF_BEAM * length)
    return hits[index] - (back[index] / length[index])[:, None] * beam[index], index


def behind(
    hits: Float64, normals: Normals, *, low_m: float, high_m: float, rng: np.random.Generator
) -> Float64:
    """Points behind the faces: each U(low_m, high_m) m from its hit, against the normal.

    Args:
        hits: (H, 3) m, in any frame.
        normals: Of the hits.
        low_m, high_m: Range of the depth.
        rng: Draws H numbers.
    Returns:
        (H, 3) m, in the frame of the hits.
    """
    return hits - rng.uniform(low_m, high_m, len(hits))[:, None] * normals.normal


def _level_of(edge_m: float, voxel_m: float) -> int:
    """The level whose cells have about that edge, or the finest."""
    return max(round(math.log2(edge_m / voxel_m)), 0)


class _Cells(NamedTuple):
    """Cells of one level that have points. Moments are in steps, about the centre of the cell."""

    cell: Int32  # (C, 3) whole edges from the corner
    moments: Float64  # (C, 10) number, sums of x, y, z, xx, yy, zz, xy, xz, yz: whole numbers
    number: Int64  # the cell of each point, or of each cell of the finer level
    child: Int32  # (C,) one cell of the finer level; none at the finest
    sibling: Int32  # of each cell of the finer level the next one in the same cell, or -1
    table: Int32  # hash of the cells
    keys: Int64


class _Planes(NamedTuple):
    tilt: Float64  # (V,) rad, standard deviation of the normal; inf: no plane
    normal: Float64  # (V, 3) of either side
    sigma_m: Float64  # (V,)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _points(hits, known, corner, upper, n_levels, step_m, table):
    """The points that count, in whole steps from the corner: a mean a voxel of the scan, and the known ones near enough.

    Returns:
        voxel_of: (H,) the voxel of each hit; points: (V + K, 3), the voxels' first; V.
    """
    keys, voxel_of = np.empty(len(hits), np.int64), np.empty(len(hits), np.int64)
    points, count = np.empty((len(hits) + len(known), 3), np.int64), np.empty(len(hits), np.int64)
    at = np.empty(3, np.int64)
    n = 0
    for i in range(len(hits)):
        for c in range(3):
            at[c] = np.int64(np.floor((hits[i, c] - corner[c]) / step_m))
        v = enter(table, keys, n, pack(0, at[0] >> _BITS, at[1] >> _BITS, at[2] >> _BITS))
        if v == n:
            points[v, :] = 0
            count[v] = 0
            n += 1
        voxel_of[i] = v
        points[v] += at
        count[v] += 1
    for v in range(n):
        points[v] //= count[v]
    n_voxels = n
    margin = (2 << (_BITS + n_levels - 1)) * step_m
    for i in range(len(known)):
        inside = True
        for c in range(3):
            inside = inside and corner[c] - margin <= known[i, c] <= upper[c] + margin
        if inside:
            for c in range(3):
                points[n, c] = np.int64(np.floor((known[i, c] - corner[c]) / step_m))
            n += 1
    return voxel_of, points[:n], n_voxels


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _finest_cells(points, table):
    """The cells of one voxel, from (P, 3) whole steps."""
    cell, moments = np.empty((len(points), 3), np.int32), np.empty((len(points), 10))
    keys, number = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
    one = np.zeros((1, 10))
    one[0, 0] = 1.0
    half = 1 << (_BITS - 1)
    n = 0
    for i in range(len(points)):
        x, y, z = points[i, 0] >> _BITS, points[i, 1] >> _BITS, points[i, 2] >> _BITS
        e = enter(table, keys, n, pack(0, x, y, z))
        if e == n:
            cell[e, 0], cell[e, 1], cell[e, 2] = x, y, z
            moments[e, :] = 0.0
            n += 1
        number[i] = e
        dx = points[i, 0] - (x << _BITS) - half
        dy = points[i, 1] - (y << _BITS) - half
        dz = points[i, 2] - (z << _BITS) - half
        _add(moments, e, _moved(one, 0, float(dx), float(dy), float(dz)))
    return _Cells(cell[:n], moments[:n], number, np.empty(0, np.int32), np.empty(0, np.int32), table, keys)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _coarser_cells(finer, level, table):
    """The cells of twice the edge, from those of a level."""
    n_finer = len(finer.cell)
    cell, moments = np.empty((n_finer, 3), np.int32), np.empty((n_finer, 10))
    keys, number = np.empty(n_finer, np.int64), np.empty(n_finer, np.int64)
    child, sibling = np.empty(n_finer, np.int32), np.empty(n_finer, np.int32)
    half = float(1 << (_BITS + level - 1))
    n = 0
    for i in range(n_finer):
        fx, fy, fz = np.int64(finer.cell[i, 0]), np.int64(finer.cell[i, 1]), np.int64(finer.cell[i, 2])
        e = enter(table, keys, n, pack(0, fx >> 1, fy >> 1, fz >> 1))
        if e == n:
            cell[e, 0], cell[e, 1], cell[e, 2] = fx >> 1, fy >> 1, fz >> 1
            moments[e, :] = 0.0
            child[e] = -1
            n += 1
        number[i] = e
        sibling[i] = child[e]
        child[e] = i
        dx, dy, dz = (2 * (fx & 1) - 1) * half, (2 * (fy & 1) - 1) * half, (2 * (fz & 1) - 1) * half
        _add(moments, e, _moved(finer.moments, i, dx, dy, dz))
    return _Cells(cell[:n], moments[:n], number, child[:n], sibling, table, keys)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _moved(m, i, dx, dy, dz):
    """The moments in row i of (N, 10), about a point, as ten numbers about another one that lies at minus d from it."""
    n, x, y, z = m[i, 0], m[i, 1], m[i, 2], m[i, 3]
    return (
        n,
        x + n * dx,
        y + n * dy,
        z + n * dz,
        m[i, 4] + (2.0 * x + n * dx) * dx,
        m[i, 5] + (2.0 * y + n * dy) * dy,
        m[i, 6] + (2.0 * z + n * dz) * dz,
        m[i, 7] + x * dy + y * dx + n * dx * dy,
        m[i, 8] + x * dz + z * dx + n * dx * dz,
        m[i, 9] + y * dz + z * dy + n * dy * dz,
    )


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _add(totals, e, moments):
    """Add ten numbers to row e of (N, 10), in place."""
    for i in range(10):
        totals[e, i] += moments[i]


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _sum_around(cells, coarser, e, edge):
    """Moments of the 3 x 3 x 3 cells around cell e about its centre, ten numbers; `edge` is a cell's, in steps.

    These cells are children of 8 coarser ones, so 8 look-ups find them.
    """
    cell, moments, child, sibling = cells.cell, cells.moments, coarser.child, coarser.sibling
    table, keys = coarser.table, coarser.keys
    cx, cy, cz = np.int64(cell[e, 0]), np.int64(cell[e, 1]), np.int64(cell[e, 2])
    n, x, y, z, xx, yy, zz, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for px in range((cx - 1) >> 1, ((cx + 1) >> 1) + 1):
        for py in range((cy - 1) >> 1, ((cy + 1) >> 1) + 1):
            for pz in range((cz - 1) >> 1, ((cz + 1) >> 1) + 1):
                parent = table[find(table, keys, pack(0, px, py, pz))]
                if parent < 0:
                    continue
                other = child[parent]
                while other >= 0:
                    dx, dy, dz = cell[other, 0] - cx, cell[other, 1] - cy, cell[other, 2] - cz
                    if max(abs(dx), abs(dy), abs(dz)) <= 1:
                        m = _moved(moments, other, dx * edge, dy * edge, dz * edge)
                        n, x, y, z = n + m[0], x + m[1], y + m[2], z + m[3]
                        xx, yy, zz = xx + m[4], yy + m[5], zz + m[6]
                        xy, xz, yz = xy + m[7], xz + m[8], yz + m[9]
                    other = sibling[other]
    return n, x, y, z, xx, yy, zz, xy, xz, yz


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _fit_planes(points, cells, coarser, cell_of, level, step_m, planar, planes):
    """Enter, in place, the planes of this level for voxels that have no sure one yet.

    Args:
        points: (V + K, 3) whole steps, those of the voxels first.
        cells, coarser: Of the level and of the next.
        cell_of: (V,) the cell of each voxel.
        level, step_m, planar: See `normals`.
        planes: Of the voxels.
    """
    edge = float(1 << (_BITS + level))
    n = len(cells.cell)
    is_fitted, tilt, sigma = np.zeros(n, np.bool_), np.empty(n), np.empty(n)
    normal, offset = np.empty((n, 3)), np.empty(n)
    for v in range(len(cell_of)):
        if planes.tilt[v] <= _MOST_TILT:
            continue
        e = cell_of[v]
        if not is_fitted[e]:
            is_fitted[e] = True
            moments = _sum_around(cells, coarser, e, edge)
            tilt[e], sigma[e], offset[e] = _plane(moments, edge, step_m, planar, normal[e])
        if tilt[e] < planes.tilt[v]:
            distance = -offset[e]
            for c in range(3):
                distance += normal[e, c] * (points[v, c] - (cells.cell[e, c] + 0.5) * edge)
            if abs(distance) * step_m <= _MOST_SIGMAS * sigma[e] + _OWN_M:
                planes.tilt[v], planes.sigma_m[v] = tilt[e], sigma[e]
                planes.normal[v, :] = normal[e]


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _plane(m, edge, step_m, planar, normal):
    """The plane of points with moments m, if they are one: its normal, into `normal` (3,), and how sure it is.

    Args:
        m: Ten numbers, in steps, see `_Cells`, about the centre of a cell.
        edge: Of the cell, in steps.
    Returns:
        tilt: rad, inf where the points are no plane; sigma, m; offset of the plane from the centre along its normal, steps.
    """
    n = m[0]
    if n < (_LEAST_POINTS_2D if planar else _LEAST_POINTS):
        return np.inf, 0.0, 0.0
    x, y, z = m[1] / n, m[2] / n, m[3] / n
    xx, yy, zz = m[4] / n - x * x, m[5] / n - y * y, m[6] / n - z * z
    xy, xz, yz = m[7] / n - x * y, m[8] / n - x * z, m[9] / n - y * z
    if planar:  # the vertical is made the widest axis, so the two smallest are horizontal
        zz, xz, yz = 2.0 * (xx + yy) + 1.0, 0.0, 0.0
    w0, w1, nx, ny, nz = smallest_axis(xx, yy, zz, xy, xz, yz)
    w0, w1 = max(w0, 0.0), max(w1, 0.0)
    sigma_m, width_m = np.sqrt(w0) * step_m, np.sqrt(w1) * step_m
    is_wide = width_m > max(_LEAST_WIDTH_M, _LEAST_WIDTH * edge * step_m)
    if not (is_wide and sigma_m < _MOST_SIGMA_M and w1 > _LEAST_RATIO * w0):
        return np.inf, 0.0, 0.0
    normal[0], normal[1], normal[2] = nx, ny, nz
    return np.sqrt(w0 / (n * w1)), sigma_m, nx * x + ny * y + nz * z


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _take_planes(rays, voxel_of, planes, out):
    """Give the hits, in place, the planes of their voxels."""
    for i in range(len(rays)):
        v = voxel_of[i]
        if planes.tilt[v] < np.inf:
            dot = 0.0
            for c in range(3):
                dot += planes.normal[v, c] * rays[i, c]
            sign = 1.0 if dot <= 0.0 else -1.0
            for c in range(3):
                out.normal[i, c] = sign * planes.normal[v, c]
            out.cosine[i] = min(abs(dot), 1.0)
            out.sigma_m[i] = planes.sigma_m[v]


@nb.njit(nogil=True, error_model="numpy", cache=True)
def smallest_axis(xx, yy, zz, xy, xz, yz):
    """The two smallest eigenvalues of a symmetric 3 x 3 matrix, and x, y, z of the unit eigenvector of the smallest.

    The eigenvalue that lies apart from the other two is found first, then the two of the plane across its axis. So equal
    eigenvalues lose no digits. Where the smallest is not single, the vector is one of many.

    Source: D. Eberly, A Robust Eigensolver for 3x3 Symmetric Matrices, 2014.
    """
    scale = max(abs(xx), abs(yy), abs(zz), abs(xy), abs(xz), abs(yz))
    if scale == 0.0:
        return 0.0, 0.0, 1.0, 0.0, 0.0
    xy, xz, yz = xy / scale, xz / scale, yz / scale
    mean = (xx + yy + zz) / (3.0 * scale)
    xx, yy, zz = xx / scale - mean, yy / scale - mean, zz / scale - mean
    p2 = (xx * xx + yy * yy + zz * zz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0
    if p2 < 1e-30:  # a sphere, up to rounding
        return mean * scale, mean * scale, 1.0, 0.0, 0.0
    p = np.sqrt(p2)
    det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    half_det = min(max(0.5 * det / (p * p2), -1.0), 1.0)
    is_smallest = half_det < 0.0
    turn = 2.0 * np.pi / 3.0 if is_smallest else 0.0
    apart = 2.0 * p * np.cos(np.arccos(half_det) / 3.0 + turn)
    vx, vy, vz = _null_axis(xx - apart, yy - apart, zz - apart, xy, xz, yz)
    if abs(vx) > abs(vy):
        length = np.hypot(vx, vz)
        ux, uy, uz = -vz / length, 0.0, vx / length
    else:
        length = np.hypot(vy, vz)
        ux, uy, uz = 0.0, vz / length, -vy / length
    tx, ty, tz = vy * uz - vz * uy, vz * ux - vx * uz, vx * uy - vy * ux
    uu = _product(xx, yy, zz, xy, xz, yz, ux, uy, uz, ux, uy, uz)
    tt = _product(xx, yy, zz, xy, xz, yz, tx, ty, tz, tx, ty, tz)
    ut = _product(xx, yy, zz, xy, xz, yz, ux, uy, uz, tx, ty, tz)
    middle, half = 0.5 * (uu + tt), 0.5 * (uu - tt)
    radius = np.hypot(half, ut)
    if is_smallest:
        own = _product(xx, yy, zz, xy, xz, yz, vx, vy, vz, vx, vy, vz)
        return (mean + own) * scale, (mean + middle - radius) * scale, vx, vy, vz
    a, b = (-ut, half + radius) if half >= 0.0 else (radius - half, -ut)
    length = np.hypot(a, b)
    a, b = (a / length, b / length) if length > 0.0 else (1.0, 0.0)
    low, high = (mean + middle - radius) * scale, (mean + middle + radius) * scale
    return low, high, a * ux + b * tx, a * uy + b * ty, a * uz + b * tz


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _null_axis(xx, yy, zz, xy, xz, yz):
    """Unit vector across the rows of a symmetric matrix of rank 2: the longest of their cross products."""
    ax, ay, az = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy  # rows 1 and 2
    bx, by, bz = xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz  # rows 1 and 3
    cx, cy, cz = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz  # rows 2 and 3
    a2, b2, c2 = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
    if b2 > a2:
        ax, ay, az, a2 = bx, by, bz, b2
    if c2 > a2:
        ax, ay, az, a2 = cx, cy, cz, c2
    if a2 == 0.0:
        return 1.0, 0.0, 0.0
    length = np.sqrt(a2)
    return ax / length, ay / length, az / length


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _product(xx, yy, zz, xy, xz, yz, ax, ay, az, bx, by, bz):
    """a^T M b of a symmetric matrix."""
    return (
        ax * (xx * bx + xy * by + xz * bz)
        + ay * (xy * bx + yy * by + yz * bz)
        + az * (xz * bx + yz * by + zz * bz)
    )
