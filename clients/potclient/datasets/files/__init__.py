"""Files of points, a reader a kind; `read_beams` finds the one that a file's name asks for."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from potclient.datasets.files.arrays import read_npy, read_npz
from potclient.datasets.files.beams import Beams
from potclient.datasets.files.binary import AUTO_LAYOUT, LAYOUTS, read_binary
from potclient.datasets.files.feather import read_feather
from potclient.datasets.files.las import read_las
from potclient.datasets.files.pcd import read_pcd, read_viewpoint
from potclient.datasets.files.ply import read_ply
from potclient.errors import DatasetError

__all__ = ["AUTO_LAYOUT", "ENDINGS", "LAYOUTS", "Beams", "kind_of", "read_beams", "read_viewpoint"]

_BINARY = "binary"
# Ending -> kind; the longer ones first. Files of one kind may lie in one folder.
ENDINGS = {
    ".pcd.bin": "nuScenes",
    ".bin.gz": _BINARY,
    ".bin": _BINARY,
    ".pcd": "PCD",
    ".ply": "PLY",
    ".npy": "npy",
    ".npz": "npz",
    ".las": "LAS",
    ".laz": "LAS",
    ".feather": "feather",
}
_READERS: dict[str, Callable[[Path], Beams]] = {
    "PCD": read_pcd,
    "PLY": read_ply,
    "npy": read_npy,
    "npz": read_npz,
    "LAS": read_las,
    "feather": read_feather,
}


def kind_of(path: Path) -> str | None:
    """The kind of cloud that a file's name promises; None for any other file."""
    name = path.name.lower()
    return next((kind for ending, kind in ENDINGS.items() if name.endswith(ending)), None)


def read_beams(path: Path, layout: str = AUTO_LAYOUT) -> Beams:
    """The points of a file, NaN where the file says so, and which of them are echoes.

    Args:
        path: Its ending is one of `ENDINGS`.
        layout: Of binary files, see `read_binary`.
    Raises:
        DatasetError: not such a file, truncated, or without x y z.
    """
    kind = kind_of(path)
    if kind is None:
        raise DatasetError(f"{path}: no cloud; its name must end in {', '.join(ENDINGS)}")
    read = _READERS.get(kind)
    return read_binary(path, layout) if read is None else read(path)
