"""Open-addressing hash of voxels: from three cell numbers and a kind to the number of an entry. For use inside numba code.

A key packs the kind (0 to 7) and three cell numbers of 20 bits, so cells run from -2^19 to 2^19 - 1 about the frame's origin.
The table holds numbers of entries, -1 where it is free; the keys themselves are kept beside it, one an entry.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.arrays import Int32

CELL_LIMIT = 2**19


def empty_table(n_entries: int) -> Int32:
    """A table that stays at most half full with so many entries."""
    return np.full(1 << max(4, (2 * n_entries).bit_length()), -1, np.int32)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def pack(kind, x, y, z):
    """int64 key of a voxel."""
    bias = np.int64(1 << 19)
    return (
        (np.int64(kind) << 60)
        | ((np.int64(x) + bias) << 40)
        | ((np.int64(y) + bias) << 20)
        | (np.int64(z) + bias)
    )


@nb.njit(nogil=True, error_model="numpy", cache=True)
def unpack(key):
    """What a key was packed from: the kind and three cell numbers."""
    bias, mask = np.int64(1 << 19), np.int64((1 << 20) - 1)
    return key >> 60, ((key >> 40) & mask) - bias, ((key >> 20) & mask) - bias, (key & mask) - bias


@nb.njit(nogil=True, error_model="numpy", cache=True)
def find(table, keys, key):
    """Where in the table the key is, or the free place where it would be entered."""
    mask = len(table) - 1
    h = key ^ (key >> 31)
    h *= np.int64(0x7FB5D329728EA185)
    h ^= h >> 27
    h *= np.int64(-0x7E25210B43D22BB3)
    h ^= h >> 33
    place = h & mask
    while table[place] >= 0 and keys[table[place]] != key:
        place = (place + 1) & mask
    return place


@nb.njit(nogil=True, error_model="numpy", cache=True)
def enter(table, keys, n, key):
    """The number of the key's entry among n; n itself if the key is new, and entered by this."""
    place = find(table, keys, key)
    if table[place] < 0:
        table[place] = n
        keys[n] = key
    return np.int64(table[place])


@nb.njit(nogil=True, error_model="numpy", cache=True)
def any_around(table, keys, kind, voxel, reach):
    """Whether a voxel of a kind, (3,) numbers, or one at most `reach` voxels from it along each axis, has an entry."""
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            for dz in range(-reach, reach + 1):
                key = pack(kind, voxel[0] + dx, voxel[1] + dy, voxel[2] + dz)
                if table[find(table, keys, key)] >= 0:
                    return True
    return False
