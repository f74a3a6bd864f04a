"""From the latent to the answer: the probit-scaled predictive mean and the variance of the occupancy probability."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating]


class Prediction(NamedTuple):
    """Moments of p = sigmoid(f) for f ~ Normal(latent_mean, latent_var)."""

    mean: Float  # (N,) P(occupied), in [0, 1]
    var: Float  # (N,) variance of that probability, in [0, 0.25]


def predict_occupancy(latent_mean: Float, latent_var: Float, mean_moderation: float = 1.0) -> Prediction:
    """Mean and variance of the occupancy probability.

        mean = sigmoid(mu / sqrt(1 + c pi s2 / 8)),   var = mean (1 - mean) (1 - 1 / sqrt(1 + pi s2 / 8))

    Args:
        latent_mean: (N,) log-odds.
        latent_var: (N,) log-odds^2, >= 0.
        mean_moderation: c. With 1, the mean of p for f ~ Normal; less where that variance ignores what errors have in common
            and would pull the mean too far towards 0.5.
    Source: moderated sigmoid, MacKay 1992; its variance in the same scaling, Daunizeau 2017.
    """
    scale = 1.0 / np.sqrt(1.0 + (math.pi / 8.0) * latent_var)
    mean = sigmoid(latent_mean / np.sqrt(1.0 + (mean_moderation * math.pi / 8.0) * latent_var))
    return Prediction(mean, mean * (1.0 - mean) * (1.0 - scale))


def sigmoid(x: Float) -> Float:
    """1 / (1 + exp(-x)) without overflow, in the dtype of `x`."""
    e = np.exp(-np.abs(x))
    positive = 1.0 / (1.0 + e)
    return np.where(x >= 0, positive, e * positive).astype(x.dtype)
