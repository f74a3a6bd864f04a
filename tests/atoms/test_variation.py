"""Scenes as they might have been elsewhere: one scene for all of its beams."""

from __future__ import annotations

import numpy as np

from potserver.atoms.variation import AS_IT_IS, draw_variation
from potserver.numerics.beams import Beams


def fan(rng: np.random.Generator, n: int = 2000) -> Beams:
    ends = np.column_stack([np.full(n, 20.0), rng.uniform(-8, 8, n), rng.uniform(-2, 2, n)])
    return Beams(ends, rng.random(n) < 0.7)


def test_a_plain_scene_is_as_it_was() -> None:
    rng = np.random.default_rng(1)
    beams, eye = fan(rng), np.array([1.0, 2.0, 0.5])
    seen, seen_from = AS_IT_IS.seen(beams, eye, rng)
    np.testing.assert_allclose(seen.ends, beams.ends)
    np.testing.assert_array_equal(seen.is_return, beams.is_return)
    np.testing.assert_array_equal(seen_from, eye)
    np.testing.assert_array_equal(AS_IT_IS.lifted(beams.ends), beams.ends)


def test_a_plant_stops_some_beams_within_it_and_none_elsewhere() -> None:
    rng = np.random.default_rng(2)
    beams, eye, radius = fan(rng), np.array([0.0, 1.0, 0.0]), 1.5
    center = np.array([10.0, 0.0, 0.0])
    for path, least, most in ((0.01, 1.0, 1.0), (2.0, 0.4, 0.8), (1e6, 0.0, 0.0)):
        scene = AS_IT_IS._replace(centers=center[None], radii=np.array([radius]), free_path=np.array([path]))
        seen, _ = scene.seen(beams, eye, rng)
        along = (beams.ends - eye) / np.linalg.norm(beams.ends - eye, axis=1, keepdims=True)
        off = np.linalg.norm(np.cross(center - eye, along), axis=1)
        met = np.linalg.norm(seen.ends - beams.ends, axis=1) > 1e-6
        assert not met[off > radius].any()
        assert seen.is_return[met].all()
        assert (np.linalg.norm(seen.ends[met] - center, axis=1) < radius + 1e-6).all()
        assert least <= met[off < 0.8 * radius].mean() <= most


def test_a_plant_behind_the_eye_or_beyond_the_end_stops_nothing() -> None:
    rng = np.random.default_rng(3)
    beams = fan(rng)
    scene = AS_IT_IS._replace(
        centers=np.array([[-10.0, 0.0, 0.0], [30.0, 0.0, 0.0]]), radii=np.full(2, 4.0), free_path=np.full(2, 0.01)
    )  # fmt: skip
    np.testing.assert_allclose(scene.seen(beams, np.zeros(3), rng)[0].ends, beams.ends)


def test_a_stretched_scene_keeps_its_rays_straight() -> None:
    rng = np.random.default_rng(4)
    scene, eye = AS_IT_IS._replace(stretch=np.array([1.2, 1.2, 0.8])), np.array([2.0, 0.0, 1.0])
    beams = fan(rng)
    seen, seen_from = scene.seen(beams, eye, rng)
    half, _ = scene.seen(Beams(eye + 0.5 * (beams.ends - eye), beams.is_return), eye, rng)
    np.testing.assert_allclose(half.ends - seen_from, 0.5 * (seen.ends - seen_from))


def test_the_ground_is_drawn_once_and_is_where_it_was_below_the_scan() -> None:
    rng = np.random.default_rng(5)
    scenes = [draw_variation(rng) for _ in range(100)]
    points = rng.uniform(-20, 20, (500, 3))
    heights = []
    for scene in scenes:
        lifted = scene.lifted(points)
        np.testing.assert_array_equal(lifted, scene.lifted(points))
        np.testing.assert_array_equal(lifted[:, :2], points[:, :2])
        np.testing.assert_allclose(scene.lifted(np.array([[0.0, 0.0, -1.7]]))[0, 2], -1.7)
        heights.append((lifted - points)[:, 2].std())
    assert 0.05 < np.median(heights) < 0.5
    assert (np.array(heights) == 0.0).any()  # some are as they were


def test_the_same_numbers_draw_the_same_scene() -> None:
    one, other = (draw_variation(np.random.default_rng(6)) for _ in range(2))
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
