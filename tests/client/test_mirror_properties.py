"""Whatever a map's kernels are, a mirror ends up with the same numbers, however it got there."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

from potclient.errors import PotclientError
from potclient.mirror import MapMirror
from potschemas.messages import DType, Packed, TilesPart
from potschemas.wire import WireError, pack_array, unpack_array
from potserver.asking.tile_codes import TileMemory
from potserver.domain.types import KernelSet
from tests.tiled_maps import GRID, asking, free_kernels, lattice_kernels, tiled_state

_ELEMENTS = tuple(DType)
STEP = 0.0625
INDICES = st.tuples(*[st.integers(-2, 2)] * 3)
SPACINGS = st.sampled_from([GRID.fine_m, GRID.coarse_m, 0.37])


@st.composite
def kernel_sets(draw: st.DrawFn) -> KernelSet:
    """Some kernels on lattices of the map, some on others, some on none, in any order."""
    seed = draw(st.integers(0, 2**31))
    sets = [free_kernels(draw(st.integers(0, 12)), seed)]
    for number in range(draw(st.integers(0, 3))):
        planar = draw(st.booleans())
        sets.append(lattice_kernels(draw(st.integers(1, 40)), seed + number, draw(SPACINGS), planar=planar))
    kernels = KernelSet.concatenate(sets)
    return kernels.take(np.random.default_rng(seed).permutation(len(kernels)))


@settings(max_examples=60, deadline=None)
@given(
    maps=st.lists(st.dictionaries(INDICES, kernel_sets(), max_size=4), min_size=1, max_size=4),
    part_kernels=st.sampled_from([1, 5, 64, 20_000]),
    clears=st.lists(st.booleans(), min_size=4, max_size=4),
    memory=st.sampled_from([0, 60, 1_000_000]),
    data=st.data(),
)
def test_a_mirror_has_the_numbers_of_the_map(
    maps: list[dict[tuple[int, int, int], KernelSet]],
    part_kernels: int,
    clears: list[bool],
    memory: int,
    data: st.DataObject,
) -> None:
    state, epoch = tiled_state({}, epoch=0, revision=0), 0
    mirror = MapMirror(asking(lambda: state, part_kernels=part_kernels))
    answer = asking(lambda: state, part_kernels=part_kernels, memory=TileMemory(memory))
    rounded = MapMirror(answer, step=STEP)
    tiles: dict[tuple[int, int, int], tuple[KernelSet, int]] = {}
    for revision, (changed, is_cleared) in enumerate(zip(maps, clears, strict=False), 1):
        if is_cleared:
            tiles, epoch = {}, epoch + 1
        for index in data.draw(st.sets(st.sampled_from(sorted(tiles)))) if tiles else ():
            del tiles[index]
        tiles |= {index: (kernels, revision) for index, kernels in changed.items()}
        state = tiled_state(tiles, epoch=epoch, revision=revision)
        mirror.update()
        assert_same(mirror, tiles)
        if data.draw(st.booleans()):  # some look away for a while
            rounded.update()
            assert_rounded(rounded, tiles)


def assert_same(mirror: MapMirror, tiles: dict[tuple[int, int, int], tuple[KernelSet, int]]) -> None:
    """The same kernels bit by bit, in any order of the tiles."""
    moved = [
        kernels.replace(hinge_mean=kernels.hinge_mean.astype(np.float32).astype(np.float64)).moved(
            np.array(index) * GRID.size_m
        )
        for index, (kernels, _) in tiles.items()
    ]
    arrived, expected = mirror.kernels, KernelSet.concatenate(moved)
    assert rows_of(arrived) == rows_of(expected)


def assert_rounded(mirror: MapMirror, tiles: dict[tuple[int, int, int], tuple[KernelSet, int]]) -> None:
    """The same kernels, their weights off by half a step at most, whatever was held before."""
    expected = KernelSet.concatenate(
        [
            kernels.replace(hinge_mean=kernels.hinge_mean.astype(np.float32).astype(np.float64)).moved(
                np.array(index) * GRID.size_m
            )
            for index, (kernels, _) in tiles.items()
        ]
    )
    arrived = mirror.kernels
    assert len(arrived) == len(expected)
    if not len(expected):
        return
    shapes = ("hinge_mean", "hinge_var", "gamma_shape", "gamma_rate")
    mine, theirs = (np.column_stack([getattr(k, name) for name in shapes]) for k in (arrived, expected))
    # by place and shape; of those that share both, by weight
    a, b = (np.lexsort([k.weight_mean, *rows.T]) for k, rows in ((arrived, mine), (expected, theirs)))
    np.testing.assert_array_equal(mine[a], theirs[b])
    np.testing.assert_allclose(arrived.weight_mean[a], expected.weight_mean[b], atol=0.501 * STEP)
    apart = np.abs(np.log(arrived.weight_var[a] / expected.weight_var[b]))
    assert np.median(apart) <= 1.51 * STEP


def rows_of(kernels: object) -> list[bytes]:
    names = ("hinge_mean", "hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var")
    columns = [np.asarray(getattr(kernels, name)) for name in names]
    return sorted(b"".join(column[i].tobytes() for column in columns) for i in range(len(columns[0])))


@given(
    array=npst.arrays(
        st.sampled_from([np.dtype(d.value) for d in DType]),
        npst.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5),
    )
)
def test_every_packed_array_comes_back_as_it_went(array: NDArray[np.generic]) -> None:
    packed = pack_array(array)
    back = unpack_array(packed, "array", dtypes=_ELEMENTS, shape=array.shape, max_elements=array.size)
    assert (back.dtype, back.shape, back.tobytes()) == (array.dtype, array.shape, array.tobytes())
    assert pack_array(back) == packed


@given(
    dtype=st.sampled_from(_ELEMENTS),
    shape=st.lists(st.integers(0, 2**31 - 1) | st.integers(0, 4), max_size=4),
    deflated=st.binary(max_size=64)
    | st.binary(max_size=32).map(lambda b: pack_array(np.frombuffer(b, np.uint8)).deflated),
)
def test_a_packed_array_is_all_its_bytes_or_an_error(dtype: DType, shape: list[int], deflated: bytes) -> None:
    packed = Packed(dtype=dtype, shape=shape, deflated=deflated)
    try:
        array = unpack_array(packed, "array", dtypes=_ELEMENTS, shape=(None,) * len(shape), max_elements=1000)
    except WireError:
        return
    assert array.shape == tuple(shape)
    assert pack_array(array).shape == shape


@given(
    place=st.integers(0, 2**20),
    flip=st.integers(1, 255),
    field=st.sampled_from(["tiles", "counts", "kernels", "changes"]),
)
def test_a_damaged_stream_is_an_error_or_numbers_that_fit(place: int, flip: int, field: str) -> None:
    """A flipped byte of any array: refused with a typed error, or a mirror that can be asked."""
    state = tiled_state({(0, 0, 0): (lattice_kernels(60), 1), (1, 0, 0): (free_kernels(9), 1)})

    def damaged(packed: Packed) -> Packed:
        stream = bytearray(packed.deflated)
        stream[place % len(stream)] ^= flip
        return msgspec.structs.replace(packed, deflated=bytes(stream))

    def spoil(parts: list[TilesPart]) -> Iterable[TilesPart]:
        (part,) = parts
        if field == "kernels":
            names = [n for n in part.kernels.__struct_fields__ if getattr(part.kernels, n) is not None]
            name = names[place % len(names)]
            kernels = msgspec.structs.replace(part.kernels, **{name: damaged(getattr(part.kernels, name))})
            return [msgspec.structs.replace(part, kernels=kernels)]
        if field == "changes":
            lattices = part.changes.lattices
            spoilt = lattices[place % len(lattices)]
            names = [n for n in spoilt.__struct_fields__ if isinstance(getattr(spoilt, n), Packed)]
            name = names[place % len(names)]
            spoilt = msgspec.structs.replace(spoilt, **{name: damaged(getattr(spoilt, name))})
            return [
                msgspec.structs.replace(
                    part, changes=msgspec.structs.replace(part.changes, lattices=[spoilt])
                )
            ]
        return [msgspec.structs.replace(part, **{field: damaged(getattr(part, field))})]

    mirror = MapMirror(asking(lambda: state, spoil=spoil), step=STEP if field == "changes" else None)
    try:
        mirror.update()
    except PotclientError:
        return
    assert np.isfinite(mirror.occupancy(np.zeros((1, 3))).mean).all()
