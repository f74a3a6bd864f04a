"""What a scan shows about a place: features by hand, turned scenes, and the net over them."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.beams import Beams
from potserver.numerics.ground import Ground
from potserver.numerics.surroundings import N_FEATURES, Perceptron, Surroundings

FLOOR = Ground(-1.5, 0.0, 0.0, 100)
OWN_BEAM, UP_BEAM, OWN_COLUMN, FARTHER_COLUMN, LINES, BETWEEN = (
    5,
    10,
    30,
    34,
    50,
    61,
)  # where their features begin


def scene(rng: np.random.Generator, n: int = 400) -> Beams:
    ends = rng.uniform(-15, 15, (n, 3)) * [1, 1, 0.1]
    return Beams(ends, rng.random(n) < 0.8)


def random_net(rng: np.random.Generator, widths: tuple[int, int] = (32, 32)) -> Perceptron:
    a, b = widths
    shapes = ((N_FEATURES, a), (a,), (a, b), (b,), (b,), (1,))
    return Perceptron(*(rng.normal(size=shape).astype(np.float32) for shape in shapes))


def test_a_place_knows_the_beam_through_it_and_what_stands_there() -> None:
    post = Beams(np.array([[10.0, 0.1, 0.5]]), np.array([True]))
    view = Surroundings.of(post, FLOOR)
    before, at, behind = view.features(np.array([[8.0, 0.08, 0.4], [10.0, 0.1, 0.5], [13.0, 0.13, 0.65]]))
    to_end = [f[OWN_BEAM + 2] for f in (before, at, behind)]
    assert to_end[0] > 0.6 > 1e-3 > abs(to_end[1])
    assert to_end[2] < -0.7
    assert before[OWN_BEAM + 4] == 1.0  # an echo
    assert (before[UP_BEAM], before[UP_BEAM + 1]) == (1.0, 1.0)  # no beam above
    assert abs(at[OWN_COLUMN + 1]) < 1e-3
    assert at[OWN_COLUMN + 2] == pytest.approx(2.0 / 3.0, abs=1e-3)  # 2 m above the ground, of 1 m
    assert before[FARTHER_COLUMN + 1] == pytest.approx(0.8, abs=0.01)  # 2 m away, of half a metre
    assert behind[FARTHER_COLUMN + 1] == 0.0  # nothing beyond


def test_a_place_knows_on_which_side_of_a_front_it_is() -> None:
    """Fronts 6 m to the left and 4 m to the right of a street that runs along 30 degrees, seen at few places."""
    rng = np.random.default_rng(3)
    along, left = rng.uniform(-20, 20, 60), np.arange(60) < 40
    c, s = np.cos(np.radians(30.0)), np.sin(np.radians(30.0))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    ends = np.column_stack([along, np.where(left, 6.2, -4.2), np.full(60, 0.5)]) @ turn.T
    view = Surroundings.of(Beams(ends, np.ones(60, bool)), FLOOR)
    told = view.features(np.array([[3.0, y, 0.0] for y in (3.0, 6.2, 9.0, -2.0, -8.0)]) @ turn.T)
    nearer, there, to_half = told[:, LINES + 3], told[:, LINES + 4], told[:, LINES + 5]
    np.testing.assert_allclose(nearer, [0.0, 0.5, 1.0, 0.0, 1.0], atol=0.25)
    assert there[1] > 0.6
    np.testing.assert_allclose(there[[0, 2, 3, 4]], 0.0, atol=0.05)
    assert (np.sign(to_half[[0, 2, 3, 4]]) == [-1, 1, -1, 1]).all()
    assert 0.85 > told[0, LINES + 6] > told[4, LINES + 6] > 0.6  # more was hit to the left


def test_a_place_knows_the_line_between_its_neighbours() -> None:
    """A wall 10 m ahead, of which two places were hit."""
    ends = np.array([[10.0, -3.0, 0.5], [10.0, 3.0, 0.5]])
    view = Surroundings.of(Beams(ends, np.ones(2, bool)), FLOOR)
    before, on, behind, beside = view.features(
        np.array([[8.0, 0.1, 0.4], [10.0, 0.1, 0.5], [12.0, 0.1, 0.6], [8.0, 6.0, 0.5]])
    )
    assert before[BETWEEN + 2] > 0.6 > 0.35 > abs(on[BETWEEN + 2])
    assert behind[BETWEEN + 2] < -0.6
    assert before[BETWEEN + 3] > 0.2
    assert beside[BETWEEN + 3] == 0.0  # both on one side of it


def test_turning_the_scene_by_cells_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    beams, places = scene(rng), rng.uniform(-15, 15, (300, 3)) * [1, 1, 0.1]
    angle = np.radians(2.0 * 37)  # of so many cells
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    one = Surroundings.of(beams, FLOOR).features(places)
    other = Surroundings.of(Beams(beams.ends @ turn.T, beams.is_return), FLOOR).features(places @ turn.T)
    np.testing.assert_allclose(one, other, atol=1e-4)


def test_features_are_bounded_wherever_one_asks() -> None:
    rng = np.random.default_rng(6)
    places = rng.normal(size=(2000, 3)) * 10.0 ** rng.uniform(-3, 3, (2000, 1))
    for beams in (scene(rng), Beams(np.zeros((0, 3)), np.zeros(0, bool))):
        features = Surroundings.of(beams, FLOOR).features(np.concatenate([places, np.zeros((1, 3))]))
        assert np.isfinite(features).all()
        assert np.abs(features).max() <= 1.5


@pytest.mark.parametrize("widths", [(32, 32), (5, 3)])
def test_the_net_is_two_layers_of_rectified_sums(widths: tuple[int, int]) -> None:
    rng = np.random.default_rng(7)
    ends = scene(rng, 301).ends
    ends *= 20.0 / np.linalg.norm(ends, axis=1, keepdims=True)
    view, net = Surroundings.of(Beams(ends, rng.random(301) < 0.8), FLOOR), random_net(rng, widths)
    places = rng.uniform(0.1, 1.0, (301, 1)) * ends  # a beam came near
    x = view.features(places).astype(np.float64)
    one = np.maximum(x @ net.first + net.first_bias, 0)
    two = np.maximum(one @ net.second + net.second_bias, 0)
    np.testing.assert_allclose(
        view.expected(places, net), two @ net.last + net.last_bias, rtol=1e-4, atol=1e-3
    )
    assert len(view.expected(places[:0], net)) == 0


def test_nothing_is_called_sure_where_no_beam_came_near() -> None:
    rng = np.random.default_rng(9)
    net = random_net(rng)._replace(last_bias=np.array([900.0], np.float32))  # sure of everything
    wall = Beams(np.column_stack([np.full(400, 8.0), rng.uniform(-4, 4, (400, 2))]), np.ones(400, bool))
    view = Surroundings.of(wall, FLOOR)
    near = np.array([[4.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.8, 0.0, 0.0], [6.0, 4.0, 0.0]])
    unseen = np.array(
        [[10.0, 0.0, 0.0], [20.0, 2.0, 1.0], [-5.0, 0.0, 0.0], [5.0, 0.0, 6.0], [4.0, 6.0, 0.0]]
    )
    assert (view.expected(near, net) > 100.0).all()
    assert (view.expected(unseen, net) == 2.0).all()
    assert (view.expected(unseen, net._replace(last=-net.last, last_bias=-net.last_bias)) == -2.0).all()


def test_a_net_of_other_features_is_not_sound() -> None:
    net = random_net(np.random.default_rng(8))
    assert net.is_sound
    assert not net._replace(first=net.first[1:]).is_sound
    assert not net._replace(last_bias=np.array([np.nan], np.float32)).is_sound
