"""Drives through towns as recordings: `town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED]`."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import overload

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.scans import RecordedScan, Recording
from potclient.errors import DatasetError
from potclient.towns.lidar import SENSORS, Lidar
from potclient.towns.raycast import RayScene, require
from potclient.towns.solids import SolidSet
from potclient.towns.streets import Crossing, stream
from potclient.towns.styles import STYLES
from potclient.towns.town import Town

PERIOD_S = 0.1  # of scans
_KEPT_SCENES = 3


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class TownName:
    """What a path `town:...` says."""

    style: str
    seed: int = 0
    planar: bool = False
    dynamic: bool = False
    sensor: str | None = None
    length_m: float | None = None

    @classmethod
    def parse(cls, text: str) -> TownName:
        """The words after `town:`, in any order but for the style.

        Raises:
            DatasetError: a word that means nothing.
        """
        head, _, rest = text.partition(":")
        words = rest.split(":") if rest else []
        if head != "town" or not words or words[0] not in STYLES:
            raise DatasetError(
                f"{text}: need town:STYLE with a style of {', '.join(STYLES)}; e.g. town:terraces:2d:7"
            )
        name = cls(style=words[0])
        for word in words[1:]:
            length = re.fullmatch(r"(\d+(?:\.\d+)?)m", word)
            if word in ("2d", "3d"):
                name = dataclasses.replace(name, planar=word == "2d")
            elif word in ("dynamic", "static"):
                name = dataclasses.replace(name, dynamic=word == "dynamic")
            elif word in SENSORS:
                name = dataclasses.replace(name, sensor=word, planar=name.planar or SENSORS[word].is_planar)
            elif length:
                name = dataclasses.replace(name, length_m=float(length[1]))
            elif word.isascii() and word.isdigit():
                name = dataclasses.replace(name, seed=int(word))
            else:
                raise DatasetError(
                    f"{text}: {word!r} is none of 2d, 3d, dynamic, static, {', '.join(SENSORS)}, "
                    "a length such as 500m, or a seed; e.g. town:terraces:dynamic:500m:7"
                )
        return name

    def __str__(self) -> str:
        words = ["town", self.style, *["2d"] * self.planar, *["dynamic"] * self.dynamic]
        words += [] if self.sensor is None else [self.sensor]
        words += [] if self.length_m is None else [f"{self.length_m:g}m"]
        return ":".join([*words, str(self.seed)])


class TownRecording(Recording):
    """Scans of a drive through a town at 10 Hz; a slice is such a recording too.

    Scan k is taken at `stamp_ns` = k * 0.1 s of the town's clock, so `town.occupied(points, scan.stamp_ns / 1e9)` is the truth
    of that moment. Every scan has random numbers of its own: the order of reading does not matter.

    Args:
        town: Where to drive.
        lidar: With what; a planar one needs a 2D town.
        indices: Which scans.
        name: For people.
    Raises:
        DatasetError: open3d is missing, or a planar scanner meets a 3D town or the reverse.
    """

    format = "town"

    def __init__(self, town: Town, lidar: Lidar, indices: range, name: str | None = None) -> None:
        require()
        if lidar.is_planar != (town.slice_m is not None):
            raise DatasetError(f"sensor {lidar.name}: a planar scanner is for 2D towns, and only that")
        style = town.style
        super().__init__(Path(name or f"town:{style.name}:{town.seed}"))
        self.town, self.lidar, self.indices = town, lidar, indices
        self._directions = lidar.directions()
        self._scenes: dict[Crossing, RayScene] = {}
        spacing = style.speed_m_s * PERIOD_S * indices.step
        self.notes = (
            f"made-up town: {style.summary}; seed {town.seed}, {'dynamic' if town.dynamic else 'static'}",
            f"{lidar.name} every {spacing:.3g} m at {style.speed_m_s:g} m/s",
        )

    def __len__(self) -> int:
        return len(self.indices)

    @overload
    def __getitem__(self, index: int) -> RecordedScan: ...
    @overload
    def __getitem__(self, index: slice) -> TownRecording: ...
    def __getitem__(self, index: int | slice) -> RecordedScan | TownRecording:
        if isinstance(index, slice):
            return TownRecording(self.town, self.lidar, self.indices[index], str(self.path))
        return super().__getitem__(index)

    def read(self, i: int) -> RecordedScan:
        k = self.indices[i]
        time_s = k * PERIOD_S
        town, lidar = self.town, self.lidar
        pose = town.pose(time_s)
        eye = pose[:3, 3].copy()
        if town.slice_m is not None:
            eye[2] = town.slice_m
        range_m = self._cast(eye, self._directions @ pose[:3, :3].T, time_s)
        rng = stream(town.seed, 9, k)
        is_return = range_m < lidar.max_range_m
        noise = rng.normal(0.0, lidar.noise_m, len(range_m)) if lidar.noise_m else 0.0
        measured = np.where(is_return, np.minimum(range_m + noise, lidar.max_range_m), lidar.max_range_m)
        kept = (range_m >= lidar.min_range_m) & (measured > 0) & (rng.random(len(range_m)) >= lidar.dropout)
        return RecordedScan(
            points=(self._directions[kept] * measured[kept, None]).astype(np.float32),
            is_return=is_return[kept],
            T_map_sensor=pose,
            stamp_ns=round(time_s * 1e9),
            name=f"{self.path}#{k}",
            is_planar=lidar.is_planar,
        )

    def _cast(self, eye: Float64, directions: Float64, time_s: float) -> Float64:
        """(N,) m to the first surface; inf if there is none in reach."""
        town, reach = self.town, self.lidar.max_range_m
        i, j = town.grid.cell(eye[None, :2])[0]
        cell = (int(i), int(j))
        if cell not in self._scenes:
            lower, upper = town.grid.bounds(cell)
            around = town.cells(lower - reach, upper + reach)
            self._scenes[cell] = RayScene([town.solids(c) for c in around], (lower + upper) / 2)
            if len(self._scenes) > _KEPT_SCENES:
                del self._scenes[next(iter(self._scenes))]
        range_m = self._scenes[cell].cast(eye, directions).range_m
        moving = SolidSet(town.moving(time_s, eye[:2] - reach, eye[:2] + reach))
        if len(moving):
            range_m = np.minimum(range_m, RayScene([moving], eye[:2]).cast(eye, directions).range_m)
        rise = directions[:, 2]
        down = np.flatnonzero(rise < 0)
        range_m[down] = np.minimum(range_m[down], -eye[2] / rise[down])
        if town.style.ceiling_m is not None:
            up = np.flatnonzero(rise > 0)
            range_m[up] = np.minimum(range_m[up], (town.style.ceiling_m - eye[2]) / rise[up])
        return range_m


def open_town(
    path: str, *, n_scans: int = 100, min_range_m: float = 0.0, max_range_m: float | None = None
) -> TownRecording:
    """The recording that a path `town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED]` names.

    Args:
        path: A length in it wins over `n_scans`.
        n_scans: How many scans, a tenth of a second apart.
        min_range_m: Beams that end nearer are dropped, if the sensor does not drop them anyway.
        max_range_m: A shorter reach than the sensor's.
    Raises:
        DatasetError: not such a path, or open3d is missing.
    """
    name = TownName.parse(path)
    style = STYLES[name.style]
    sensor = name.sensor or ("planar360" if name.planar else "hdl64" if style.ceiling_m is None else "os64")
    lidar = SENSORS[sensor]
    lidar = dataclasses.replace(
        lidar,
        min_range_m=max(min_range_m, lidar.min_range_m),
        max_range_m=lidar.max_range_m if max_range_m is None else min(max_range_m, lidar.max_range_m),
    )
    spacing = style.speed_m_s * PERIOD_S
    if name.length_m is not None:
        n_scans = int(name.length_m / spacing + 1e-9) + 1
    town = Town(
        name.style,
        name.seed,
        length_m=max(n_scans - 1, 1) * spacing if name.length_m is None else name.length_m,
        dynamic=name.dynamic,
        slice_m=style.slice_m if name.planar else None,
    )
    return TownRecording(town, lidar, range(n_scans), str(name))
