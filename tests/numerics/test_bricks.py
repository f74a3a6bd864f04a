"""Lattices are read off the kernels; what stands on none is told."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potserver.numerics.brick_map import BrickMap
from potserver.numerics.bricks import ROWS, NodeKernels, Part, bricks_of
from tests.numerics.lattice_maps import TILE_M, WIDE, Kernels, counts, on_lattice, parts_of

SEEDS = st.integers(0, 2**31)


@settings(max_examples=30)
@given(seed=SEEDS, nodes=st.integers(2, 60), k=st.integers(1, 400))
def test_the_lattice_of_the_products_width_is_found_however_few_nodes_it_has(
    seed: int, nodes: int, k: int
) -> None:
    kernels = on_lattice(np.random.default_rng(seed), nodes, k)
    made, n_rest = parts_of(kernels)
    assert n_rest == 0
    assert counts(made) == {(nodes, kernels.gamma[0]): len(kernels.hinge)}


def test_tiles_may_have_lattices_of_their_own() -> None:
    rng = np.random.default_rng(0)
    coarse = on_lattice(rng, 6, 200, lower=(0, 0, 0), upper=(1, 1, 1))
    fine = on_lattice(rng, 15, 200, lower=(1, 0, 0), upper=(2, 1, 1))
    finest = on_lattice(rng, 30, 200, lower=(0, 1, 0), upper=(1, 2, 1))
    made, n_rest = parts_of(Kernels.joined([coarse, fine, finest]))
    assert n_rest == 0
    assert {nodes: n for (nodes, _), n in counts(made).items()} == {
        6: len(coarse.hinge),
        15: len(fine.hinge),
        30: len(finest.hinge),
    }


def test_kernels_beside_their_nodes_are_left_over() -> None:
    rng = np.random.default_rng(0)
    there = on_lattice(rng, 6, 100, lower=(0, 0, 0), upper=(1, 1, 1))
    beside = on_lattice(rng, 6, 100, lower=(1, 0, 0), upper=(2, 1, 1))
    beside = beside._replace(hinge=beside.hinge + np.array([0.0, 1e-3, 0.0]))
    made, n_rest = parts_of(Kernels.joined([there, beside]))
    assert n_rest == len(beside.hinge)
    assert sum(counts(made).values()) == len(there.hinge)


def test_kernels_too_wide_for_a_window_are_left_over() -> None:
    rng = np.random.default_rng(0)
    kernels = on_lattice(rng, 6, 100, lower=(0, 0, 0), upper=(1, 1, 1), fall=0.9 * WIDE)
    assert parts_of(kernels) == ([], len(kernels.hinge))


def test_kernels_narrower_than_the_products_are_on_the_lattice_too() -> None:
    kernels = on_lattice(np.random.default_rng(0), 6, 300, lower=(0, 0, 0), upper=(1, 1, 1), fall=3.0)
    made, n_rest = parts_of(kernels)
    assert n_rest == 0
    assert sum(counts(made).values()) == len(kernels.hinge)


def test_kernels_far_narrower_than_any_lattice_are_left_over() -> None:
    kernels = on_lattice(np.random.default_rng(0), 6, 300, lower=(0, 0, 0), upper=(1, 1, 1), fall=1e9)
    assert parts_of(kernels) == ([], len(kernels.hinge))


def test_kernels_with_nothing_in_common_are_left_over() -> None:
    rng = np.random.default_rng(0)
    kernels = Kernels(rng.uniform(-20, 20, (500, 3)), *rng.uniform(0.5, 9.0, (4, 500)))
    assert parts_of(kernels) == ([], 500)


@pytest.mark.parametrize("height_m", [0.0, 0.3, -1e-9, 5.999999, -17.2])
def test_a_plane_is_a_lattice_at_any_height(height_m: float) -> None:
    kernels = on_lattice(np.random.default_rng(0), 6, 300, height_m=height_m)
    made, n_rest = parts_of(kernels)
    assert n_rest == 0
    for found in made:
        assert found.lattice.plane is not None
        assert found.row_of.any(axis=(1, 2)).all()


def test_planes_of_many_heights_are_few_lattices() -> None:
    rng = np.random.default_rng(0)
    layers = [
        on_lattice(rng, 6, 30, lower=(x, y, 0), upper=(x + 1, y + 1, 1), height_m=rng.uniform(0.1, 5.9))
        for x in range(3)
        for y in range(3)
    ] + [on_lattice(rng, 6, 300, lower=(0, 0, 1), upper=(1, 1, 2), height_m=7.3)]
    kernels = Kernels.joined(layers)
    made, n_rest = parts_of(kernels)
    assert len(made) == 8
    assert (
        n_rest == min(len(layer.hinge) for layer in layers) + sorted(len(layer.hinge) for layer in layers)[1]
    )


def test_kernels_on_one_node_add() -> None:
    once = on_lattice(np.random.default_rng(0), 6, 50)
    made, _ = parts_of(Kernels.joined([once, once]))
    single, _ = parts_of(once)
    for twice, alone in zip(made, single, strict=True):
        np.testing.assert_allclose(twice.rows, 2.0 * alone.rows, rtol=1e-6)


def test_rows_without_nodes_take_no_memory() -> None:
    kernels = on_lattice(np.random.default_rng(0), 6, 1, lower=(1, 1, 1), upper=(2, 2, 2))
    ((found,), _) = parts_of(kernels)
    assert 1 <= len(found.first) <= 8
    assert len(found.rows) == 2 * len(found.first) + 1
    assert found.row_of.shape == (len(found.first), ROWS, ROWS)


def test_no_kernels() -> None:
    none = NodeKernels(np.zeros((0, 3)), np.zeros((0, 3), np.int64), *np.zeros((4, 0), np.float32))
    made, is_rest = bricks_of(none, Part(TILE_M, 3, (0, 0, 0)))
    assert made == []
    assert len(is_rest) == len(BrickMap([])) == 0


def test_addresses_are_not_sent_to_other_processes() -> None:
    with pytest.raises(TypeError, match="addresses"):
        pickle.dumps(BrickMap([]))
