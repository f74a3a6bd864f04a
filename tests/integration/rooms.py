"""Scans of a small room, for tests of clients."""

from __future__ import annotations

from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]


def room(n: int = 600, seed: int = 5) -> Array:
    """(n, 3) float32 m, sensor frame: an oval wall, 6 m away along x and 5 m along y, one metre around the sensor's height."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, n)
    walls = [6 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-1, 1, n)]
    return np.stack(walls, axis=1).astype(np.float32)


def pose(x_m: float = 0.0) -> Array:
    """(4, 4) T_map_sensor at a place on the x axis."""
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def places(n: int, seed: int = 1) -> Array:
    """(n, 3) m, in and around the room."""
    return np.random.default_rng(seed).uniform([-8, -7, -2], [8, 7, 2], (n, 3))
