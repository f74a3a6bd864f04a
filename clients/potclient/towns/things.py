"""Cars, people, trees, poles and furniture as convex parts; x ahead, z up from the road, origin under the middle."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from potclient.arrays import Float64
from potclient.towns.solids import BOX, OCTAGON, PRISM, Kind, Part, blob, box, post

# Cabin of each model: where it begins and ends at the belt line, and at the top, in shares of half the length.
_CABINS = {
    "small": (-0.98, 0.52, -0.72, 0.10),
    "saloon": (-0.68, 0.48, -0.38, 0.08),
    "estate": (-0.98, 0.50, -0.84, 0.12),
    "van": (-0.99, 0.78, -0.97, 0.50),
}
_LENGTHS_M = {"small": 3.9, "saloon": 4.6, "estate": 4.7, "van": 5.3}
_WHEEL_M = 0.32  # radius
_rim = OCTAGON * _WHEEL_M / math.cos(math.pi / 8)  # stands on a flat side
_WHEEL: Float64 = np.array([(x, y, _WHEEL_M + z) for y in (0.0, 0.2) for x, z in _rim])  # (16, 3) m


class Mover(NamedTuple):
    """Something that can move: its size on the ground, and its parts."""

    length_m: float
    width_m: float
    parts: list[Part]


def vehicle(rng: np.random.Generator, van_share: float) -> Mover:
    """A car or van of random model and size."""
    share = (1 - van_share) / 3
    model = str(rng.choice(list(_CABINS), p=[share, share, share, van_share]))
    length = _LENGTHS_M[model] * rng.uniform(0.95, 1.05)
    width = (1.95 if model == "van" else 1.78) * rng.uniform(0.96, 1.04)
    height = (2.2 if model == "van" else 1.47) * rng.uniform(0.95, 1.08)
    half, side, belt = length / 2, width / 2, min(0.9, 0.62 * height)
    rear, front, top_rear, top_front = (share * half for share in _CABINS[model])
    parts = [
        _stump((-half, half), side, 0.22, (-half * 0.985, half * 0.95), side * 0.97, belt),
        _stump((rear, front), side * 0.95, belt, (top_rear, top_front), side * 0.78, height),
    ]
    for x in (-0.62 * half, 0.64 * half):
        for y in (-side, side - 0.2):
            parts.append((PRISM, _WHEEL + np.array([x, y, 0.0]), Kind.CAR))
    return Mover(length, width, parts)


def _stump(
    x: tuple[float, float], y: float, z: float, top_x: tuple[float, float], top_y: float, top_z: float
) -> Part:
    lower = [(x[0], -y, z), (x[1], -y, z), (x[1], y, z), (x[0], y, z)]
    upper = [
        (top_x[0], -top_y, top_z),
        (top_x[1], -top_y, top_z),
        (top_x[1], top_y, top_z),
        (top_x[0], top_y, top_z),
    ]
    return BOX, np.array(lower + upper), Kind.CAR


def person(rng: np.random.Generator) -> Mover:
    """Someone in mid-step."""
    tall, stride = rng.uniform(0.92, 1.08), rng.uniform(0.1, 0.28)
    parts = [
        post(stride, 0.1, 0.0, 0.85 * tall, 0.075, Kind.PERSON, top_radius_m=0.1),
        post(-stride, -0.1, 0.0, 0.85 * tall, 0.075, Kind.PERSON, top_radius_m=0.1),
        post(0.0, 0.0, 0.8 * tall, 1.45 * tall, 0.19, Kind.PERSON),
        blob((0.0, 0.0, 1.6 * tall), (0.12, 0.1, 0.15), rng, Kind.PERSON),
    ]
    return Mover(0.8, 0.5, parts)


def tree(rng: np.random.Generator, x_m: float, y_m: float, *, height_m: float, crown_m: float) -> list[Part]:
    """A trunk and a clumpy crown of that radius; conifers and bushes come from other proportions."""
    trunk = rng.uniform(0.10, 0.18) * math.sqrt(height_m / 6)
    base = min(2.4, 0.35 * height_m)
    parts = [post(x_m, y_m, 0.0, base + 0.3 * (height_m - base), trunk, Kind.TREE)]
    middle, tall = (base + height_m) / 2, (height_m - base) / 2
    for _ in range(int(rng.integers(6, 10))):
        turn, out, up = rng.uniform(0, 2 * math.pi), rng.uniform(0.15, 0.55), rng.uniform(-0.6, 0.6)
        size = rng.uniform(0.35, 0.43)
        center = (
            x_m + crown_m * out * math.cos(turn),
            y_m + crown_m * out * math.sin(turn),
            middle + up * tall,
        )
        parts.append(blob(center, (crown_m * size, crown_m * size, 0.4 * tall), rng, Kind.TREE))
    return parts


def conifer(rng: np.random.Generator, x_m: float, y_m: float) -> list[Part]:
    """Three cones on a short trunk."""
    height, wide = rng.uniform(5.0, 9.0), rng.uniform(1.2, 1.9)
    parts = [post(x_m, y_m, 0.0, 1.2, 0.15, Kind.TREE)]
    for k in range(3):
        z = 0.8 + k * 0.28 * height
        parts.append(
            post(
                x_m,
                y_m,
                z,
                min(height, z + 0.45 * height),
                wide * (1 - 0.25 * k),
                Kind.TREE,
                top_radius_m=0.12,
            )
        )
    return parts


def bush(rng: np.random.Generator, x_m: float, y_m: float) -> list[Part]:
    """Two or three low blobs."""
    parts = []
    for _ in range(int(rng.integers(2, 4))):
        size = rng.uniform(0.35, 0.7)
        dx, dy = rng.uniform(-0.4, 0.4, 2)
        parts.append(blob((x_m + dx, y_m + dy, 0.12 + 0.8 * size), (size, size, size), rng, Kind.HEDGE))
    return parts


def lamp(x_m: float, y_m: float, height_m: float) -> list[Part]:
    """A street lamp: post, base and head."""
    return [
        post(x_m, y_m, 0.0, height_m, 0.07, Kind.POLE),
        post(x_m, y_m, 0.0, 1.1, 0.11, Kind.POLE),
        box((x_m - 0.35, y_m - 0.12, height_m), (x_m + 0.35, y_m + 0.12, height_m + 0.15), Kind.POLE),
    ]


def sign(x_m: float, y_m: float, rng: np.random.Generator) -> list[Part]:
    """A traffic sign."""
    z = rng.uniform(2.1, 2.5)
    return [
        post(x_m, y_m, 0.0, z + 0.6, 0.04, Kind.POLE),
        box((x_m - 0.03, y_m - 0.3, z), (x_m + 0.03, y_m + 0.3, z + 0.6), Kind.POLE),
    ]


def signal(x_m: float, y_m: float) -> list[Part]:
    """A traffic light."""
    return [
        post(x_m, y_m, 0.0, 3.4, 0.09, Kind.POLE),
        box((x_m - 0.18, y_m - 0.18, 2.4), (x_m + 0.18, y_m + 0.18, 3.4), Kind.POLE),
    ]


def bench() -> list[Part]:
    """A park bench, along x."""
    return [
        box((-0.8, -0.22, 0.42), (0.8, 0.22, 0.5), Kind.FURNITURE),
        box((-0.8, 0.18, 0.5), (0.8, 0.24, 0.95), Kind.FURNITURE),
        box((-0.7, -0.2, 0.0), (-0.6, 0.2, 0.42), Kind.FURNITURE),
        box((0.6, -0.2, 0.0), (0.7, 0.2, 0.42), Kind.FURNITURE),
    ]


def desk(rng: np.random.Generator) -> list[Part]:
    """A desk along x with its back at y = 0, drawers, two legs and a chair before it."""
    wide, deep = rng.uniform(1.2, 1.7), rng.uniform(0.7, 0.8)
    half = wide / 2
    drawers = rng.choice((-1, 1))
    x = sorted((drawers * half, drawers * (half - 0.42)))
    leg = -drawers * (half - 0.05)
    parts = [
        box((-half, 0.0, 0.7), (half, deep, 0.74), Kind.FURNITURE),
        box((x[0], 0.05, 0.0), (x[1], deep - 0.05, 0.7), Kind.FURNITURE),
        box((-0.25, 0.15, 0.74), (0.25, 0.3, 1.15), Kind.FURNITURE),  # a screen
    ]
    parts += [
        box((leg - 0.03, y - 0.03, 0.0), (leg + 0.03, y + 0.03, 0.7), Kind.FURNITURE)
        for y in (0.05, deep - 0.05)
    ]
    return parts + chair(rng, float(rng.uniform(-0.2, 0.2)), deep + float(rng.uniform(0.1, 0.35)))


def chair(rng: np.random.Generator, x_m: float, y_m: float) -> list[Part]:
    """A chair on a foot with a star base, its back away from the desk."""
    s = 0.22
    return [
        box((x_m - s, y_m - s, 0.42), (x_m + s, y_m + s, 0.5), Kind.FURNITURE),
        box((x_m - s, y_m + s - 0.06, 0.55), (x_m + s, y_m + s, 0.95 + rng.uniform(0, 0.1)), Kind.FURNITURE),
        post(x_m, y_m, 0.0, 0.42, 0.05, Kind.FURNITURE),
        post(x_m, y_m, 0.0, 0.09, 0.27, Kind.FURNITURE),
    ]


def cupboard(rng: np.random.Generator) -> list[Part]:
    """A cupboard or shelf along x with its back at y = 0."""
    wide, high = rng.uniform(0.8, 1.4), rng.choice((0.8, 1.9))
    return [box((-wide / 2, 0.0, 0.0), (wide / 2, 0.42, high), Kind.FURNITURE)]


def street_tree(rng: np.random.Generator, low: float, high: float, thin: float, wide: float) -> list[Part]:
    """A tree of random height, `low` to `high` m, and crown, `thin` to `wide` m in radius."""
    return tree(rng, 0.0, 0.0, height_m=rng.uniform(low, high), crown_m=rng.uniform(thin, wide))
