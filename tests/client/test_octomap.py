"""Binary OctoMap files: bytes by hand, a real file, another program's reader, and damaged ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.errors import UsageError
from potclient.octomap import DEPTH, KEY_ORIGIN, Leaves, OcTreeBuilder, read_bt, write_bt

Array = np.ndarray[Any, Any]


def built(keys: Any, occupied: Any, batches: int = 1) -> Leaves:
    tree = OcTreeBuilder()
    for part in np.array_split(np.arange(len(keys)), batches):
        tree.add(np.asarray(keys)[part], np.asarray(occupied)[part])
    return tree.leaves()


def voxels_of(leaves: Leaves) -> dict[tuple[int, ...], bool]:
    """Every finest voxel that the leaves cover."""
    found: dict[tuple[int, ...], bool] = {}
    for key, depth, occupied in zip(*(column.tolist() for column in leaves), strict=True):
        edge = 2 ** (DEPTH - depth)
        for i, j, k in np.ndindex(edge, edge, edge):
            voxel = (key[0] + i, key[1] + j, key[2] + k)
            assert voxel not in found, "no leaf lies in another"
            found[voxel] = occupied
    return found


def block(seed: int = 0) -> tuple[Array, Array]:
    """A box with a wall, some noise and some holes, across the origin."""
    rng = np.random.default_rng(seed)
    keys = np.argwhere(np.ones((20, 24, 18))) + KEY_ORIGIN - [10, 5, 9]
    occupied = (keys[:, 0] > KEY_ORIGIN) ^ (rng.random(len(keys)) < 0.01)
    kept = rng.random(len(keys)) < 0.98
    return keys[kept], occupied[kept]


def test_one_voxel_is_a_chain_of_sixteen_nodes(tmp_path: Path) -> None:
    """At (0, 0, 0) and up: child 7 of the root, then child 0 down to the leaf."""
    n = write_bt(tmp_path / "one.bt", built([[KEY_ORIGIN] * 3], [True]), 0.5)
    assert n == DEPTH + 1
    header, _, data = (tmp_path / "one.bt").read_bytes().partition(b"\ndata\n")
    assert header.split(b"\n")[0] == b"# Octomap OcTree binary file"
    assert header.split(b"\n")[3:] == [b"id OcTree", b"size 17", b"res 0.5"]
    inner_last, inner_first, occupied_first = b"\x00\xc0", b"\x03\x00", b"\x02\x00"
    assert data == inner_last + inner_first * 14 + occupied_first


def test_children_take_two_bits_each_x_first(tmp_path: Path) -> None:
    keys = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 1, 1]])
    occupied = [True, False, False, True, False, True]
    write_bt(tmp_path / "eight.bt", built(keys, occupied), 1.0)
    words = np.frombuffer((tmp_path / "eight.bt").read_bytes().partition(b"\ndata\n")[2], "<u2")
    assert (words[:-1] == 0b11).all(), "child 0 all the way down"
    assert words[-1] == 0b10_00_00_01_10_01_01_10
    assert len(words) == DEPTH


@pytest.mark.parametrize("batches", [1, 7])
def test_what_is_written_is_read(tmp_path: Path, batches: int) -> None:
    keys, occupied = block()
    leaves = built(keys, occupied, batches)
    assert len(leaves.depth) < 0.8 * len(keys), "equal siblings are one leaf"
    n = write_bt(tmp_path / "block.bt", leaves, 0.25)
    back, resolution = read_bt(tmp_path / "block.bt")
    assert resolution == 0.25
    assert [p.name for p in tmp_path.iterdir()] == ["block.bt"], "nothing half-written stays behind"
    assert voxels_of(back) == dict(zip(map(tuple, keys.tolist()), occupied.tolist(), strict=True))
    assert n > len(leaves.depth)
    for before, after in zip(leaves, back, strict=True):
        np.testing.assert_array_equal(before, after)


def test_a_whole_octant_is_one_leaf() -> None:
    keys = np.argwhere(np.ones((16, 16, 16))) + KEY_ORIGIN
    leaves = built(keys, np.zeros(len(keys), bool), batches=5)
    assert leaves.depth.tolist() == [12]
    assert leaves.keys.tolist() == [[KEY_ORIGIN] * 3]


def test_an_empty_map_has_no_nodes(tmp_path: Path) -> None:
    assert write_bt(tmp_path / "empty.bt", OcTreeBuilder().leaves(), 0.1) == 0
    leaves, resolution = read_bt(tmp_path / "empty.bt")
    assert len(leaves.depth) == 0
    assert resolution == 0.1


def test_a_real_map_comes_back_byte_by_byte(tmp_path: Path, shared_data: Callable[[str], Path]) -> None:
    real = shared_data("octomap_fr079_bt") / "geb079.bt"
    leaves, resolution = read_bt(real)
    assert resolution == 0.08
    assert 0.2 < leaves.occupied.mean() < 0.5
    assert write_bt(tmp_path / "again.bt", leaves, resolution) == 532_566
    assert (tmp_path / "again.bt").read_bytes() == real.read_bytes()
    tree = OcTreeBuilder()
    finest = leaves.depth == DEPTH
    tree.add(leaves.keys[finest], leaves.occupied[finest])
    np.testing.assert_array_equal(tree.leaves().keys, leaves.keys[finest], "it was pruned already")


def test_octomap_itself_reads_it(tmp_path: Path) -> None:
    octomap = pytest.importorskip("pyoctomap")
    keys, occupied = block()
    n = write_bt(tmp_path / "block.bt", built(keys, occupied), 0.25)
    tree = octomap.OcTree(1.0)
    assert tree.readBinary(str(tmp_path / "block.bt"))
    assert (tree.size(), tree.getResolution()) == (n, 0.25)
    known = {tuple(key): state for key, state in zip(keys.tolist(), occupied.tolist(), strict=True)}
    for voxel in np.argwhere(np.ones((22, 26, 20))) + KEY_ORIGIN - [11, 6, 10]:
        node = tree.search((voxel - KEY_ORIGIN + 0.5) * 0.25)
        state = None if node is None else bool(tree.isNodeOccupied(node))
        assert state == known.get(tuple(voxel.tolist()))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda b: b"", "not a binary OctoMap"),
        (lambda b: b[2:], "not a binary OctoMap"),
        (lambda b: b.replace(b"id OcTree", b"id ColorOcTree"), "ColorOcTree"),
        (lambda b: b.replace(b"size", b"sizes"), "header"),
        (lambda b: b.replace(b"res 0.25", b"res x"), "header"),
        (lambda b: b[:-2], "truncated"),
        (lambda b: b[:-1], "even"),
        (lambda b: b + b"\x00\x00", "after the last node"),
        (lambda b: b.replace(b"size 5", b"size 6"), "its header says"),
        (lambda b: b[: b.index(b"\ndata\n") + 6] + b"\x03\x00" * 17, "16 levels"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, damage: Callable[[bytes], bytes], message: str) -> None:
    path = tmp_path / "block.bt"
    write_bt(path, built(*block()), 0.25)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(UsageError, match=message):
        read_bt(path)


@pytest.mark.parametrize(
    ("keys", "occupied"),
    [([[0, 0]], [True]), ([[0, 0, 0]], [True, False]), ([[-1, 0, 0]], [True]), ([[0, 0, 65536]], [True])],
)
def test_voxels_that_are_none_are_refused(keys: Any, occupied: Any) -> None:
    with pytest.raises(UsageError, match="voxels"):
        OcTreeBuilder().add(keys, occupied)
