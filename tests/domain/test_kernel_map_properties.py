"""What is true of every map of kernels."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from potschemas.answers import OBSERVED_ACTIVATION
from potserver.domain.kernel_map import KernelMap

SEEDS = st.integers(0, 2**31)
CLOSE = 1.5e-4  # of a probability: twice the budget of what may be cut, and float32


class Case:
    """Random kernels and queries among them."""

    def __init__(self, seed: int, k: int, n: int = 40, dims: int = 3) -> None:
        rng = np.random.default_rng(seed)
        self.hinge = rng.uniform(-6, 6, (k, dims))
        self.gamma = np.exp(rng.uniform(np.log(0.02), np.log(8.0), k))
        self.weight = rng.normal(size=k) * 4.0
        self.var = 10.0 ** rng.uniform(-3, 3, k)
        points = rng.uniform(-8, 8, (n, dims))
        activation = np.exp(-self.gamma * np.square(points[:, None] - self.hinge).sum(axis=2)).sum(axis=1)
        # points on the edge of "observed" may fall to either side
        self.points = points[np.abs(activation - OBSERVED_ACTIVATION) > 0.3 * OBSERVED_ACTIVATION]

    def map(self, **changes) -> KernelMap:
        arrays = {
            "hinge_points": self.hinge,
            "gamma": self.gamma,
            "weight_mean": self.weight,
            "weight_var": self.var,
        }
        return KernelMap.from_arrays(**(arrays | changes), threads=2)


@given(seed=SEEDS, k=st.integers(1, 200))
def test_the_order_of_the_kernels_does_not_matter(seed: int, k: int) -> None:
    case = Case(seed, k)
    i = np.random.default_rng(seed).permutation(k)
    shuffled = KernelMap.from_arrays(case.hinge[i], case.gamma[i], case.weight[i], case.var[i])
    one, other = case.map().occupancy(case.points), shuffled.occupancy(case.points)
    np.testing.assert_allclose(one.mean, other.mean, atol=CLOSE)
    np.testing.assert_allclose(one.var, other.var, atol=CLOSE)
    np.testing.assert_array_equal(one.observed, other.observed)


@given(seed=SEEDS, k=st.integers(1, 200), shift=st.tuples(*[st.floats(-5e6, 5e6)] * 3))
def test_moving_map_and_queries_together_changes_nothing(
    seed: int, k: int, shift: tuple[float, float, float]
) -> None:
    case = Case(seed, k)
    one = case.map().occupancy(case.points)
    other = case.map(hinge_points=case.hinge + shift).occupancy(case.points + shift)
    np.testing.assert_allclose(one.mean, other.mean, atol=CLOSE)
    np.testing.assert_array_equal(one.observed, other.observed)


@given(seed=SEEDS, k=st.integers(1, 100), factor=st.floats(1.5, 1e4))
def test_more_variance_pulls_the_mean_towards_one_half(seed: int, k: int, factor: float) -> None:
    case = Case(seed, k)
    sure = case.map().occupancy(case.points)
    unsure = case.map(weight_var=case.var * factor).occupancy(case.points)
    assert (np.abs(unsure.mean - 0.5) <= np.abs(sure.mean - 0.5) + CLOSE).all()
    assert not (unsure.observed & ~sure.observed).any(), "less is known of the weights"


@given(seed=SEEDS, k=st.integers(1, 200), cut=st.integers(0, 40))
def test_neither_the_order_nor_the_split_of_queries_matters(seed: int, k: int, cut: int) -> None:
    case = Case(seed, k)
    kernels = case.map()
    whole = kernels.occupancy(case.points).mean
    i = np.random.default_rng(seed).permutation(len(case.points))
    np.testing.assert_allclose(kernels.occupancy(case.points[i]).mean, whole[i], atol=CLOSE)
    parts = [kernels.occupancy(part).mean for part in (case.points[:cut], case.points[cut:])]
    np.testing.assert_allclose(np.concatenate(parts), whole, atol=CLOSE)


@given(seed=SEEDS, k=st.integers(1, 200))
def test_2d_is_3d_with_z_zero(seed: int, k: int) -> None:
    case = Case(seed, k, dims=2)
    flat = case.map()
    solid = case.map(hinge_points=np.pad(case.hinge, ((0, 0), (0, 1))))
    points = np.pad(case.points, ((0, 0), (0, 1)))
    for field in ("mean", "var", "latent_mean", "latent_var", "observed"):
        np.testing.assert_array_equal(
            getattr(flat.occupancy(case.points), field), getattr(solid.occupancy(points), field)
        )


@settings(max_examples=25)
@given(seed=SEEDS, k=st.integers(0, 60), far=st.floats(1e3, 1e9))
def test_answers_are_probabilities_however_far_the_query(seed: int, k: int, far: float) -> None:
    case = Case(seed, k)
    answer = case.map().occupancy(np.concatenate([case.points, [[far, -far, far], [0.0, 0.0, -far]]]))
    assert ((answer.mean >= 0) & (answer.mean <= 1)).all()
    assert ((answer.var >= 0) & (answer.var <= 0.25)).all()
    assert not answer.observed[-2:].any()
    assert (answer.latent_var >= 0).all()
