"""Drives through towns as recordings: `town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED]`."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from potclient.arrays import Bool, Float64
from potclient.datasets.scans import RecordedScan
from potclient.errors import DatasetError
from potclient.towns.lidar import SENSORS, Lidar
from potclient.towns.raycast import RayScene
from potclient.towns.solids import SolidSet
from potclient.towns.streets import Crossing
from potclient.towns.styles import STYLES
from potclient.towns.surveyed import PERIOD_S, Surfaces, SurveyedRecording
from potclient.towns.town import Town

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


class TownRecording(SurveyedRecording):
    """Scans of a drive through a town at 10 Hz; a slice is such a recording too.

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
        style = town.style
        super().__init__(
            Path(name or f"town:{style.name}:{town.seed}"),
            lidar,
            indices,
            seed=town.seed,
            slice_m=town.slice_m,
            ceiling_m=style.ceiling_m,
        )
        self.town = town
        self._scenes: dict[Crossing, RayScene] = {}
        spacing = style.speed_m_s * PERIOD_S * indices.step
        self.notes = (
            f"made-up town: {style.summary}; seed {town.seed}, {'dynamic' if town.dynamic else 'static'}",
            f"{lidar.name} every {spacing:.3g} m at {style.speed_m_s:g} m/s",
        )

    @overload
    def __getitem__(self, index: int) -> RecordedScan: ...
    @overload
    def __getitem__(self, index: slice) -> TownRecording: ...
    def __getitem__(self, index: int | slice) -> RecordedScan | TownRecording:
        if isinstance(index, slice):
            return TownRecording(self.town, self.lidar, self.indices[index], str(self.path))
        return super().__getitem__(index)

    def pose(self, time_s: float) -> Float64:
        return self.town.pose(time_s)

    def occupied(self, points: ArrayLike, time_s: float = 0.0) -> Bool:
        return self.town.occupied(points, time_s)

    def solid_surfaces(self, eye: Float64, directions: Float64, time_s: float) -> Surfaces:
        town, reach = self.town, self.lidar.max_range_m
        i, j = town.grid.cell(eye[None, :2])[0]
        cell = (int(i), int(j))
        if cell not in self._scenes:
            lower, upper = town.grid.bounds(cell)
            around = town.cells(lower - reach, upper + reach)
            self._scenes[cell] = RayScene([town.solids(c) for c in around], (lower + upper) / 2)
            if len(self._scenes) > _KEPT_SCENES:
                del self._scenes[next(iter(self._scenes))]
        range_m, _, normals = self._scenes[cell].cast(eye, directions)
        moving = SolidSet(town.moving(time_s, eye[:2] - reach, eye[:2] + reach))
        if len(moving):
            mobile = RayScene([moving], eye[:2]).cast(eye, directions)
            nearer = mobile.range_m < range_m
            range_m[nearer], normals[nearer] = mobile.range_m[nearer], mobile.normals[nearer]
        return Surfaces(range_m, normals.astype(np.float64))


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
