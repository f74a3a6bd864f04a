"""Compiled sums are the same to the bit wherever their arrays lie, and whether their code was compiled or loaded."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from potserver.domain.types import AnswerRule
from potserver.numerics.abhm import loops
from potserver.numerics.brick_map import BrickMap
from potserver.numerics.coupling import CouplingCosts, Ragged, couple, coupling_costs
from potserver.numerics.feature_blocks import (
    Blocks,
    feature_blocks,
    gradient_and_diagonal,
    normal_product,
    product,
)
from potserver.numerics.gradients import latent_gradients
from potserver.numerics.kernel_index import KernelIndex, build_index, latent_sums
from potserver.numerics.rays import RayOptions, Rays, first_returns
from potserver.numerics.sinkhorn import Workspace, solve_pairs
from potserver.numerics.warm_fit import Prior, warm_fit

OFFSETS = (0, 8, 24, 56)  # bytes from a boundary of 64


def _placed(array: np.ndarray, offset: int) -> np.ndarray:
    """A copy that starts `offset` bytes behind a boundary of 64 bytes."""
    buffer = np.empty(array.nbytes + 128, np.uint8)
    start = -buffer.ctypes.data % 64 + offset
    out = buffer[start : start + array.nbytes].view(array.dtype).reshape(array.shape)
    out[...] = array
    return out


def _all_placed(record, offset: int):
    """The arrays of a NamedTuple, or of a list of arrays, each at its own offset."""
    moved = [
        _placed(value, (offset + 8 * i) % 64) if isinstance(value, np.ndarray) else value
        for i, value in enumerate(record)
    ]
    return type(record)(*moved) if isinstance(record, tuple) else moved


def _same(results: list[tuple[np.ndarray, ...]]) -> None:
    for other in results[1:]:
        for one, again in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(one, again)


def _kernels() -> tuple[KernelIndex, np.ndarray]:
    rng = np.random.default_rng(0)
    hinge, gamma = rng.uniform(0, 10, (500, 3)), rng.uniform(0.2, 4.0, 500)
    weight, variance = rng.normal(0, 3, 500), 10.0 ** rng.uniform(-3, 2, 500)
    return build_index(hinge, gamma, weight, variance, activation_cut=0.0025), rng.uniform(0, 10, (700, 3))


def test_sums_over_kernels() -> None:
    index, points = _kernels()
    placed = [(_all_placed(index, offset), _placed(points, offset)) for offset in OFFSETS]
    _same([(*latent_sums(i, x), *latent_gradients(i, x)) for i, x in placed])


def test_rays() -> None:
    index, points = _kernels()
    directions = np.random.default_rng(1).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rays = Rays(points[:50], directions, np.full(50, 6.0))
    options = RayOptions(
        step_m=0.1, quantiles=np.array([0.1, 0.5]), unknown_rate=0.3, unknown_width_m=None, width_m=None
    )
    rule = AnswerRule(0.05, 100.0, 1.0, 0.5)
    _same(
        [
            first_returns(_all_placed(index, o), BrickMap([]), _all_placed(rays, o), options, rule)
            for o in OFFSETS
        ],
    )


@pytest.mark.parametrize("bytes_a_value", [1, 4])
def test_products_with_features_and_fits(bytes_a_value: int) -> None:
    rng = np.random.default_rng(0)
    points, hinge, gamma = rng.uniform(0, 8, (600, 3)), rng.uniform(0, 8, (200, 3)), np.full(200, 0.6)
    labels, c = rng.random(600) < 0.4, rng.uniform(0.1, 2.0, 600).astype(np.float32)
    w = rng.normal(size=200).astype(np.float32)
    prior = Prior(w, np.full(200, 40.0, np.float32))
    results = []
    for offset in OFFSETS:
        blocks = feature_blocks(
            _placed(points, offset),
            _placed(hinge, offset),
            gamma,
            edge_m=1.0,
            cut=0.02,
            bytes_a_value=bytes_a_value,
        )
        blocks = Blocks(
            blocks.order, [_all_placed(part, offset) for part in blocks.parts], blocks.n_kernels, blocks.unit
        )
        weights, counts = _placed(w, offset), _placed(c, (offset + 8) % 64)
        fit = warm_fit(blocks, labels, counts, _all_placed(prior, offset), weights)
        results.append(
            (
                product(blocks, weights),
                *gradient_and_diagonal(blocks, counts, counts),
                normal_product(blocks, counts, weights),
                fit.weights,
                fit.var,
            )
        )
    _same(results)


@pytest.mark.parametrize(("n", "m"), [(5, 7), (30, 41), (64, 20), (90, 130)])
def test_couplings_whichever_way_their_workspace_lies(n: int, m: int) -> None:
    rng = np.random.default_rng(0)
    x, y = (
        Ragged.of([rng.normal(size=(k, 3)).astype(np.float32)]) for k in (n, m)
    )  # few points: short arrays lie near each other
    sizes = [len(part) for part in Workspace.of(n, m)]
    results = []
    for order in ((0, 1, 2, 3, 4, 5), (5, 4, 3, 2, 1, 0), (4, 5, 0, 3, 2, 1)):
        for gap in (0, 3, 16):
            memory = np.empty(sum(sizes) + 6 * gap, np.float32)
            ends = np.cumsum([sizes[part] + gap for part in order]).tolist()
            parts = {
                part: memory[end - gap - sizes[part] : end - gap]
                for part, end in zip(order, ends, strict=True)
            }
            work, costs = Workspace(*(parts[i] for i in range(6))), CouplingCosts.room(1)
            solve_pairs(
                x.points, x.offsets, y.points, y.offsets, np.zeros((1, 2), np.int64), 0, 1, np.float32(0.01), True,
                np.float32(1e-5), 500, work, costs, np.empty(1, np.float32),
            )  # fmt: skip
            results.append((*costs, *(part.copy() for part in work)))
    _same(results)
    assert results[0][3].all()


@pytest.mark.parametrize("n", [7, 20, 61, 200])
def test_the_learners_latent_whichever_way_its_arrays_lie(n: int) -> None:
    kernels = np.random.default_rng(0).normal(size=(5, n)).astype(np.float32)
    results = []
    for order in itertools.islice(itertools.permutations(range(7)), 0, None, 200):
        for gap in (0, 5):
            memory = np.zeros((7, n + gap), np.float32)
            parts = {part: memory[row, :n] for row, part in enumerate(order)}
            for part, values in enumerate(kernels):
                parts[part][:] = np.abs(values) if part == 3 else values  # the gammas are positive
            at = (np.float32(0.1), np.float32(-0.2), np.float32(0.3))
            results.append((np.asarray(loops.latent(*at, *(parts[i] for i in range(7)))), parts[5].copy()))
    _same(results)


_PROBE = """
import hashlib, sys
from tests.numerics import test_same_bits as here
for name in sys.argv[1].split():
    getattr(here, name)()
"""


def print_sums() -> None:
    """The bits of sums over kernels."""
    index, points = _kernels()
    _print("sums", [*latent_sums(index, points), *latent_gradients(index, points)])


def print_coupling() -> None:
    """The bits of one coupling."""
    rng = np.random.default_rng(0)
    solved = couple(*(rng.normal(size=(70, 3)).astype(np.float32) for _ in range(2)), reg=0.01)
    _print("coupling", [solved.plan, solved.source_potential])


def print_costs() -> None:
    """The bits of some coupling costs."""
    rng = np.random.default_rng(0)
    sets = Ragged.of([rng.normal(size=(k, 3)).astype(np.float32) for k in (20, 40, 70)])
    pairs = np.array([[0, 1], [1, 2], [2, 2]])
    _print("costs", list(coupling_costs(sets, sets, pairs, reg=0.05)))


def _print(name: str, arrays: list[np.ndarray]) -> None:
    print(name, b"".join(np.ascontiguousarray(a).tobytes() for a in arrays).hex())


@pytest.mark.slow
def test_code_that_was_just_compiled_and_code_from_the_cache_agree(tmp_path: Path, root: Path) -> None:
    """Whichever function is compiled first."""
    outputs = []
    for order in ("print_sums print_coupling print_costs", "print_costs print_coupling print_sums"):
        cache = tmp_path / order.split()[0]
        for _ in range(2):
            done = subprocess.run(
                [sys.executable, "-c", _PROBE, order], cwd=root, check=True, capture_output=True, text=True,
                env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
            )  # fmt: skip
            outputs.append(sorted(done.stdout.splitlines()))
    assert len(outputs[0]) == 3
    for other in outputs[1:]:
        assert other == outputs[0]
