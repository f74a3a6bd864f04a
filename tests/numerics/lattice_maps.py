"""Random kernels on lattices, put into tiles and parts, and eq. 1 over them in float64."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from potserver.numerics.arrays import Float64
from potserver.numerics.brick_map import BrickMap
from potserver.numerics.bricks import LatticeBricks, NodeKernels, Part, bricks_of

TILE_M = 6.0
TILES = 3  # along a part's edge
WIDE = 0.5 / 0.6**2  # gamma spacing^2 of the product's lattices


class Kernels(NamedTuple):
    """K kernels, map frame."""

    hinge: Float64
    gamma: Float64
    weight: Float64
    variance: Float64
    known: Float64

    @staticmethod
    def joined(sets: list[Kernels]) -> Kernels:
        return Kernels(*(np.concatenate(columns) for columns in zip(*sets, strict=True)))

    def sums(self, points: Float64) -> Float64:
        """(3, N) mean, variance and activation."""
        phi = np.exp(-self.gamma * np.square(points[:, None] - self.hinge[None]).sum(axis=2))
        return np.stack([phi @ self.weight, np.square(phi) @ self.variance, phi @ self.known])

    def slopes(self, points: Float64) -> Float64:
        """(3, N, 3) their gradients, per metre."""
        apart = points[:, None] - self.hinge[None]
        phi = np.exp(-self.gamma * np.square(apart).sum(axis=2))
        steep = (-2.0 * self.gamma * phi)[:, :, None] * apart
        return np.stack(
            [
                np.einsum("nkc,k->nc", steep, self.weight),
                2.0 * np.einsum("nkc,nk,k->nc", steep, phi, self.variance),
                np.einsum("nkc,k->nc", steep, self.known),
            ]
        )


def on_lattice(
    rng: np.random.Generator,
    nodes: int,
    k: int,
    *,
    lower: tuple[int, int, int] = (-1, -1, -1),
    upper: tuple[int, int, int] = (4, 4, 2),
    height_m: float | None = None,
    fall: float = WIDE,
) -> Kernels:
    """About k kernels of a lattice with so many nodes along a tile, in tiles lower to upper; in a plane, given a height."""
    low, high = np.array(lower) * nodes, np.array(upper) * nodes
    node = np.unique(rng.integers(low, high, (k, 3)), axis=0)
    hinge = (node + 0.5) * (TILE_M / nodes)
    if height_m is not None:
        hinge[:, 2] = height_m
        hinge = np.unique(hinge, axis=0)
    n = len(hinge)
    gamma = np.float32(fall * (nodes / TILE_M) ** 2)
    columns = rng.normal(0, 3, n), rng.gamma(2.0, 1.0, n), rng.random(n)
    return Kernels(hinge, np.full(n, gamma, np.float64), *np.float32(columns).astype(np.float64))


def parts_of(kernels: Kernels) -> tuple[list[LatticeBricks], int]:
    """The bricks of all parts, and how many kernels are on no lattice."""
    tile = np.floor(kernels.hinge / TILE_M).astype(np.int64)
    part = np.floor_divide(tile, TILES)
    made, n_rest = [], 0
    for number in np.unique(part, axis=0):
        own = (part == number).all(axis=1)
        members = NodeKernels(
            kernels.hinge[own] - tile[own] * TILE_M,
            tile[own] - number * TILES,
            *(np.float32(column[own]) for column in kernels[1:]),
        )
        bricks, is_rest = bricks_of(members, Part(TILE_M, TILES, tuple(number.tolist())))
        made += bricks
        n_rest += int(is_rest.sum())
    return made, n_rest


def bricks_about(kernels: Kernels) -> BrickMap:
    """All of them in bricks."""
    made, n_rest = parts_of(kernels)
    assert n_rest == 0
    return BrickMap(made)


def points_about(rng: np.random.Generator, kernels: Kernels, n: int) -> Float64:
    """(n, 3) near kernels, and as many on the borders of tiles, in them and beside them."""
    near = kernels.hinge[rng.integers(0, len(kernels.hinge), n)]
    near = near + rng.normal(0, 0.5, (n, 3))
    border = near.copy()
    axis = rng.integers(0, 3, n)
    at = np.arange(n)
    border[at, axis] = np.round(border[at, axis] / TILE_M) * TILE_M + rng.choice([0.0, 1e-12, -1e-12], n)
    return np.concatenate([near, border])


def counts(made: list[LatticeBricks]) -> Mapping[tuple[int, float], int]:
    """Kernels by the nodes along a tile and the width."""
    out: dict[tuple[int, float], int] = {}
    for found in made:
        key = found.lattice.nodes // TILES, found.lattice.gamma
        out[key] = out.get(key, 0) + found.n_kernels
    return out
