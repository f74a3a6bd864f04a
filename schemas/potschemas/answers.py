"""From sums over kernels to answers: occupancy, its variance, and their gradients. All these formulas stand here, in numpy.

At a point x, with phi_m = exp(-gamma_m |x - h_m|^2), the kernels give three sums (`LatentSums`):

    f = sum_m w_m phi_m        v = sum_m var_m phi_m^2        a = sum_m known_m phi_m

known_m = max(0, 1 - var_m / prior_var) is what is known of a weight: all of it when its variance is small, nothing while it is
the prior's. So a kernel that data have not touched makes no point observed, wherever it reaches.

An `AnswerRule` makes the answer from them. With c = mean_moderation:

    observed = a >= observed_activation
    mu = f                                  latent mean; 0 where unobserved
    s2 = v + residual_var max(0, 1 - a)     latent variance; prior_var where unobserved
    k = 1 / sqrt(1 + c pi s2 / 8)
    mean = sigmoid(k mu)
    var = mean (1 - mean) (1 - 1 / sqrt(1 + pi s2 / 8))

A map that leans (`potschemas.lean`) has a lean g at x, beside kernels that say what the data add to it. What evidence counts
there grows with what is known, e = clip((a - observed_activation) / room, 0, 1). Free space ends where beams end, but kernels
go on: where they call free (f < 0) what is expected to be solid (g > 0), more must be known,

    room = ROOM + (ROOM_IN_SOLID - ROOM) clip(g, 0, 1) where f < 0, else ROOM

    mu = e f + g / k      mean = sigmoid(k mu) = sigmoid(k e f + g)      borrowed = 1 - e

Asked for evidence only, it is e = 1 where observed (mu = f + g / k), and as above elsewhere: unknown. `observed` and s2 go by
evidence whatever the map leans on.

A rule with a `full_activation` is of a map whose kernels stand on lattices, and tells how dense evidence is, d = a /
full_activation. Echoes come from faces: behind them nobody saw whether it is solid, and kernels go on. So what is observed is
only as sure as evidence is dense there. Its log-odds k mu stay between

    min(g, -(SURE + FREE_GAIN max(0, d - FREE_FROM)))    and    SURE + OCCUPIED_GAIN max(0, d - OCCUPIED_FROM)

the lower one only where the map leans. And beams call all of a face occupied, of which by volume half is: `var` is what the
squared error of `mean` is by volume,

    var = min(t (1 - mean)^2 + (1 - t) mean^2, .25)
    t = LEAST + (1 - 2 LEAST) sigmoid(G k mu - B + B_VAR s2 - B_DENSE clip(d - 1, 0, 1))

where t is how often such points are occupied in places whose truth is known; and t = mean where unobserved.

The gradients of a map without a lean are 0 where unobserved, and elsewhere

    grad mu = grad f
    grad s2 = grad v - residual_var grad a, without the second term where a >= 1
    grad mean = mean (1 - mean) (k grad mu - c pi / 16 k^3 mu grad s2)

Those of a map with one, and where log-odds end, follow from the same formulas; see `gradients`.

Sources: mean, the moderated sigmoid of MacKay, "The evidence framework applied to classification networks", Neural Computation
4, 1992; var, Daunizeau, "Semi-analytical approximations to statistical moments of sigmoid and softmax mappings of normal
variables", arXiv:1703.00091, 2017; the residual variance, in the measure of the kernels' own activation, the diagonal
correction of Snelson and Ghahramani, "Sparse Gaussian processes using pseudo-inputs", NIPS 18, 2006.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from potschemas.lean import LeanAt

Bool = NDArray[np.bool_]
Float = NDArray[np.floating]
Float64 = NDArray[np.float64]
_Real = TypeVar("_Real", bound=np.floating)

# A point whose known kernels sum to less activation than this is unobserved: nothing near it was ever seen.
OBSERVED_ACTIVATION = 0.05
# Variance of the latent where nothing is known, log-odds^2: a standard deviation of 10, anything from sure to sure.
PRIOR_VAR = 100.0
# By how much the known activation must be above what makes a point observed, for its evidence to count in full. A full lattice
# sums to 3.4.
ROOM, ROOM_IN_SOLID = 1.0, 2.0
# Log-odds at which what is observed ends where evidence is sparse; the density from which on they may be more, and by how much.
SURE = 2.15
OCCUPIED_FROM, OCCUPIED_GAIN = 0.66, 7.0
FREE_FROM, FREE_GAIN = 0.5, 27.0
# How often what is observed is occupied, by its log-odds, the latent variance and the density: fitted by benchmarks/errors.py.
LEAST, G, B, B_VAR, B_DENSE = 5e-5, 0.86, 3.1, 0.017, 2.5

_MOST_VAR = 0.25  # of a probability: one half that is true as often as not
_NEVER = 60.0  # log-odds: beyond them exponentials overflow in float32


@dataclasses.dataclass(frozen=True, slots=True)
class AnswerRule:
    """What turns sums over kernels into answers. It travels with every set of kernels, so that all who have them agree.

    The defaults of `residual_var` and `mean_moderation` are the paper's model.

    Raises:
        ValueError: a number is negative or not finite, or the prior variance 0.
    """

    observed_activation: float = OBSERVED_ACTIVATION  # a point with less summed activation is unobserved
    prior_var: float = (
        PRIOR_VAR  # log-odds^2, latent variance of unobserved points and of weights that no data touched
    )
    # log-odds^2, what the kernels cannot know: added in the measure that the activation falls short of 1, so that certainty
    # fades with the kernels; at 0 answers grow surer with the distance from all data
    residual_var: float = 0.0
    # share of the latent variance that pulls the mean towards 0.5; variances are of single weights and ignore what neighbours
    # have in common, so that 1 makes a map timid
    mean_moderation: float = 1.0
    # what a full lattice of known kernels sums to, for maps whose answers end and err as those do; 0: for others
    full_activation: float = 0.0

    def __post_init__(self) -> None:
        for name, value in self.fields().items():
            if not 0.0 <= value < math.inf:
                raise ValueError(f"{name}: {value}, need a finite number from 0")
            if name == "prior_var" and value == 0.0:
                raise ValueError("prior_var: 0, need a positive number")
            object.__setattr__(
                self, name, float(value)
            )  # numpy's own scalars would decide the answers' dtype

    @classmethod
    def of(cls, source: Any) -> AnswerRule:
        """The rule that a message or a record of settings carries, in attributes of these names.

        Raises:
            ValueError: a number is negative or not finite.
        """
        return cls(*(getattr(source, name) for name in RULE_FIELDS))

    def fields(self) -> dict[str, float]:
        """The numbers by their names, as messages take them."""
        return {name: getattr(self, name) for name in RULE_FIELDS}


RULE_FIELDS = tuple(field.name for field in dataclasses.fields(AnswerRule))


class LatentSums(NamedTuple):
    """The sums over all kernels at N points, float32 or float64."""

    mean: Float  # (N,) sum_m w_m phi_m, log-odds
    var: Float  # (N,) sum_m var_m phi_m^2, log-odds^2
    activation: Float  # (N,) sum_m known_m phi_m


class LatentGradients(NamedTuple):
    """The gradients of `LatentSums` at N points, each (N, 3), per metre."""

    mean: Float
    var: Float
    activation: Float


class Answer(NamedTuple):
    """What a rule makes of the sums at N points."""

    mean: Float64  # (N,) P(occupied), in [0, 1]
    var: Float64  # (N,) variance of that probability: the squared error that is expected, in [0, 0.25]
    latent_mean: Float  # (N,) log-odds, dtype of the sums
    latent_var: Float  # (N,) log-odds^2, dtype of the sums
    observed: Bool  # (N,) false: no kernel near; unknown, not free
    borrowed: Float  # (N,) in [0, 1], dtype of the sums: the share of the answer that is the lean's and not the evidence's


class AnswerGradients(NamedTuple):
    """The gradients of an answer at N points; 0 where unobserved."""

    mean: Float64  # (N, 3) 1/m
    latent_mean: Float64  # (N, 3) log-odds/m


def known(weight_var: Float, rule: AnswerRule) -> Float:
    """(K,) what is known of weights with these variances, log-odds^2: from 0, all that the prior leaves open, to 1."""
    share: Float = np.maximum(1.0 - weight_var / rule.prior_var, 0.0)
    return share


def answer(
    sums: LatentSums, rule: AnswerRule, lean: Float | None = None, *, evidence_only: bool = False
) -> Answer:
    """Occupancy at N points. Probabilities are float64: a sure one in float32 rounds to 1, an infinite log-loss if wrong.

    Args:
        sums: Over the kernels.
        rule: Of the map.
        lean: (N,) log-odds, NaN where there is none; None: the map does not lean.
        evidence_only: What is not observed is unknown, whatever the map leans on there.
    """
    observed, latent_var = _observed(sums, rule)
    spread = _spread(latent_var, rule.mean_moderation)
    if lean is None:
        z = np.where(observed, sums.mean, 0.0) / spread
        borrowed = np.zeros_like(sums.mean)
    else:
        share, _, _, own = _weighed(sums, rule, lean, evidence_only=evidence_only)
        z = share * sums.mean / spread + own
        borrowed = np.where(np.isnan(lean) | evidence_only, 0.0, 1.0 - share).astype(sums.mean.dtype)
    if rule.full_activation:
        density = sums.activation * (1.0 / rule.full_activation)
        low, high = _ends(density, observed, lean)
        z = np.minimum(np.maximum(z, low), high)
        mean = sigmoid(z)
        var = np.where(observed, _squared_error(mean, z, latent_var, density), mean * (1.0 - mean))
    else:
        mean = sigmoid(z)
        var = occupancy_var(mean, latent_var)
    return Answer(mean, var, (z * spread).astype(sums.mean.dtype), latent_var, observed, borrowed)


def gradients(
    sums: LatentSums,
    slopes: LatentGradients,
    rule: AnswerRule,
    lean: LeanAt | None = None,
    *,
    evidence_only: bool = False,
) -> AnswerGradients:
    """Gradients of `answer`'s mean and latent mean, from those of the sums and of the lean."""
    observed, latent_var = _observed(sums, rule)
    if lean is None:
        share, own = observed.astype(np.float64), np.zeros(len(observed))
        by_activation = by_lean = own
        own_slope = np.zeros((len(observed), 3))
    else:
        share, by_activation, by_lean, own = _weighed(sums, rule, lean.log_odds, evidence_only=evidence_only)
        own_slope = np.where((observed | (not evidence_only))[:, None], lean.gradient, 0.0)
    # the residual variance has a slope below an activation of 1 only
    residual = np.where(sums.activation < 1.0, rule.residual_var, 0.0)
    var_slope = np.where(observed[:, None], slopes.var - residual[:, None] * slopes.activation, 0.0)
    k = 1.0 / _spread(latent_var, rule.mean_moderation)
    k_slope = (-rule.mean_moderation * math.pi / 16.0 * k**3)[:, None] * var_slope
    share_slope = by_activation[:, None] * slopes.activation + by_lean[:, None] * own_slope
    by_data = share[:, None] * slopes.mean + sums.mean[:, None] * share_slope
    z = k * share * sums.mean + own
    z_slope = k[:, None] * by_data + (share * sums.mean)[:, None] * k_slope + own_slope
    if rule.full_activation:
        density = sums.activation * (1.0 / rule.full_activation)
        low, high = _ends(density, observed, None if lean is None else lean.log_odds)
        by_density = slopes.activation / rule.full_activation
        high_slope = np.where((density > OCCUPIED_FROM)[:, None], OCCUPIED_GAIN * by_density, 0.0)
        low_slope = np.where((density > FREE_FROM)[:, None], -FREE_GAIN * by_density, 0.0)
        if lean is not None:
            low_slope = np.where(np.equal(low, lean.log_odds)[:, None], own_slope, low_slope)
        z_slope = np.where((z < low)[:, None], low_slope, np.where((z > high)[:, None], high_slope, z_slope))
        z = np.minimum(np.maximum(z, low), high)
    mean = sigmoid(z)
    latent_slope = z_slope / k[:, None] - (z / k**2)[:, None] * k_slope
    return AnswerGradients((mean * (1.0 - mean))[:, None] * z_slope, latent_slope.astype(np.float64))


def _observed(sums: LatentSums, rule: AnswerRule) -> tuple[Bool, Float]:
    """What evidence decides alone: (N,) which points are observed, and (N,) the latent variance."""
    observed = sums.activation >= rule.observed_activation
    unexplained = np.maximum(1.0 - sums.activation, 0.0)
    return observed, np.where(observed, sums.var + rule.residual_var * unexplained, rule.prior_var)


def _weighed(
    sums: LatentSums, rule: AnswerRule, lean: Float, *, evidence_only: bool
) -> tuple[Float64, Float64, Float64, Float64]:
    """What evidence counts, (N,) in [0, 1]; its slopes by the activation and by the lean; and (N,) the lean that counts."""
    observed = sums.activation >= rule.observed_activation
    is_whole = np.isnan(lean) | evidence_only  # nothing is borrowed: what is observed counts in full
    own = np.where(np.isnan(lean) | (evidence_only & ~observed), 0.0, lean).astype(np.float64)
    more, frees = ROOM_IN_SOLID - ROOM, sums.mean < 0
    room = ROOM + more * np.where(frees, np.clip(own, 0.0, 1.0), 0.0)
    above = sums.activation.astype(np.float64) - rule.observed_activation
    grown = np.clip(above / room, 0.0, 1.0)
    share = np.where(is_whole, observed.astype(np.float64), grown)
    is_growing = ~is_whole & (grown > 0.0) & (grown < 1.0)
    by_lean = np.where(is_growing & frees & (own > 0.0) & (own < 1.0), -more * grown / room, 0.0)
    return share, np.where(is_growing, 1.0 / room, 0.0), by_lean, own


def _ends(density: Float, observed: Bool, lean: Float | None) -> tuple[Float | float, Float]:
    """Between which log-odds points are answered; (N,) each."""
    high = SURE + OCCUPIED_GAIN * np.maximum(density - OCCUPIED_FROM, 0.0)
    if lean is None:  # what is not observed has log-odds of 0
        return -math.inf, high
    least = -SURE - FREE_GAIN * np.maximum(density - FREE_FROM, 0.0)
    low = np.where(observed & ~np.isnan(lean), np.minimum(lean, least), -np.inf)
    return low, np.where(observed, high, np.inf)


def _squared_error(mean: Float64, z: Float64, latent_var: Float, density: Float) -> Float64:
    """(N,) what is expected by volume of that of a mean, sigmoid(z)."""
    less = B - B_VAR * latent_var + B_DENSE * np.clip(density - 1.0, 0.0, 1.0)
    log_odds = np.maximum(G * z.astype(latent_var.dtype) - less, -_NEVER)
    true = LEAST + (1.0 - 2.0 * LEAST) / (1.0 + np.exp(-log_odds))
    found: Float64 = np.minimum(mean * mean + true * (1.0 - 2.0 * mean), _MOST_VAR)
    return found


def occupancy_mean(latent_mean: Float, latent_var: Float, mean_moderation: float = 1.0) -> Float64:
    """(N,) P(occupied) for a latent of (N,) mean, log-odds, and (N,) variance, log-odds^2."""
    return sigmoid(latent_mean / _spread(latent_var, mean_moderation))


def occupancy_var(mean: Float64, latent_var: Float) -> Float64:
    """(N,) variance of the probability that `occupancy_mean` gave, in [0, 0.25]."""
    return mean * (1.0 - mean) * (1.0 - 1.0 / _spread(latent_var, 1.0))


def sigmoid(x: NDArray[_Real]) -> NDArray[_Real]:
    """1 / (1 + exp(-x)) without overflow, in the dtype of `x`."""
    e = np.exp(-np.abs(x))
    positive: NDArray[_Real] = 1.0 / (1.0 + e)
    return np.where(x >= 0, positive, e * positive)


def _spread(latent_var: Float, moderation: float) -> Float64:
    return np.sqrt(1.0 + (moderation * math.pi / 8.0) * latent_var.astype(np.float64))
