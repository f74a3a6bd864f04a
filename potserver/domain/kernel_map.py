"""KernelMap: an immutable set of kernels that answers queries."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from potserver.domain.types import AnswerRule, Float32, Float64, KernelSet, Occupancy
from potserver.errors import BadPointsError, ShapeError
from potserver.numerics import kernel_index
from potserver.numerics.occupancy import predict_occupancy
from potserver.numerics.threads import default_threads

# A point whose kernels sum to less activation than this is unobserved: nothing near it was ever seen.
OBSERVED_ACTIVATION = 0.05
# Variance of the latent where nothing is known, log-odds^2: a standard deviation of 7, anything from sure to sure.
PRIOR_VAR = 50.0


class KernelMap:
    """K kernels and the index that makes asking them fast. Never changes; any number of threads may query it at once."""

    def __init__(
        self,
        kernels: KernelSet,
        *,
        observed_activation: float = OBSERVED_ACTIVATION,
        prior_var: float = PRIOR_VAR,
        residual_var: float = 0.0,
        map_revision: int = 0,
        threads: int | None = None,
    ) -> None:
        """Index the kernels. Answers use the mean of every hinge and every gamma; their dispersions are only kept.

        Args:
            kernels: In the map frame; gamma enters by its mean.
            observed_activation: Points with a smaller activation sum answer 0.5, `prior_var`, and `observed` false.
            prior_var: Latent variance of unobserved points, log-odds^2.
            residual_var: What the kernels cannot know, log-odds^2: it is added to the latent variance in the measure that the
                activation falls short of 1, so that certainty fades with the kernels. 0 is the paper's model, which is *surer*
                the farther it is from all data.
            map_revision: Carried into the answers.
            threads: Threads a query may use; all processors by default.
        """
        self.kernels = kernels
        self.rule = AnswerRule(observed_activation, prior_var, residual_var)
        self.map_revision = map_revision
        self._threads = threads or default_threads()
        self._index = kernel_index.build_index(
            kernels.hinge_mean,
            kernels.gamma,
            kernels.weight_mean,
            kernels.weight_var,
            activation_cut=observed_activation / 20.0,
        )

    @classmethod
    def from_arrays(
        cls,
        hinge_points: ArrayLike,
        gamma: ArrayLike,
        weight_mean: ArrayLike,
        weight_var: ArrayLike,
        *,
        observed_activation: float = OBSERVED_ACTIVATION,
        prior_var: float = PRIOR_VAR,
        residual_var: float = 0.0,
        threads: int | None = None,
    ) -> KernelMap:
        """A map from bare arrays, hinges and gammas without dispersion.

        Args:
            hinge_points: (K, 3) or (K, 2) m.
            gamma: (K,) 1/m^2, > 0.
            weight_mean: (K,) log-odds.
            weight_var: (K,) log-odds^2, >= 0; a variance, not a standard deviation.
            observed_activation, prior_var, residual_var, threads: As in the constructor.
        Raises:
            ShapeError: the arrays disagree on K, or gamma or a variance has an illegal sign, or something is not finite.
        """
        hinge = as_points(hinge_points)
        g, w, v = (np.asarray(a, np.float64).reshape(-1) for a in (gamma, weight_mean, weight_var))
        if not len(hinge) == len(g) == len(w) == len(v):
            raise ShapeError(
                f"{len(hinge)} hinge points, {len(g)} gammas, {len(w)} means, {len(v)} variances: K differs"
            )
        # a Gamma distribution of shape 1 / rel_var; as sharp as float32 tells apart
        shape = np.full(len(g), 1e6)
        with np.errstate(over="ignore", divide="ignore"):
            rate = (shape / g).astype(np.float32)
        kernels = KernelSet(
            hinge_mean=hinge,
            hinge_var=np.zeros((len(hinge), 3), np.float32),
            gamma_shape=shape.astype(np.float32),
            gamma_rate=rate,
            weight_mean=_float32(w),
            weight_var=_float32(v),
        )
        return cls(
            kernels,
            observed_activation=observed_activation,
            prior_var=prior_var,
            residual_var=residual_var,
            threads=threads,
        )

    def __len__(self) -> int:
        return len(self.kernels)

    def occupancy(self, points: ArrayLike) -> Occupancy:
        """Mean and variance of the occupancy probability, and of the latent, anywhere.

        Args:
            points: (N, 3) or (N, 2) m, map frame; float64 keeps the precision of far coordinates.
        Raises:
            ShapeError: not (N, 3) or (N, 2).
            BadPointsError: NaN or infinite coordinates.
        Source: paper eq. 1; the moderated sigmoid of MacKay 1992; the residual variance is the diagonal correction of sparse
            Gaussian processes (Snelson and Ghahramani 2006), in the kernels' own measure.
        """
        sums = self.latent(as_points(points))
        observed = sums.activation >= self.rule.observed_activation
        latent_mean = np.where(observed, sums.mean, np.float32(0))
        unexplained = np.maximum(np.float32(1) - sums.activation, np.float32(0))
        latent_var = np.where(
            observed,
            sums.var + np.float32(self.rule.residual_var) * unexplained,
            np.float32(self.rule.prior_var),
        )
        # float64: in float32 a sure answer would round to exactly 1 and cost an infinite log-loss when wrong
        mean, var = predict_occupancy(latent_mean.astype(np.float64), latent_var.astype(np.float64))
        return Occupancy(
            mean=np.asarray(mean, np.float64),
            var=np.asarray(var, np.float64),
            latent_mean=latent_mean,
            latent_var=latent_var,
            observed=observed,
            map_revision=self.map_revision,
        )

    def latent(self, points: Float64) -> kernel_index.LatentSums:
        """The bare sums of eq. 1 at (N, 3) points, with no rule for unobserved ones."""
        return kernel_index.latent_sums(self._index, points, threads=self._threads, lane="query")


def as_points(points: ArrayLike) -> Float64:
    """(N, 3) float64 from (N, 3) or (N, 2); 2D points get z = 0.

    Raises:
        ShapeError: neither of the two shapes.
        BadPointsError: NaN or infinite coordinates.
    """
    array = np.asarray(points, np.float64)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ShapeError(f"points: {array.shape}, need (N, 3) or (N, 2)")
    if not np.isfinite(array).all():
        raise BadPointsError("points have NaN or infinite coordinates")
    if array.shape[1] == 2:
        array = np.concatenate([array, np.zeros((len(array), 1))], axis=1)
    return np.ascontiguousarray(array)


def _float32(values: Float64) -> Float32:
    with np.errstate(over="ignore"):  # what overflows is refused as infinite
        return values.astype(np.float32)
