"""Binary clouds without a header (`.bin`, `.bin.gz`, `.pcd.bin`): their layout is known from their numbers alone."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import NamedTuple

import numpy as np

from potclient.arrays import Floats
from potclient.datasets.files.beams import Beams
from potclient.datasets.files.parsing import parsing
from potclient.errors import DatasetError

_FARTHEST_M = 10_000.0
_LARGEST_EXTRA = 65_535.0
_NCLT = np.dtype([("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
_NCLT_SCALE_M, _NCLT_OFFSET_M = 0.005, -100.0


class Layout(NamedTuple):
    """How a point is written."""

    n_bytes: int  # of a point
    says: str


# In the order in which they are tried: of two that fit, the one in wider use.
LAYOUTS = {
    "xyzi": Layout(16, "4 float32 (x y z reflectance)"),
    "xyzir": Layout(20, "5 float32 (x y z intensity ring)"),
    "xyz": Layout(12, "3 float32 (x y z)"),
    "nclt": Layout(_NCLT.itemsize, "NCLT (three uint16 of 5 mm, intensity, laser)"),
}
AUTO_LAYOUT = "auto"


def read_binary(path: Path, layout: str = AUTO_LAYOUT) -> Beams:
    """The points of a binary file.

    Args:
        path: Gzipped if its name ends in `.gz`. `*.pcd.bin` are nuScenes' sweeps: layout `xyzir`.
        layout: One of `LAYOUTS`, or "auto": the first that divides the file into points with finite coordinates within 10 km
            and other numbers of 0 to 65535.
    Raises:
        DatasetError: it cannot be read, is not whole points, or fits no layout.
    """
    data = _bytes_of(path)
    if layout == AUTO_LAYOUT and path.name.lower().endswith(".pcd.bin"):
        layout = "xyzir"
    if layout != AUTO_LAYOUT:
        points, _ = _parsed(path, data, layout)
        return Beams(points, np.ones(len(points), np.bool_), f"points of {LAYOUTS[layout].says}")
    for name, (n_bytes, says) in LAYOUTS.items():
        if len(data) % n_bytes == 0:
            points, extra = _parsed(path, data, name)
            near = np.isfinite(points) & (np.abs(points) <= _FARTHEST_M)
            if near.all() and ((extra >= 0) & (extra <= _LARGEST_EXTRA)).all():
                said = f"points taken as {says} (--layout changes that)"
                return Beams(points, np.ones(len(points), np.bool_), said)
    raise DatasetError(
        f"{path}: {len(data)} bytes are a cloud in none of the layouts {', '.join(LAYOUTS)}; name one with --layout"
    )


def _parsed(path: Path, data: bytes, layout: str) -> tuple[Floats, Floats]:
    """(N, 3) m, and what else each point has (N, ...)."""
    n_bytes, says = LAYOUTS[layout]
    if len(data) % n_bytes:
        raise DatasetError(f"{path}: {len(data)} bytes are not whole points of {says}")
    if layout == "nclt":
        records = np.frombuffer(data, _NCLT)
        xyz = records["xyz"].astype(np.float64) * _NCLT_SCALE_M + _NCLT_OFFSET_M
        return xyz.astype(np.float32), records["laser"].astype(np.float32)
    rows = np.frombuffer(data, "<f4").reshape(-1, n_bytes // 4).astype(np.float32)
    return np.ascontiguousarray(rows[:, :3]), rows[:, 3:]


def _bytes_of(path: Path) -> bytes:
    with parsing(path, "gzip file"):
        data = path.read_bytes()
        return gzip.decompress(data) if path.name.lower().endswith(".gz") else data
