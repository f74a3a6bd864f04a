"""Dense blocks of features: rows are sorted into cubes, and each cube has phi of all its rows and all kernels that reach it.

All rows of a block share one list of kernels. So products gather and scatter once a cube and run over dense memory. About half
of the values are smaller than the cut, and products are still several times faster than with sparse rows. Blocks are built anew
for every solve, which costs less than updating them when rows move and kernels are added. Products are bound by memory: blocks
of one byte a value, off by at most 1/510, are more than twice as fast as those of four bytes.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float32, Float64, Floats, Int32, Int64, UInt8
from potserver.numerics.cubes import sort_into_cubes
from potserver.numerics.fastexp import exp32, inner_loop
from potserver.numerics.gathering import kernels_that_reach
from potserver.numerics.geometry import bounds
from potserver.numerics.kernel_index import build_index
from potserver.numerics.threads import parallel_map, spans

# Kernels of a cube of rounded values are filled up to a multiple of this: whole vectors are faster than what is left over.
_LANES = 8
_FAR = np.array([1e4, 1e4, 1e4, -1.0], np.float32)  # relative hinge, m, and -gamma of what fills up
_SPANS = (
    8  # of cubes, at most; the number of threads plays no part in how they are cut, and so none in the sums
)
_ROWS_OF_SPAN = 4096  # at least: fewer take no longer than it does to hand them to a thread


class Block(NamedTuple):
    """Some cubes: phi of cube c is (cuts[c + 1] - cuts[c], kernels[c + 1] - kernels[c]), row by row, from values[c] on."""

    cuts: Int64  # (C + 1,) first row of each cube, in the sorted order
    kernels: Int64  # (C + 1,) where each cube's kernels start in `numbers`
    starts: Int64  # (C + 1,) where each cube's phi starts in `phi`
    numbers: Int32  # of kernels; what fills up a cube of rounded values is 0, with a phi of 0
    phi: Float32 | UInt8  # in units of `Blocks.unit`


class Blocks(NamedTuple):
    """Phi of N rows and K kernels."""

    order: Int64  # (N,) row r of the blocks is points[order[r]]
    parts: list[Block]  # runs of cubes, always cut alike
    n_kernels: int
    unit: np.float32  # what a stored value is worth

    @property
    def n_values(self) -> int:
        """Stored values of phi: one product with the features touches each once."""
        return sum(len(part.phi) for part in self.parts)


def feature_blocks(
    points: Float64,
    hinge: Float64,
    gamma: Floats,
    *,
    edge_m: float,
    cut: float,
    bytes_a_value: int = 4,
    threads: int = 1,
) -> Blocks:
    """phi of the kernels that reach each cube of points.

    Args:
        points: (N, 3) m, small coordinates (they are made relative to their cube in float32).
        hinge: (K, 3) m, same frame.
        gamma: (K,) 1/m^2.
        edge_m: Of a cube; some twenty points to a cube are good.
        cut: A kernel reaches as far as its phi is at least this.
        bytes_a_value: 4 keeps float32; 1 rounds phi to multiples of 1/255, which is finer than a cut of .02.
        threads: Threads to spread the cubes over.
    """
    exact = bytes_a_value == 4
    unit = np.float32(1.0 if exact else 1.0 / 255.0)
    kind = np.empty(0, np.float32 if exact else np.uint8)
    if len(points) == 0 or len(hinge) == 0:
        return Blocks(np.arange(len(points)), [], len(hinge), unit)
    ones = np.ones(len(hinge))
    index = build_index(
        hinge, gamma, ones, np.zeros(len(hinge)), activation_cut=cut, tau=cut, guard_stacks=False
    )
    order, cuts, groups = sort_into_cubes(points, edge_m)
    grouped = points[order]

    def run(span: tuple[int, int]) -> Block:
        # whole groups: kernels are looked up once for each, and then picked for its cubes
        inside = cuts[groups[span[0]] : groups[span[1]] + 1]
        return Block(
            inside,
            *_build(
                grouped, inside, groups[span[0] : span[1] + 1] - groups[span[0]], index, kind, np.float32(1.0) / unit,
                np.float32(0.0 if exact else 0.5), 1 if exact else _LANES,
            ),
        )  # fmt: skip

    cut_up = spans(len(groups) - 1, min(_SPANS, 1 + len(points) // _ROWS_OF_SPAN))
    return Blocks(order, parallel_map(run, cut_up, threads), len(hinge), unit)


def product(blocks: Blocks, weights: Float32, *, threads: int = 1) -> Float32:
    """(N,) Phi w, in the blocks' order."""
    out = np.zeros(len(blocks.order), np.float32)
    parallel_map(
        lambda b: _product(b, blocks.unit, weights, out),
        blocks.parts,
        threads,
    )
    return out


def gradient_and_diagonal(
    blocks: Blocks, residual: Float32, curvature: Float32, *, threads: int = 1
) -> tuple[Float32, Float32]:
    """(K,) Phi^T r and (K,) diagonal of Phi^T diag(curvature) Phi, in one pass."""
    return _summed(blocks, residual, curvature, False, threads)


def two_diagonals(
    blocks: Blocks, one: Float32, other: Float32, *, threads: int = 1
) -> tuple[Float32, Float32]:
    """(K,) diagonals of Phi^T diag(one) Phi and of Phi^T diag(other) Phi, in one pass."""
    return _summed(blocks, one, other, True, threads)


def _summed(
    blocks: Blocks, one: Float32, other: Float32, are_both_squares: bool, threads: int
) -> tuple[Float32, Float32]:
    parts = parallel_map(
        lambda b: _sums_of_kernels(b, blocks.unit, one, other, are_both_squares, blocks.n_kernels),
        blocks.parts,
        threads,
    )
    total = np.zeros((2, blocks.n_kernels), np.float32)
    for part in parts:
        total += part
    return total[0], total[1]


def normal_product(blocks: Blocks, curvature: Float32, direction: Float32, *, threads: int = 1) -> Float32:
    """(K,) Phi^T diag(curvature) Phi d, in one pass."""
    parts = parallel_map(
        lambda b: _normal(b, blocks.unit, curvature, direction),
        blocks.parts,
        threads,
    )
    if len(parts) == 1:
        return parts[0]
    return np.sum(parts, axis=0, dtype=np.float32) if parts else np.zeros(blocks.n_kernels, np.float32)


# Inner loops get their row as a slice. With an offset into the whole array the compiler has to allow for negative indices, and
# makes no SIMD code.
@inner_loop
def _phi_row(x, y, z, hx, hy, hz, minus_gamma, out):
    for i in range(len(out)):
        dx = x - hx[i]
        dy = y - hy[i]
        dz = z - hz[i]
        out[i] = exp32(minus_gamma[i] * (dx * dx + dy * dy + dz * dz))


@inner_loop
def _store(row, scale, offset, out):
    for i in range(len(out)):
        out[i] = row[i] * scale + offset


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _build(points, cuts, groups, index, kind, scale, offset, lanes):
    hinge, columns = index.hinge, index.columns
    n_cubes = len(cuts) - 1
    kernels = np.zeros(n_cubes + 1, np.int64)
    starts = np.zeros(n_cubes + 1, np.int64)
    reached = np.empty(64 * n_cubes + 4096, np.int64)
    found = np.empty(4096, np.int64)
    centre = np.empty((n_cubes, 3))
    near = np.empty((4, 4096), np.float32)
    most = 0
    for g in range(len(groups) - 1):
        lower, upper = bounds(points[cuts[groups[g]] : cuts[groups[g + 1]]])
        n_near, found = kernels_that_reach(index, lower, upper, found)
        if n_near > near.shape[1]:
            near = np.empty((4, 2 * n_near), np.float32)
        gx, gy, gz = lower
        for i in range(n_near):
            m = found[i]
            near[0, i] = hinge[m, 0] - gx
            near[1, i] = hinge[m, 1] - gy
            near[2, i] = hinge[m, 2] - gz
            near[3, i] = columns[3, m] * columns[3, m]
        for cube in range(groups[g], groups[g + 1]):
            a, b = cuts[cube], cuts[cube + 1]
            lower, upper = bounds(points[a:b])
            first = kernels[cube]
            if first + n_near + lanes > len(reached):
                more = np.empty(2 * (first + n_near + lanes), np.int64)
                more[:first] = reached[:first]
                reached = more
            x0, y0, z0 = np.float32(lower[0] - gx), np.float32(lower[1] - gy), np.float32(lower[2] - gz)
            x1, y1, z1 = np.float32(upper[0] - gx), np.float32(upper[1] - gy), np.float32(upper[2] - gz)
            n = 0
            for i in range(n_near):
                dx = max(max(x0 - near[0, i], near[0, i] - x1), np.float32(0))
                dy = max(max(y0 - near[1, i], near[1, i] - y1), np.float32(0))
                dz = max(max(z0 - near[2, i], near[2, i] - z1), np.float32(0))
                if dx * dx + dy * dy + dz * dz <= near[3, i]:
                    reached[first + n] = found[i]
                    n += 1
            for c in range(3):
                centre[cube, c] = 0.5 * (lower[c] + upper[c])
            while n % lanes:  # a kernel far away: it has phi 0, and adds nothing
                reached[first + n] = -1
                n += 1
            most = max(most, n)
            kernels[cube + 1] = first + n
            starts[cube + 1] = starts[cube] + (b - a) * n
    numbers = np.empty(kernels[-1], np.int32)
    phi = np.empty(starts[-1], kind.dtype)  # of the right size at once: it is large
    local = np.empty((5, most), np.float32)
    for cube in range(n_cubes):
        first, at = kernels[cube], starts[cube]
        n = kernels[cube + 1] - first
        cx, cy, cz = centre[cube]
        for i in range(n):
            m = reached[first + i]
            if m < 0:
                local[:4, i] = _FAR
                numbers[first + i] = 0
                continue
            local[0, i] = hinge[m, 0] - cx
            local[1, i] = hinge[m, 1] - cy
            local[2, i] = hinge[m, 2] - cz
            local[3, i] = columns[0, m]
            numbers[first + i] = index.order[m]
        for q in range(cuts[cube], cuts[cube + 1]):
            _phi_row(
                np.float32(points[q, 0] - cx), np.float32(points[q, 1] - cy), np.float32(points[q, 2] - cz),
                local[0], local[1], local[2], local[3], local[4, :n],
            )  # fmt: skip
            _store(local[4], scale, offset, phi[at : at + n])
            at += n
    return kernels, starts, numbers, phi


@inner_loop
def _dot(row, w):
    s = np.float32(0)
    for i in range(len(row)):
        s += np.float32(row[i]) * w[i]
    return s


@inner_loop
def _axpy(row, a, out):
    for i in range(len(row)):
        out[i] += a * np.float32(row[i])


# Two rows at once, each with the same sums to the bit: what they share is loaded and stored half as often.
@inner_loop
def _dot_two(one, other, w):
    s, t = np.float32(0), np.float32(0)
    for i in range(len(w)):
        s += np.float32(one[i]) * w[i]
        t += np.float32(other[i]) * w[i]
    return s, t


@inner_loop
def _axpy_two(one, other, a, b, out):
    for i in range(len(out)):
        out[i] = (out[i] + a * np.float32(one[i])) + b * np.float32(other[i])


@inner_loop
def _axpy_both(row, a, b, out, squares):
    for i in range(len(row)):
        phi = np.float32(row[i])
        out[i] += a * phi
        squares[i] += b * phi * phi


@inner_loop
def _add_squares(row, a, b, one, other):
    for i in range(len(row)):
        phi = np.float32(row[i])
        square = phi * phi
        one[i] += a * square
        other[i] += b * square


@nb.njit(nogil=True, error_model="numpy", cache=True)
def widest(kernels):
    """The most kernels that reach one cube, from `Block.kernels`."""
    most = 0
    for c in range(len(kernels) - 1):
        most = max(most, kernels[c + 1] - kernels[c])
    return most


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _product(block, unit, weights, out):
    cuts, kernels, starts, numbers, phi = block
    w = np.empty(widest(kernels), np.float32)
    for c in range(len(cuts) - 1):
        first, at = kernels[c], starts[c]
        n = kernels[c + 1] - first
        for i in range(n):
            w[i] = unit * weights[numbers[first + i]]
        for q in range(cuts[c], cuts[c + 1]):
            out[q] = _dot(phi[at : at + n], w)
            at += n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _sums_of_kernels(block, unit, one, other, are_both_squares, n_kernels):
    """(2, K) sums over the rows: of `one` times phi, or times phi^2 where both are squares, and of `other` times phi^2."""
    cuts, kernels, starts, numbers, phi = block
    out = np.zeros((2, n_kernels), np.float32)
    sums, squares = np.empty(widest(kernels), np.float32), np.empty(widest(kernels), np.float32)
    scale = unit * unit if are_both_squares else unit
    for c in range(len(cuts) - 1):
        first, at = kernels[c], starts[c]
        n = kernels[c + 1] - first
        sums[:n] = 0
        squares[:n] = 0
        for q in range(cuts[c], cuts[c + 1]):
            row = phi[at : at + n]
            if are_both_squares:
                _add_squares(row, one[q], other[q], sums, squares)
            else:
                _axpy_both(row, one[q], other[q], sums, squares)
            at += n
        for i in range(n):
            m = numbers[first + i]
            out[0, m] += scale * sums[i]
            out[1, m] += unit * unit * squares[i]
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _normal(block, unit, curvature, direction):
    cuts, kernels, starts, numbers, phi = block
    out = np.zeros(len(direction), np.float32)
    d, sums = np.empty(widest(kernels), np.float32), np.empty(widest(kernels), np.float32)
    for c in range(len(cuts) - 1):
        first, at = kernels[c], starts[c]
        n = kernels[c + 1] - first
        sums[:n] = 0
        for i in range(n):
            d[i] = unit * direction[numbers[first + i]]
        q, end = cuts[c], cuts[c + 1]
        while q + 1 < end:
            one, other = phi[at : at + n], phi[at + n : at + 2 * n]
            s, t = _dot_two(one, other, d[:n])
            _axpy_two(one, other, s * curvature[q], t * curvature[q + 1], sums[:n])
            at += 2 * n
            q += 2
        if q < end:
            row = phi[at : at + n]
            _axpy(row, _dot(row, d) * curvature[q], sums)
        for i in range(n):
            out[numbers[first + i]] += unit * sums[i]
    return out
