"""How well a map answers, kept up while it grows: scores on beams that it never learns from."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from potschemas.answers import occupancy_mean
from potserver.domain.types import Bool, Float32, Float64
from potserver.numerics import scores

# Shares of the latent variance that may pull means towards 0.5; the best of them on the checked beams is used.
MODERATIONS = (0.0, 0.0125, 0.025, 0.05, 0.1, 0.2, 0.4, 1.0)
_MEMORY = 20_000.0  # points after which older ones count a third
_ENOUGH = 500.0  # points before the choice is left to them


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class RunningScores:
    """Discounted sums over the points that a map was asked before it could have learned them. Never changes."""

    n_points: float = 0.0
    nll: Float64 = dataclasses.field(default_factory=lambda: np.zeros(len(MODERATIONS)))  # (M,) nats, sum
    brier: float = 0.0  # sum
    # (N_BINS, 3) n, sum of p, sum of y
    bins: Float64 = dataclasses.field(default_factory=lambda: np.zeros((scores.N_BINS, 3)))

    def with_points(
        self, latent_mean: Float32, latent_var: Float32, occupied: Bool, moderation: float
    ) -> RunningScores:
        """The scores after N more points.

        Args:
            latent_mean, latent_var: (N,) log-odds and log-odds^2, what the map says; 0 where it does not know.
            occupied: (N,) the truth.
            moderation: With which the map answers now.
        """
        if len(occupied) == 0:
            return self
        keep = math.exp(-len(occupied) / _MEMORY)
        p = occupancy_mean(latent_mean, latent_var, moderation)
        nll = [
            scores.nll_sum(occupancy_mean(latent_mean, latent_var, share), occupied) for share in MODERATIONS
        ]
        return RunningScores(
            n_points=keep * self.n_points + len(occupied),
            nll=keep * self.nll + np.array(nll),
            brier=keep * self.brier + scores.brier_sum(p, occupied),
            bins=keep * self.bins + scores.calibration_bins(p, occupied),
        )

    def moderation(self, default: float) -> float:
        """The share with the least negative log-likelihood; the default until there are points enough to say."""
        return MODERATIONS[int(np.argmin(self.nll))] if self.n_points >= _ENOUGH else default

    def mean_nll(self, moderation: float) -> float:
        """Nats a point, at one of `MODERATIONS` or at the one nearest to it; NaN before the first."""
        nearest = int(np.argmin(np.abs(np.asarray(MODERATIONS) - moderation)))
        return float(self.nll[nearest]) / self.n_points if self.n_points else math.nan

    @property
    def mean_brier(self) -> float:
        """Mean squared error of the probability; NaN before the first point."""
        return self.brier / self.n_points if self.n_points else math.nan

    @property
    def ece(self) -> float:
        """Expected calibration error over 15 bins of equal width; NaN before the first point."""
        return scores.calibration_error(self.bins, self.n_points) if self.n_points else math.nan
