"""A learner's problem for tests: labels of a checkerboard, and the same sums in float64."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit

from potserver.numerics.abhm import AbhmOptions, AbhmPosterior, AbhmStart, fit_abhm

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

QUICK = AbhmOptions(max_epochs=4, dispersion_epochs=2, steps=10, batch=150)


class Data(NamedTuple):
    """Labels of a checkerboard, and kernels on a lattice that does not fit it."""

    points: Float64
    occupied: NDArray[np.bool_]
    hinge: Float64
    gamma: Float64
    count: Float32

    def fit(self, options: AbhmOptions = QUICK, **more) -> AbhmPosterior:
        return fit_abhm(self.points, self.occupied, AbhmStart(self.hinge, self.gamma), options, **more)


@functools.cache
def data_of(n: int = 400, seed: int = 0, flat: int | None = 2) -> Data:
    """`flat`: the axis in which all points agree, at 1.7 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3.0, 3.0, (n, 3))
    occupied = rng.random(n) < expit(6.0 * np.sin(points[:, 0] + 0.4) * np.sin(points[:, 1] + 0.3))
    lattice = np.stack(np.meshgrid(*[np.arange(-2.4, 3.0, 1.6)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    hinge = lattice
    if flat is not None:
        points[:, flat] = 1.7
        hinge = lattice[lattice[:, flat] == lattice[0, flat]]
        hinge[:, flat] = 1.7
    count = rng.uniform(0.5, 2.0, n).astype(np.float32)
    return Data(points, occupied, hinge, np.full(len(hinge), 0.4), count)


def exact_log_likelihood(
    data: Data, hinge: torch.Tensor, gamma: torch.Tensor, weight: torch.Tensor, rows=None
):
    """The whole sum in float64, every kernel at every point."""
    pick = slice(None) if rows is None else rows
    points, labels = torch.from_numpy(data.points[pick]), torch.from_numpy(data.occupied[pick]).double()
    d2 = (points[:, None] - hinge).square().sum(dim=2)
    f = torch.exp(-gamma * d2) @ weight
    loss = torch.nn.functional.softplus(f) - labels * f
    return -(torch.from_numpy(data.count[pick]).double() * loss).sum()


def somewhere(data: Data, seed: int = 1) -> tuple[Float64, Float64, Float64]:
    rng = np.random.default_rng(seed)
    k = len(data.hinge)
    return (
        data.hinge + rng.normal(0.0, 0.4, (k, 3)),
        data.gamma * rng.uniform(0.5, 2.0, k),
        rng.normal(0.0, 3.0, k),
    )
