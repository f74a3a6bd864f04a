"""Which parts of a map changed since a layer of it was last computed."""

from __future__ import annotations

import itertools
import threading
from typing import NamedTuple

import numpy as np

from potclient.arrays import Float64
from potclient.questions.tiles import MIRROR_MARGIN_M
from potschemas import messages

TileIndex = tuple[int, ...]


class Box(NamedTuple):
    """A box in the map frame; (2,) or (3,) m each corner."""

    lower: Float64
    upper: Float64

    def joined(self, other: Box) -> Box:
        """The smallest box around both."""
        return Box(np.minimum(self.lower, other.lower), np.maximum(self.upper, other.upper))

    def cut(self, other: Box) -> Box:
        """What both have; its upper corner is not above the lower one where they have nothing."""
        return Box(np.maximum(self.lower, other.lower), np.minimum(self.upper, other.upper))

    @property
    def is_empty(self) -> bool:
        """No room between the corners."""
        return bool((self.upper <= self.lower).any())


class Change(NamedTuple):
    """What changed: `tiles` of this size, or anything (`tiles` is None)."""

    tiles: frozenset[TileIndex] | None
    tile_m: float


class Changes:
    """Collects the ticks of a map; any thread may call.

    At first, after a tick that was missed, and after one that is not the next, anything may have changed.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._revision: int | None = None
        self._tiles: set[TileIndex] | None = None
        self._tile_m = 1.0

    def add(self, tick: messages.Revision) -> None:
        """The map has a new revision."""
        with self._lock:
            follows = self._revision is not None and tick.map_revision == self._revision + 1
            self._revision, self._tile_m = tick.map_revision, tick.tile_size_m
            if not follows:
                self._tiles = None
            elif self._tiles is not None:
                self._tiles.update(tuple(index) for index in tick.changed_tiles)

    def take(self) -> Change | None:
        """What changed since the last call; None if nothing did."""
        with self._lock:
            tiles, self._tiles = self._tiles, set()
            if tiles is None:
                return Change(None, self._tile_m)
            return Change(frozenset(tiles), self._tile_m) if tiles else None

    def give_back(self) -> None:
        """What was taken could not be used: anything may have changed."""
        with self._lock:
            self._tiles = None


def changed_boxes(tiles: frozenset[TileIndex], tile_m: float) -> list[tuple[Box, Box]]:
    """Boxes around groups of tiles that touch each other: without, and with the margin that their kernels reach beyond.

    Args:
        tiles: Indices of two or three numbers.
    """
    boxes = []
    left = set(tiles)
    while left:
        group, front = set(), [left.pop()]
        while front:
            tile = front.pop()
            group.add(tile)
            near = {
                tuple(a + b for a, b in zip(tile, step, strict=True))
                for step in itertools.product((-1, 0, 1), repeat=len(tile))
            }
            front += near & left
            left -= near
        corners = np.array(sorted(group), np.float64)
        inner = Box(corners.min(axis=0) * tile_m, (corners.max(axis=0) + 1) * tile_m)
        boxes.append((inner, Box(inner.lower - MIRROR_MARGIN_M, inner.upper + MIRROR_MARGIN_M)))
    return boxes
