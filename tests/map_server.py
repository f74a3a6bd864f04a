"""What Nav2's map_server makes of a PGM and its YAML: its own rules, written again."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

OCCUPIED, FREE, UNKNOWN = 100, 0, -1


class LoadedMap(NamedTuple):
    data: np.ndarray[Any, np.dtype[np.int8]]  # (height, width), the first row is the lowest y
    resolution: float
    origin: tuple[float, float]

    def at(self, x: float, y: float) -> int:
        column = int((x - self.origin[0]) / self.resolution)
        return int(self.data[int((y - self.origin[1]) / self.resolution), column])


def load_map(path: Path) -> LoadedMap:
    """The occupancy grid of a YAML in trinary mode."""
    meta = yaml.safe_load(path.read_text())
    assert meta["mode"] == "trinary"
    assert len(meta["origin"]) == 3
    magic, size, depth, pixels = (path.parent / meta["image"]).read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    assert (magic, depth, len(pixels)) == (b"P5", b"255", width * height)
    shade = np.frombuffer(pixels, np.uint8).reshape(height, width) / 255.0
    occ = shade if meta["negate"] else 1.0 - shade
    data = np.full((height, width), UNKNOWN, np.int8)
    data[occ < meta["free_thresh"]] = FREE
    data[meta["occupied_thresh"] < occ] = OCCUPIED
    return LoadedMap(data[::-1], meta["resolution"], (meta["origin"][0], meta["origin"][1]))
