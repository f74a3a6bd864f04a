"""MapSize: what a map takes, and how much of it each robot has caused."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

from potserver.domain.map_state import MapState
from potserver.domain.tiles import Tile, TileIndex


class _Counted(NamedTuple):
    revision: int
    n_bytes: int
    shares: dict[int, int]  # bytes by the number of the robot


class MapSize:
    """The bytes of a map that changes tile by tile: only tiles that are not those of before are counted anew."""

    def __init__(self) -> None:
        self._epoch: int | None = None
        self._counted: dict[TileIndex, _Counted] = {}
        self._robots: tuple[str, ...] = ()
        self._n_bytes = 0
        self._of_robot: Counter[int] = Counter()

    def of(self, state: MapState) -> int:
        """About how many bytes it takes in memory and on pages. Tiles of one epoch and revision are the same."""
        tiles = {} if state.tiled is None else state.tiled.tiles
        for index in list(self._counted):
            if self._epoch != state.epoch or index not in tiles:
                self._remove(index)
        for index, tile in tiles.items():
            known = self._counted.get(index)
            if known is None or known.revision != tile.revision:
                self._remove(index)
                self._add(index, tile)
        self._epoch, self._robots = state.epoch, () if state.tiled is None else state.tiled.robots
        return self._n_bytes

    def of_robot(self, robot_id: str) -> int:
        """How many of these a robot has caused: of each tile as large a share as of its rows."""
        return self._of_robot[self._robots.index(robot_id)] if robot_id in self._robots else 0

    def _add(self, index: TileIndex, tile: Tile) -> None:
        n_rows = np.bincount(tile.rows.source)
        shares = {
            int(robot): int(n_rows[robot]) * tile.n_bytes // len(tile.rows.source)
            for robot in np.flatnonzero(n_rows)
        }
        self._counted[index] = _Counted(tile.revision, tile.n_bytes, shares)
        self._n_bytes += tile.n_bytes
        self._of_robot.update(shares)

    def _remove(self, index: TileIndex) -> None:
        known = self._counted.pop(index, None)
        if known is not None:
            self._n_bytes -= known.n_bytes
            self._of_robot.subtract(known.shares)
