"""Binary OctoMap files (`*.bt`): a tree of occupied and free voxels, sixteen levels deep. numpy only.

A file is a text header (`# Octomap OcTree binary file`, then lines `id OcTree`, `size` in nodes, `res` in metres, `data`) and
two bytes for each inner node, depth first, parents before children. Child c takes their bits 2c and 2c + 1, little-endian:
0 unknown, 1 free, 2 occupied, 3 an inner node itself. Bit 0 of a child's number is its side in x, bit 1 in y, bit 2 in z. The
key of a coordinate is floor(x / res) + 32768 along each axis; what lies beyond 16 bits cannot be said.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arrays import Bool
from potclient.errors import UsageError
from potclient.files import whole

Int64 = NDArray[np.int64]

DEPTH = 16  # levels below the root
KEY_ORIGIN = 2 ** (DEPTH - 1)  # key of the coordinate 0
_MAGIC = b"# Octomap OcTree binary file"
_FREE, _OCCUPIED, _INNER = 1, 2, 3


class Leaves(NamedTuple):
    """Voxels of known state, none inside another; one of depth d spans 2^(16 - d) keys along each axis."""

    keys: Int64  # (L, 3) the lowest key of each
    depth: Int64  # (L,) 1 .. 16
    occupied: Bool  # (L,) false = free


class OcTreeBuilder:
    """Collects voxels, eight equal siblings as one, so that what is known of large regions takes little memory."""

    def __init__(self) -> None:
        self._batches: list[tuple[Int64, Int64, Bool]] = []

    def add(self, keys: ArrayLike, occupied: ArrayLike) -> None:
        """Add voxels of the finest level, each once in the life of the builder.

        Args:
            keys: (N, 3) integers, 0 .. 65535.
            occupied: (N,) bool; false = free.
        Raises:
            UsageError: keys that need more than 16 bits, or arrays that disagree.
        """
        array, state = np.asarray(keys, np.int64), np.asarray(occupied, np.bool_)
        if array.ndim != 2 or array.shape[1] != 3 or state.shape != (len(array),):
            raise UsageError(f"voxels: keys {array.shape} and states {state.shape}, need (N, 3) and (N,)")
        if len(array) and (array.min() < 0 or array.max() >= 2 * KEY_ORIGIN):
            raise UsageError(
                "voxels beyond the 65536 along each axis of an OctoMap; take a coarser resolution"
            )
        self._batches.append(_pruned(_interleave(array), np.full(len(array), DEPTH), state))

    def leaves(self) -> Leaves:
        """All that was added, pruned."""
        if not self._batches:
            self.add(np.zeros((0, 3), np.int64), np.zeros(0, np.bool_))
        codes, depth, occupied = (np.concatenate(column) for column in zip(*self._batches, strict=True))
        self._batches = [_pruned(codes, depth, occupied)]
        codes, depth, occupied = self._batches[0]
        return Leaves(_spread_out(codes), depth, occupied)


def tree_bytes(leaves: Leaves) -> tuple[bytes, int]:
    """A tree as it stands in a `.bt` file after its header, and in a binary `octomap_msgs/Octomap`.

    Args:
        leaves: As `OcTreeBuilder.leaves` gives them.
    Returns:
        The bytes, and the number of nodes, inner ones and leaves.
    """
    codes = _interleave(leaves.keys)
    below_codes, below_value = np.zeros(0, np.int64), np.zeros(0, np.int64)  # nodes of the level below
    inner: list[tuple[Int64, Int64]] = []  # (place in depth-first order, two bytes) of each level's
    for depth in range(DEPTH, 0, -1):
        here = leaves.depth == depth
        nodes = np.concatenate([codes[here] >> 3 * (DEPTH - depth), below_codes])
        value = np.concatenate([np.where(leaves.occupied[here], _OCCUPIED, _FREE), below_value])
        parents, of = np.unique(nodes >> 3, return_inverse=True)
        bits = np.bincount(of, weights=value << 2 * (nodes & 7), minlength=len(parents)).astype(np.int64)
        # a parent's place is that of its first descendant; of those that share it the highest comes first
        inner.append(((parents << 3 * (DEPTH - depth + 1) << 5) | (depth - 1), bits))
        below_codes, below_value = parents, np.full(len(parents), _INNER)
    place, bits = (np.concatenate(column) for column in zip(*inner, strict=True))
    return bits[np.argsort(place)].astype("<u2").tobytes(), len(leaves.depth) + len(place)


def write_bt(path: str | os.PathLike[str], leaves: Leaves, resolution: float) -> int:
    """Write a `.bt` file, whole or not at all.

    Args:
        leaves: As `OcTreeBuilder.leaves` gives them.
        resolution: m, edge of a voxel of the finest level.
    Returns:
        Nodes of the tree, inner ones and leaves.
    """
    tree, n_nodes = tree_bytes(leaves)
    header = (
        f"{_MAGIC.decode()}\n# (feel free to add / change comments, but leave the first line as it is!)\n#\n"
        f"id OcTree\nsize {n_nodes}\nres {resolution:.12g}\ndata\n"
    )
    with whole(path) as file:
        file.write(header.encode() + tree)
    return n_nodes


def read_bt(path: str | os.PathLike[str]) -> tuple[Leaves, float]:
    """The leaves of a `.bt` file, depth first, and its resolution, m.

    Raises:
        UsageError: not such a file, or a damaged one.
    """
    content = Path(path).read_bytes()
    head, found, data = content.partition(b"\ndata\n")
    lines = head.split(b"\n")
    if lines[0] != _MAGIC or not found:
        raise UsageError(f"{path}: not a binary OctoMap: it does not begin with {_MAGIC.decode()!r}")
    fields = dict(line.split(None, 1) for line in lines if line.strip() and not line.startswith(b"#"))
    try:
        kind, n_nodes, resolution = fields[b"id"].strip(), int(fields[b"size"]), float(fields[b"res"])
    except (KeyError, ValueError) as error:
        raise UsageError(f"{path}: a damaged header ({error})") from error
    if kind != b"OcTree" or len(data) % 2:
        raise UsageError(
            f"{path}: an OctoMap of kind {kind.decode()!r} and {len(data)} bytes; need OcTree, an even number"
        )
    words = np.frombuffer(data, "<u2").tolist()
    codes: list[int] = []
    depths: list[int] = []
    states: list[bool] = []
    waiting = [(0, 0)] if words else []
    for word in words:
        if not waiting:
            raise UsageError(f"{path}: bytes after the last node")
        code, depth = waiting.pop()
        children = []
        for child in range(8):
            value = (word >> 2 * child) & 3
            if value == _INNER:
                children.append((code << 3 | child, depth + 1))
            elif value:
                codes.append((code << 3 | child) << 3 * (DEPTH - depth - 1))
                depths.append(depth + 1)
                states.append(value == _OCCUPIED)
        if children and depth + 1 >= DEPTH:
            raise UsageError(f"{path}: a tree of more than {DEPTH} levels")
        waiting += children[::-1]
    if waiting or n_nodes != len(words) + len(codes):
        raise UsageError(
            f"{path}: truncated, or damaged: {len(words) + len(codes)} nodes read, its header says {n_nodes}"
        )
    numbers = np.asarray(codes, np.int64)
    order = np.argsort(numbers)
    leaves = Leaves(
        _spread_out(numbers[order]),
        np.asarray(depths, np.int64)[order],
        np.asarray(states, np.bool_)[order],
    )
    return leaves, resolution


def _pruned(codes: Int64, depth: Int64, occupied: Bool) -> tuple[Int64, Int64, Bool]:
    """Eight leaves of one parent and one state become that parent, from the finest level up; the root keeps its children."""
    kept: list[tuple[Int64, Int64, Bool]] = []
    merged_codes, merged_state = np.zeros(0, np.int64), np.zeros(0, np.bool_)
    for level in range(DEPTH, 0, -1):
        here = depth == level
        at = np.concatenate([codes[here], merged_codes])
        state = np.concatenate([occupied[here], merged_state])
        parents, of = np.unique(at >> 3 * (DEPTH - level + 1), return_inverse=True)
        n, n_occupied = np.bincount(of), np.bincount(of, weights=state)
        whole = (n == 8) & ((n_occupied == 0) | (n_occupied == 8)) & (level > 1)
        left = ~whole[of]
        kept.append((at[left], np.full(int(left.sum()), level), state[left]))
        merged_codes, merged_state = parents[whole] << 3 * (DEPTH - level + 1), n_occupied[whole] > 0
    leaf_codes, leaf_depth, leaf_state = (np.concatenate(column) for column in zip(*kept, strict=True))
    order = np.argsort(leaf_codes)
    return leaf_codes[order], leaf_depth[order], leaf_state[order]


def _interleave(keys: Int64) -> Int64:
    """(N,) the bits of three 16-bit keys as one number of 48, x lowest: a node's number, child by child from the root."""
    codes = np.zeros(len(keys), np.int64)
    for bit in range(DEPTH):
        for axis in range(3):
            codes |= ((keys[:, axis] >> bit) & 1) << 3 * bit + axis
    return codes


def _spread_out(codes: Int64) -> Int64:
    """(N, 3): the inverse of `_interleave`."""
    keys = np.zeros((len(codes), 3), np.int64)
    for bit in range(DEPTH):
        for axis in range(3):
            keys[:, axis] |= ((codes >> 3 * bit + axis) & 1) << bit
    return keys
