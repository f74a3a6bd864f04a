"""What the learner of ABHMs optimises: priors, the likelihood of labelled points in cubes, and its gradients."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from potschemas.answers import sigmoid
from potserver.errors import ShapeError
from potserver.numerics.abhm import loops
from potserver.numerics.arrays import Bool, Float32, Float64, Int64
from potserver.numerics.feature_blocks import feature_blocks, gradient_and_diagonal, product
from potserver.numerics.threads import parallel_map
from potserver.numerics.warm_fit import Prior, Solver, WarmFit, warm_fit

FEATURE_CUT = 3e-3  # activations below this are left out of an epoch
_EDGE_IN_LENGTHS = 1.0  # edge of the cubes that share a list of kernels, in length scales
_NEGLIGIBLE = 1e-4  # points with a smaller residual are left out of a gradient; times the smaller of 1 and the mean count
_LEAST_CURVATURE = 1e-5  # of a point, in the solves of the weights
_WHOLE = Solver(n_newton=50, n_conjugate_gradient=200, least_curvature=_LEAST_CURVATURE)
BETWEEN_EPOCHS = Solver(n_newton=2, n_conjugate_gradient=12, least_curvature=_LEAST_CURVATURE)


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class AbhmOptions:
    """How kernels are learned: their priors, and how long and how fast to go.

    Raises (on construction):
        ShapeError: a number is out of its range.
    """

    weight_var: float = 200.0  # log-odds^2, prior variance of a weight: a standard deviation of 14
    hinge_reach: float = 1.0  # prior standard deviation of a hinge about its start, in length scales
    gamma_shape: float = 2.0  # of a gamma's prior, whose mean is the start: it spreads by 70 %
    max_epochs: int = 10  # of the means, at most
    dispersion_epochs: int = 4
    steps: int = 60  # gradient steps an epoch
    batch: int = 2_000  # points a step, about
    learning_rate: float = 0.1  # the first step size, of hinges in length scales and of log gammas
    tolerance: float = 2e-3  # share of the objective that an epoch of the means should gain; negative: any

    def __post_init__(self) -> None:
        for name in ("weight_var", "hinge_reach", "gamma_shape", "learning_rate"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ShapeError(f"{name} must be > 0 and finite, got {getattr(self, name)}")
        for name in ("max_epochs", "dispersion_epochs"):
            if getattr(self, name) < 0:
                raise ShapeError(f"{name} must be >= 0, got {getattr(self, name)}")
        for name in ("steps", "batch"):
            if getattr(self, name) < 1:
                raise ShapeError(f"{name} must be at least 1, got {getattr(self, name)}")


class AbhmStart(NamedTuple):
    """K kernels to start from. They are also the centres of the priors."""

    hinge: Float64  # (K, 3) m, in the frame of the points
    gamma: Float64  # (K,) 1/m^2, > 0


class Weights(NamedTuple):
    """Posterior of the weights, given hinges and gammas."""

    mean: Float32  # (K,) log-odds
    var: Float32  # (K,) log-odds^2, of each given the others
    converged: bool


class KernelPrior:
    """Priors of hinges and gammas. Learning moves shifts and log ratios from the start; as float32 these keep their digits."""

    def __init__(self, start: AbhmStart, free_axes: Float32, options: AbhmOptions) -> None:
        """Priors about a start.

        Args:
            start: The centres.
            free_axes: (3,) 1 for axes along which hinges may move, 0 for the others.
            options: `hinge_reach` and `gamma_shape` are used.
        """
        self.hinge, self.gamma = start
        self.free_axes, self.options = free_axes, options
        self.length = 1.0 / np.sqrt(2.0 * self.gamma)  # (K,) m

    def hinge_at(self, shift: Float32) -> Float64:
        """(K, 3) m: hinges for shifts given in length scales."""
        return self.hinge + self.length[:, None] * self.free_axes * shift

    def gamma_at(self, log_ratio: Float32) -> Float64:
        """(K,) 1/m^2: gammas for logarithms of their ratios to the start."""
        return self.gamma * np.exp(log_ratio.astype(np.float64))

    def penalty(self, shift: Float32, log_ratio: Float32) -> float:
        """Minus the log prior of hinges and gammas, constants left out, nats."""
        reach, shape = self.options.hinge_reach, self.options.gamma_shape
        moved = np.square(shift.astype(np.float64) * self.free_axes).sum() / (2.0 * reach**2)
        ratio = log_ratio.astype(np.float64)
        # the density of log gamma, so that the start is also the mode
        return float(moved + shape * (np.exp(ratio) - ratio - 1.0).sum())


class Problem:
    """The labelled points in cubes, each with the kernels that reach it. `gather` cuts them anew, once an epoch."""

    def __init__(
        self, points: Float64, occupied: Bool, count: Float32, options: AbhmOptions, threads: int
    ) -> None:
        """N points.

        Args:
            points: (N, 3) m.
            occupied: (N,) labels.
            count: (N,) how much each point counts.
            options: `weight_var` and `batch` are used.
            threads: For the products with the features.
        """
        self.points, self.occupied, self.count = points, occupied, count
        self.options, self.threads = options, threads
        self.n = len(points)
        self.n_batches = max(1, round(self.n / options.batch))
        self.corner = points.min(axis=0)  # relative to it float32 has the digits that matter
        self.negligible = np.float32(_NEGLIGIBLE * min(1.0, float(count.mean(dtype=np.float64))))

    def gather(self, hinge: Float64, gamma: Float64) -> None:
        """Find which kernels reach which cubes."""
        edge_m = _EDGE_IN_LENGTHS * float(np.median(1.0 / np.sqrt(2.0 * gamma)))
        relative = self.points - self.corner
        self.blocks = feature_blocks(
            relative, hinge - self.corner, gamma, edge_m=edge_m, cut=FEATURE_CUT, threads=self.threads
        )
        order = self.blocks.order
        self.x = np.ascontiguousarray(relative[order].T, np.float32)
        self.sorted_occupied, self.sorted_count = self.occupied[order], self.count[order]

    def improve(self, weight: Float32, solver: Solver = BETWEEN_EPOCHS) -> WarmFit:
        """Better weights, (K,) log-odds, from where they are, given the features."""
        prior = Prior(np.zeros_like(weight), np.full(len(weight), self.options.weight_var, np.float32))
        return warm_fit(self.blocks, self.occupied, self.count, prior, weight, solver, threads=self.threads)

    def solve(self, weight: Float32) -> Weights:
        """The best weights given the features, and their variances."""
        solved = self.improve(weight, _WHOLE)
        p = sigmoid(product(self.blocks, solved.weights, threads=self.threads))
        _, diagonal = gradient_and_diagonal(
            self.blocks, np.zeros_like(p), self.sorted_count * p * (1.0 - p), threads=self.threads
        )
        var = 1.0 / (diagonal + np.float32(1.0 / self.options.weight_var))
        return Weights(solved.weights, var, solved.converged and solved.n_newton < _WHOLE.n_newton)

    def batches(self, rng: np.random.Generator) -> Iterator[Int64]:
        """Endless passes over the points: of each cube a step sees every `n_batches`-th one, in turn."""
        n_cubes = sum(len(part.cuts) - 1 for part in self.blocks.parts)
        while True:
            first = rng.integers(self.n_batches, size=n_cubes)
            for turn in range(self.n_batches):
                yield (first + turn) % self.n_batches

    def log_likelihood(
        self, hinge: Float32, gamma: Float32, weight: Float32, first: Int64
    ) -> tuple[float, Float32, Float32, Float32]:
        """Sum over the points of a batch times the number of batches, and its gradients; hinges relative to the corner."""
        kernels = np.concatenate([hinge.T, gamma[None], weight[None]])
        starts = np.cumsum([0, *(len(part.cuts) - 1 for part in self.blocks.parts)])
        parts = parallel_map(
            lambda i: loops.gradient(
                self.x, self.sorted_occupied, self.sorted_count, self.blocks.parts[i], kernels,
                first[starts[i] : starts[i + 1]], self.n_batches, self.negligible,
            ),
            range(len(self.blocks.parts)), self.threads,
        )  # fmt: skip
        total = sum(part[0] for part in parts) * self.n_batches
        gradient = np.sum([part[1] for part in parts], axis=0, dtype=np.float32) * np.float32(self.n_batches)
        return total, np.ascontiguousarray(gradient[:3].T), gradient[3], gradient[4]

    def curvatures(self, hinge: Float32, gamma: Float32, weight: Float32) -> tuple[Float32, Float32]:
        """Gauss-Newton curvature of the log-likelihood in hinges (K, 3), 1/m^2, and in log gammas (K,)."""
        columns = np.concatenate([hinge.T, gamma[None], weight[None]])
        total = np.zeros((4, len(gamma)), np.float32)
        for part in self.blocks.parts:
            total += loops.curvatures(self.x, self.sorted_count, part, columns)
        return np.ascontiguousarray(total[:3].T), total[3]

    def objective(self, weight: Float32) -> float:
        """Minus the log posterior of the weights, constants left out, nats."""
        f = product(self.blocks, weight, threads=self.threads)
        loss = np.logaddexp(0.0, f, dtype=np.float64) - self.sorted_occupied * f
        prior = np.square(weight, dtype=np.float64).sum() / (2.0 * self.options.weight_var)
        return float((self.sorted_count * loss).sum() + prior)
