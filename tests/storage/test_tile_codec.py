"""Tiles as bytes: the same numbers back, whatever they are, and nothing else for damaged ones."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potserver.domain.tiles import MapKernels, Tile, TileGrid
from potserver.domain.types import KernelSet
from potserver.errors import MapFileError
from potserver.numerics.evidence import Rows
from potserver.storage.tile_codec import decode_tile, encode_tile

GRID = TileGrid.of(10.0, 0.25)


def make_tile(n_rows: int, n_kernels: int, seed: int = 0, n_robots: int = 3) -> Tile:
    """A tile of noise: nothing in it compresses, and no two numbers are equal by chance."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(0, 4, n_rows).astype(np.uint8)
    limit = np.where(kind & 1, 2 * GRID.voxels, GRID.voxels)[:, None]
    k = n_kernels
    return Tile(
        Rows(
            voxel=(rng.random((n_rows, 3)) * limit).astype(np.int32),
            kind=kind,
            sums=rng.normal(size=(n_rows, 4)).astype(np.float32),
            source=rng.integers(0, n_robots, n_rows).astype(np.int16),
        ),
        MapKernels(
            kernels=KernelSet(
                hinge_mean=rng.uniform(0, 10, (k, 3)),
                hinge_var=rng.uniform(0, 1, (k, 3)).astype(np.float32),
                gamma_shape=rng.uniform(1, 9, k).astype(np.float32),
                gamma_rate=rng.uniform(1, 9, k).astype(np.float32),
                weight_mean=rng.normal(size=k).astype(np.float32),
                weight_var=rng.uniform(0, 50, k).astype(np.float32),
            ),
            level=rng.integers(0, 3, k).astype(np.int8),
            prior_mean=rng.normal(size=k).astype(np.float32),
            prior_var=rng.uniform(1, 50, k).astype(np.float32),
        ),
        revision=int(rng.integers(0, 2**62)),
        stamp_ns=int(rng.integers(0, 2**62)),
        lean=rng.integers(0, 256, GRID.lean_nodes).astype(np.uint8) if seed % 2 else None,
        news=rng.uniform(0, 9, (2, *[GRID.blocks] * 3)).astype(np.float32) if seed % 3 else None,
    )


def arrays_of(tile: Tile) -> list[np.ndarray[Any, Any]]:
    """Every array of a tile."""
    kernels = tile.kernels
    inner = [getattr(kernels.kernels, f.name) for f in dataclasses.fields(KernelSet)]
    beside = [array for array in (tile.lean, tile.news) if array is not None]
    return [*tile.rows, *inner, kernels.level, kernels.prior_mean, kernels.prior_var, *beside]


def assert_same(a: Tile, b: Tile) -> None:
    """Bit for bit."""
    assert (a.revision, a.stamp_ns) == (b.revision, b.stamp_ns)
    for x, y in zip(arrays_of(a), arrays_of(b), strict=True):
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())


@given(n_rows=st.integers(0, 40), n_kernels=st.integers(0, 30), seed=st.integers(0, 2**31))
def test_a_tile_comes_back_bit_for_bit(n_rows: int, n_kernels: int, seed: int) -> None:
    tile = make_tile(n_rows, n_kernels, seed)
    index, again = decode_tile(encode_tile((-3, 0, 2**31 - 1), tile), GRID, 3)
    assert index == (-3, 0, 2**31 - 1)
    assert (tile.lean is None, tile.news is None) == (again.lean is None, again.news is None)
    assert_same(tile, again)


def test_what_is_alike_takes_next_to_nothing() -> None:
    tile = make_tile(0, 500)
    k = tile.kernels.kernels
    one = np.ones(500, np.float32)
    lattice = np.stack(np.unravel_index(np.arange(500), (10, 10, 5)), axis=1) * 0.25
    alike = MapKernels.new(
        k.replace(
            hinge_mean=lattice, hinge_var=np.ones((500, 3), np.float32), gamma_shape=one, gamma_rate=one
        ).replace(weight_var=one),
        0,
    )
    data = encode_tile((0, 0, 0), tile._replace(kernels=alike))
    plain = sum(a.nbytes for a in arrays_of(tile._replace(kernels=alike)))
    assert len(data) < 0.2 * plain, "little more than the weights, twice: as they are and as prior"


@given(place=st.integers(0, 10**6), bit=st.integers(0, 7))
def test_a_changed_bit_anywhere_is_noticed(place: int, bit: int) -> None:
    data = bytearray(encode_tile((1, 2, 3), make_tile(5, 4)))
    data[place % len(data)] ^= 1 << bit
    with pytest.raises(MapFileError) as refused:
        decode_tile(bytes(data), GRID, 3)
    assert refused.value.reason == "damaged"


@given(n=st.integers(0, 10**6))
def test_a_cut_off_tile_is_noticed(n: int) -> None:
    data = encode_tile((1, 2, 3), make_tile(5, 4))
    with pytest.raises(MapFileError):
        decode_tile(data[: n % len(data)], GRID, 3)


def test_a_lean_that_was_kept_in_fewer_places_is_read() -> None:
    grid = TileGrid.of(10.0, 0.4)
    x, y, z = np.meshgrid(*(np.linspace(0, 1, n) for n in grid.former_lean_nodes), indexing="ij")
    former = np.rint(128 + 60 * x - 40 * y + 20 * z).astype(np.uint8)
    _, tile = decode_tile(encode_tile((0, 0, 0), make_tile(0, 0)._replace(lean=former)), grid, 3)
    x, y, z = np.meshgrid(*(np.linspace(0, 1, n) for n in grid.lean_nodes), indexing="ij")
    np.testing.assert_allclose(tile.lean, 128 + 60 * x - 40 * y + 20 * z, atol=1.01)


def _with(tile: Tile, **rows: Any) -> Tile:
    return tile._replace(rows=tile.rows._replace(**rows))


def test_a_sound_checksum_does_not_make_a_sound_tile() -> None:
    tile = make_tile(4, 3)
    outside = np.full((4, 3), 2 * GRID.voxels, np.int32)
    wrong = [
        _with(tile, voxel=outside),
        _with(tile, voxel=-outside),
        _with(tile, sums=np.full((4, 4), np.nan, np.float32)),
        _with(tile, source=np.full(4, 3, np.int16)),
        _with(tile, kind=np.full(4, 4, np.uint8)),
        tile._replace(lean=np.zeros((2, 2, 2), np.uint8)),
        tile._replace(kernels=dataclasses.replace(tile.kernels, level=np.full(3, 9, np.int8))),
        tile._replace(kernels=dataclasses.replace(tile.kernels, prior_var=np.zeros(3, np.float32))),
    ]
    for each in wrong:
        with pytest.raises(MapFileError):
            decode_tile(encode_tile((0, 0, 0), each), GRID, 3)
    decode_tile(encode_tile((0, 0, 0), tile), GRID, 3)


def test_a_tile_s_arrays_are_its_own() -> None:
    """A view would keep all bytes that the tile was read from."""
    _, tile = decode_tile(encode_tile((0, 0, 0), make_tile(50, 40)), GRID, 3)
    for array in arrays_of(tile):
        base = array
        while isinstance(base.base, np.ndarray):
            base = base.base
        assert base.base is None
        assert base.nbytes == array.nbytes
