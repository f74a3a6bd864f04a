"""What one scan shows about a place: which beams pass or end beside it, and what stands around it.

Two grids about the sensor hold a scan. *Directions* (azimuth x elevation) keep the beam nearest to the middle of each cell.
*Columns* (azimuth x horizontal range) keep what stands above the ground: its mean place, its lowest and its highest hit. Of
every cell it is known which filled cells lie nearest in its four quarters (up or farther, down or nearer, left, right). So a
place has five beams and five columns beside it, its own and four neighbours, however dense the scan is; they and its height
above the ground are the place's features. All are measured along the bearing, so that turning the scene changes nothing.

Where beams are few a place's neighbours are far from it, and the scan as a whole tells more: along which *lines* its columns
stand (the fronts of a street), how many of them are nearer than a place and how many as far, and how many beams there are.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float32, Float64, Int32
from potserver.numerics.beams import Beams
from potserver.numerics.fastexp import inner_loop
from potserver.numerics.ground import Ground

_AZIMUTHS, _ELEVATIONS, _RANGES = 180, 96, 64  # cells
_LOWEST_RAD, _CELL_RAD = np.radians(-64.0), np.radians(1.0)  # of elevation
_CELL_M = 0.5  # of range
_STANDS_M = 0.3  # above the ground
_SIDEWAYS_RAD = 1.6  # neighbours to the left and right are at most so far
_NEAREST_M = 0.5  # of range: nearer columns are as wide as there
_SIDES = 5  # the own cell and four quarters
_OF_PLACE, _OF_BEAM, _OF_COLUMN, _OF_LINES, _BETWEEN = 5, 5, 4, 11, 4  # features
FORMER_FEATURES = _OF_PLACE + _SIDES * (_OF_BEAM + _OF_COLUMN)  # of nets that knew no lines
N_FEATURES = FORMER_FEATURES + _OF_LINES + _BETWEEN
_TURNS, _STRIPS, _STRIP_M = 45, 64, 0.5  # of a quarter turn; of the distance from a line through the sensor
_SEARCHED = 500  # columns tell the direction
_FEW, _SOME = 3.0, 8.0  # columns: of fewer on a side their places say little
_APART_RAD = 1.6  # neighbours with more between them have no line in common
_NONE_M = -1.0  # range of an empty cell
_AT_ONCE = 128  # places: their features stay in the processor's cache
_QUICK = {"nnan", "ninf", "nsz", "arcp", "contract", "afn"}  # no `reassoc`: sums keep their order
_FEET_M, _ROOM_M, _FAR_M = 0.2, 0.5, 5.0  # scales at which lengths are told apart
# Where no beam came near, nothing is called sure: a beam is near that passes so far beside, or ends so far before.
_BESIDE_M, _BEFORE_M, _UNSEEN_LOG_ODDS = 1.5, 1.2, 2.0


class Lines(NamedTuple):
    """Along what a scan's columns stand: in the first direction they lie in the fewest strips, the second is across."""

    scene: Float32  # (4,) cosine and sine of the first; how many columns, how many beams, in [0, 1] about
    strips: (
        Float32  # (2, 2, strips, 2) by direction, side and distance: the shares of columns nearer, and there
    )
    sides: (
        Float32  # (2, 2, 2) the distance that half of the columns are within, m; how many they are, in [0, 1)
    )


class Surroundings(NamedTuple):
    """A scan, ready to be asked about places around it. The sensor is the origin, the axes are the map's."""

    ground: Ground
    beams: Float32  # (azimuths x elevations, 5): azimuth and elevation, rad; length and height of the end, m; whether an echo
    columns: (
        Float32  # (azimuths x ranges, 4): azimuth, rad; range, highest and lowest hit above the ground, m
    )
    by_beams: Int32  # (4, azimuths x elevations) the nearest filled cell in each quarter; -1: none
    by_columns: Int32  # (4, azimuths x ranges)
    lines: Lines

    @staticmethod
    def of(beams: Beams, ground: Ground) -> Surroundings:
        """Those of a scan's beams."""
        heights = ground.below(beams.ends)
        found, columns = _enter(beams.ends, beams.is_return, heights)
        by_beams = _nearest(found, _ELEVATIONS, True)
        lines = Lines(*_lines_of(columns, len(beams.ends)))
        return Surroundings(ground, found, columns, by_beams, _nearest(columns, _RANGES, False), lines)

    def features(self, points: Float64) -> Float32:
        """(N, N_FEATURES) about (N, 3) places, m; each in [-1, 1.5]."""
        out = np.empty((len(points), N_FEATURES), np.float32)
        _features(points, self.ground.below(points), *self[1:], out)
        return out

    def expected(self, points: Float64, net: Perceptron) -> Float64:
        """(N,) log-odds at (N, 3) places, m; between -2 and 2 where no beam came near."""
        out = np.empty(len(points))
        _expected(points, self.ground.below(points), *self[1:], *net, out)
        return out


class Perceptron(NamedTuple):
    """Log-odds from features, through two layers of rectified sums."""

    first: Float32  # (N_FEATURES, A)
    first_bias: Float32  # (A,)
    second: Float32  # (A, B)
    second_bias: Float32  # (B,)
    last: Float32  # (B,)
    last_bias: Float32  # (1,)

    @property
    def is_sound(self) -> bool:
        """Shapes fit together, and numbers are finite."""
        a, b = len(self.first_bias), len(self.second_bias)
        shapes = (N_FEATURES, a), (a,), (a, b), (b,), (b,), (1,)
        fits = all(array.shape == shape for array, shape in zip(self, shapes, strict=True))
        return fits and a > 0 and b > 0 and all(np.isfinite(array).all() for array in self)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _cell(x, n):
    return min(max(np.int64(np.floor(x)), 0), n - 1)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _turned(angle):
    if angle > np.pi:
        return angle - 2 * np.pi
    return angle + 2 * np.pi if angle < -np.pi else angle


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter(ends, is_return, height):
    beams = np.full((_AZIMUTHS * _ELEVATIONS, 5), _NONE_M, np.float32)
    columns = np.zeros((_AZIMUTHS * _RANGES, 4), np.float32)
    off = np.full(len(beams), np.inf)
    n_hits = np.zeros(len(columns))
    for b in range(len(ends)):
        x, y, z = ends[b]
        across = np.hypot(x, y)
        azimuth, elevation = np.arctan2(y, x), np.arctan2(z, across)
        u, v = (azimuth + np.pi) * (_AZIMUTHS / (2 * np.pi)), (elevation - _LOWEST_RAD) / _CELL_RAD
        i, j = _cell(u, _AZIMUTHS), _cell(v, _ELEVATIONS)
        c = i * _ELEVATIONS + j
        d = 4 * (u - i - 0.5) ** 2 + (v - j - 0.5) ** 2
        if d < off[c]:
            off[c] = d
            beams[c, 0], beams[c, 1], beams[c, 2] = azimuth, elevation, np.hypot(across, z)
            beams[c, 3], beams[c, 4] = height[b], is_return[b]
        if is_return[b] and height[b] > _STANDS_M:
            c = i * _RANGES + _cell(across / _CELL_M, _RANGES)
            columns[c, 0] += azimuth
            columns[c, 1] += across
            columns[c, 2] = max(columns[c, 2], height[b])
            columns[c, 3] = min(columns[c, 3], height[b]) if n_hits[c] else height[b]
            n_hits[c] += 1
    for c in range(len(columns)):
        if n_hits[c]:
            columns[c, 0] /= n_hits[c]
            columns[c, 1] /= n_hits[c]
        else:
            columns[c, 1] = _NONE_M
    return beams, columns


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _in_strips(x, y, cos, sin):
    """(2, 2, strips) how many places lie at which distance, on either side of the two directions."""
    out = np.zeros((2, 2, _STRIPS))
    for i in range(len(x)):
        beside, along = cos * y[i] - sin * x[i], cos * x[i] + sin * y[i]
        out[0, np.int64(beside > 0), _cell(abs(beside) / _STRIP_M, _STRIPS)] += 1
        out[1, np.int64(along > 0), _cell(abs(along) / _STRIP_M, _STRIPS)] += 1
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _crowded(strips):
    """How much falls into the same strip or the next."""
    total = 0.0
    for side in range(2):
        row = strips[side]
        for b in range(_STRIPS):
            total += row[b] * (row[b] + 2.0 * (row[b - 1] if b else 0.0))
    return total


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _lines_of(columns, n_beams):
    """What `Lines` holds."""
    stands = columns[:, 1] >= 0
    x, y = columns[stands, 1] * np.cos(columns[stands, 0]), columns[stands, 1] * np.sin(columns[stands, 0])
    n, best, most = len(x), 0.0, -1.0
    step = 1 + n // _SEARCHED
    for turn in range(2 * _TURNS):
        angle = turn * (np.pi / 2 / _TURNS)
        crowded = _crowded(_in_strips(x[::step], y[::step], np.cos(angle), np.sin(angle))[0])
        if crowded > most:
            best, most = angle, crowded
    scene = np.array(
        [np.cos(best), np.sin(best), np.log(n + 1.0) / 8.0, np.log(max(n_beams, 1)) / 12.0], np.float32
    )
    counts = _in_strips(x, y, scene[0], scene[1])
    strips, sides = np.zeros((2, 2, _STRIPS, 2), np.float32), np.zeros((2, 2, 2), np.float32)
    for d in range(2):
        for side in range(2):
            row, nearer = counts[d, side], 0.0
            total, half = row.sum(), _STRIPS * _STRIP_M
            for b in range(_STRIPS):
                about = row[max(b - 1, 0) : b + 2].sum()
                strips[d, side, b, 0], strips[d, side, b, 1] = (
                    (nearer + 0.5 * row[b]) / max(total, 1.0),
                    about / (total + _FEW),
                )
                if nearer <= 0.5 * total < nearer + row[b]:
                    half = (b + 0.5) * _STRIP_M
                nearer += row[b]
            sides[d, side, 0], sides[d, side, 1] = half, total / (total + _SOME)
    return scene, strips, sides


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_filled(cells, c, are_beams):
    return cells[c, 2 if are_beams else 1] >= 0


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _nearest(cells, n, are_beams):
    """(4, cells) the nearest filled cells: one of the three next ones in a quarter, or what is nearest to them there."""
    out = np.full((4, len(cells)), -1, np.int32)
    for quarter in range(4):
        along, sign = quarter < 2, 1 - 2 * (quarter % 2)
        steps, width = (n, _AZIMUTHS) if along else (2 * _AZIMUTHS, n)
        for s in range(steps):
            for w in range(width):
                back = steps - 1 - s if sign > 0 else s
                a, j = (w, back) if along else (back % _AZIMUTHS, w)
                out[quarter, a * n + j] = _nearest_of_three(
                    cells, out[quarter], a, j, n, along, sign, are_beams
                )
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _nearest_of_three(cells, found, a, j, n, along, sign, are_beams):
    azimuth = (a + 0.5) * (2 * np.pi / _AZIMUTHS) - np.pi
    other = _LOWEST_RAD + (j + 0.5) * _CELL_RAD if are_beams else (j + 0.5) * _CELL_M
    width = np.cos(other) if are_beams else max(other, _NEAREST_M)
    best, least = np.int32(-1), np.inf
    for t in range(-1, 2):
        i = (a + (t if along else sign)) % _AZIMUTHS
        k = j + (sign if along else t)
        if not 0 <= k < n:
            continue
        beside = i * n + k
        for c in (np.int32(beside) if _is_filled(cells, beside, are_beams) else np.int32(-1), found[beside]):
            if c < 0:
                continue
            turn = abs(_turned(cells[c, 0] - azimuth))
            if not along and turn > _SIDEWAYS_RAD:
                continue
            d = (turn * width) ** 2 + (cells[c, 1] - other) ** 2
            if d < least:
                best, least = c, d
    return best


@nb.njit(nogil=True, fastmath=_QUICK, error_model="numpy", cache=True)
def _of(x, scale):
    """A length in (-1, 1): its sign, and half of it at the scale."""
    return x / (scale + abs(x))


@nb.njit(nogil=True, fastmath=_QUICK, error_model="numpy", cache=True)
def _features_at(point, h, beams, columns, by_beams, by_columns, lines, f):
    """Fill in the features; whether a beam came near."""
    x, y, z = point
    across = np.hypot(x, y)
    length = np.hypot(across, z)
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, across)
    i = _cell((azimuth + np.pi) * (_AZIMUTHS / (2 * np.pi)), _AZIMUTHS)
    beam = i * _ELEVATIONS + _cell((elevation - _LOWEST_RAD) / _CELL_RAD, _ELEVATIONS)
    column = i * _RANGES + _cell(across / _CELL_M, _RANGES)
    f[0], f[1], f[2] = _of(h, _FEET_M), _of(h, 1.0), 0.25 * min(max(h, -2.0), 6.0)
    f[3], f[4] = min(across / 25.0, 1.5), _of(across, _FAR_M)
    n, is_near = _OF_PLACE, False
    for side in range(_SIDES):
        c = beam if side == 0 else by_beams[side - 1, beam]
        if c >= 0 and _is_filled(beams, c, True):
            b = beams[c]
            beside, above = abs(_turned(b[0] - azimuth)) * across, abs(b[1] - elevation) * length
            is_near |= beside**2 + above**2 < _BESIDE_M**2 and b[2] > length - _BEFORE_M
            f[n], f[n + 1] = _of(beside, _ROOM_M), _of(above, _ROOM_M)
            f[n + 2], f[n + 3], f[n + 4] = _of(b[2] - length, 1.0), _of(b[3], _ROOM_M), b[4]
        else:
            f[n], f[n + 1], f[n + 2], f[n + 3], f[n + 4] = 1.0, 1.0, 0.0, 0.0, 0.0
        n += _OF_BEAM
    for side in range(_SIDES):
        c = column if side == 0 else by_columns[side - 1, column]
        if c >= 0 and _is_filled(columns, c, False):
            b = columns[c]
            f[n] = _of(abs(_turned(b[0] - azimuth)) * across, _ROOM_M)
            f[n + 1] = _of(b[1] - across, _ROOM_M)
            f[n + 2], f[n + 3] = _of(b[2], 1.0), _of(b[3], 1.0)
        else:
            f[n], f[n + 1], f[n + 2], f[n + 3] = 1.0, 0.0, 0.0, 0.0
        n += _OF_COLUMN
    _lines_at(x, y, across, lines, f, n)
    n += _OF_LINES
    _between(beams, by_beams[0, beam], by_beams[1, beam], 1, elevation, 2, length, f, n)
    _between(columns, by_columns[2, column], by_columns[3, column], 0, azimuth, 1, across, f, n + 2)
    return is_near


@nb.njit(nogil=True, fastmath=_QUICK, error_model="numpy", cache=True)
def _lines_at(x, y, across, lines, f, n):
    scene, strips, sides = lines
    beside, along = scene[0] * y - scene[1] * x, scene[0] * x + scene[1] * y
    f[n], f[n + 1], f[n + 2] = scene[2], scene[3], (along / max(across, np.float32(0.1))) ** 2
    n += 3
    for d in range(2):
        off = along if d else beside
        side = 1 if off > 0 else 0
        off = abs(off)
        at = off * (1.0 / _STRIP_M) - 0.5
        b = _cell(at, _STRIPS - 1)
        share = np.float32(min(max(at - b, 0.0), 1.0))
        low, high = strips[d, side, b], strips[d, side, b + 1]
        f[n], f[n + 1] = low[0] + share * (high[0] - low[0]), low[1] + share * (high[1] - low[1])
        f[n + 2], f[n + 3] = _of(off - sides[d, side, 0], 1.0), sides[d, side, 1]
        n += 4


@nb.njit(nogil=True, fastmath=_QUICK, error_model="numpy", cache=True)
def _between(cells, one, other, along, at, of, length, f, n):
    """How much farther than a place the line from one neighbour to the other is, about, and how near these are."""
    f[n], f[n + 1] = 0.0, 0.0
    if one < 0 or other < 0:
        return
    p, q = _turned(cells[one, along] - at), _turned(cells[other, along] - at)
    apart = abs(p - q)
    if p * q >= 0 or apart > _APART_RAD:
        return
    a, b = max(cells[one, of], np.float32(_NEAREST_M)), max(cells[other, of], np.float32(_NEAREST_M))
    away = a * b * apart / (a * abs(p) + b * abs(q))
    f[n], f[n + 1] = _of(away - length, 1.0), 1.0 / (1.0 + 4.0 * apart)


@nb.njit(nogil=True, fastmath=_QUICK, error_model="numpy", cache=True)
def _features(points, height, beams, columns, by_beams, by_columns, lines, out):
    for p in range(len(points)):
        _features_at(points[p], height[p], beams, columns, by_beams, by_columns, lines, out[p])


# In a layer the places are the inner loop: BLAS would wake all processors for products as small as these.
@inner_loop
def _add_four(a, b, c, d, p, q, r, s, out):
    for i in range(len(out)):
        out[i] += p * a[i] + q * b[i] + r * c[i] + s * d[i]


@inner_loop
def _add_one(a, p, out):
    for i in range(len(out)):
        out[i] += p * a[i]


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _layer(x, weights, bias, out):
    """Rectified sums of columns of x, (features, places), in place."""
    n = len(weights)
    whole = n - n % 4
    for j in range(len(bias)):
        row = out[j]
        row[:] = bias[j]
        for i in range(0, whole, 4):
            _add_four(
                x[i], x[i + 1], x[i + 2], x[i + 3],
                weights[i, j], weights[i + 1, j], weights[i + 2, j], weights[i + 3, j], row,
            )  # fmt: skip
        for i in range(whole, n):
            _add_one(x[i], weights[i, j], row)
        for k in range(len(row)):
            row[k] = max(row[k], np.float32(0))


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _expected(points, height, beams, columns, by_beams, by_columns, lines, w1, b1, w2, b2, w3, b3, out):
    f, x = np.empty(N_FEATURES, np.float32), np.zeros((N_FEATURES, _AT_ONCE), np.float32)
    one, two = np.empty((len(b1), _AT_ONCE), np.float32), np.empty((len(b2), _AT_ONCE), np.float32)
    most = np.empty(_AT_ONCE)
    for start in range(0, len(points), _AT_ONCE):
        n = min(_AT_ONCE, len(points) - start)
        for p in range(n):
            is_near = _features_at(
                points[start + p], height[start + p], beams, columns, by_beams, by_columns, lines, f
            )
            most[p] = np.inf if is_near else _UNSEEN_LOG_ODDS
            for i in range(N_FEATURES):
                x[i, p] = f[i]
        _layer(x, w1, b1, one)
        _layer(one, w2, b2, two)
        for p in range(n):
            total = b3[0]
            for j in range(len(two)):
                total += w3[j] * two[j, p]
            out[start + p] = min(max(total, -most[p]), most[p])
