"""What a dictionary is made of: recordings, how they are read and learned, and how their atoms are chosen. TOML."""

from __future__ import annotations

import dataclasses
import difflib
import re
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from potserver.atoms.learning import LearningSettings
from potserver.errors import SettingsError
from potserver.recordings import BUNDLED_PREFIX, Reader, scan_numbers
from potserver.toml import read_toml

BUILTIN_RECIPE = "builtin_atoms.toml"
SHARE_OF_RADIUS = 0.15  # of an atom's radius: the tolerance where none is stated

_AtLeastOne = Annotated[int, msgspec.Meta(ge=1)]
_NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class Quality(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What an atom must reach on the held-out beams of its own sector to be a candidate."""

    min_points: _AtLeastOne = 10  # held-out points, hits and free points together; a planar scan has few
    min_auc: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.8
    max_nll: _NotNegative = 0.6  # nats; knowing nothing scores 0.69


class RecordingRecipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One recording, and what differs for it from the recipe's own settings."""

    dataset: str  # a path, `bundled:NAME`, or anything else that `open_dataset` knows
    # prefix of the atoms' ids; default: from the dataset
    name: Annotated[str, msgspec.Meta(pattern=r"^[a-z0-9][a-z0-9_.-]{0,39}$")] | None = None
    licence: str = "not stated"
    scans: int | str = ":"  # the first N, or START:STOP:STEP
    # scans, from each taken one on, that are learned together; a 2D scan alone shows little
    window: _AtLeastOne = 1
    dims: Literal[2, 3] | None = None  # what its scans must have
    max_atoms: _AtLeastOne | None = None  # kept of this recording
    tolerance_m: _NotNegative | None = None
    reader: Reader = Reader()
    learner: dict[str, Any] = {}  # fields of LearningSettings

    @property
    def prefix(self) -> str:
        """`name`, or the dataset's last two parts, e.g. `kitti-00`."""
        if self.name is not None:
            return self.name
        if _is_spec(self.dataset):
            parts = self.dataset.removeprefix(BUNDLED_PREFIX).split(":")
        else:
            parts = list(Path(self.dataset).resolve().with_suffix("").parts[-2:])
        return re.sub(r"[^a-z0-9.-]+", "-", "-".join(parts).lower()).strip("-.")[:40]

    def numbers(self, n_scans: int) -> range:
        """The scans that are taken of a recording of `n_scans`."""
        return scan_numbers(self.scans, n_scans)


class Recipe(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole dictionary."""

    recordings: Annotated[tuple[RecordingRecipe, ...], msgspec.Meta(min_length=1)]
    # no candidate is left farther than this from a kept atom (atoms/cover.py)
    tolerance_m: _NotNegative | None = None
    max_atoms: _AtLeastOne | None = None  # kept in each number of dimensions
    later_scans: Annotated[int, msgspec.Meta(ge=0)] = 2  # whose held-out beams also judge an atom
    # towns beside the recordings in 3D, seen by other sensors perhaps: they teach what to expect, and give no atoms
    expect_too: tuple[Annotated[str, msgspec.Meta(pattern=r"^town:")], ...] = ()
    seed: Annotated[int, msgspec.Meta(ge=0)] = 0
    quality: Quality = Quality()
    learner: dict[str, Any] = {}  # fields of LearningSettings, for all recordings

    def tolerance_of(self, recording: RecordingRecipe, radius_m: float) -> float:
        """The recording's tolerance, else the recipe's, else a share of an atom's radius, m."""
        for stated in (recording.tolerance_m, self.tolerance_m):
            if stated is not None:
                return stated
        return SHARE_OF_RADIUS * radius_m

    def learner_of(self, recording: RecordingRecipe) -> LearningSettings:
        """Defaults < the recipe's `learner` < the recording's."""
        return learning_settings(self.learner | recording.learner)


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe file.

    Raises:
        SettingsError: no such file, not TOML, an unknown key, or an illegal value; the message says which.
    """
    return parse_recipe(read_toml(Path(path), "recipe"), str(path))


def builtin_recipe() -> Recipe:
    """The recipe of the dictionary that the package ships."""
    return read_recipe(Path(str(resources.files("potserver") / "data" / BUILTIN_RECIPE)))


def parse_recipe(tree: Mapping[str, Any], source: str) -> Recipe:
    """Check a tree of plain values.

    Args:
        tree: As read from TOML.
        source: Where it came from, for messages.
    Raises:
        SettingsError: as for `read_recipe`.
    """
    try:
        recipe = msgspec.convert(tree, Recipe, strict=True)
        for recording in recipe.recordings:
            recipe.learner_of(recording)
            recording.numbers(0)
    except (msgspec.ValidationError, SettingsError) as error:
        raise SettingsError(f"{source}: {error}") from error
    names = [recording.prefix for recording in recipe.recordings]
    if len(set(names)) < len(names):
        raise SettingsError(f"{source}: the recordings' names must differ, got {', '.join(names)}")
    return recipe


def learning_settings(values: Mapping[str, Any]) -> LearningSettings:
    """The learner's settings with some of them given.

    Raises:
        SettingsError: an unknown key, or a value of another type.
    """
    known = [field.name for field in dataclasses.fields(LearningSettings)]
    for key in values:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            raise SettingsError(
                f"no learner setting {key!r}" + (f"; did you mean {near[0]}?" if near else "")
            )
    try:
        return msgspec.convert(dict(values), LearningSettings, strict=True)
    except msgspec.ValidationError as error:
        raise SettingsError(f"learner: {error}") from error


def located(recording: RecordingRecipe, folder: Path) -> RecordingRecipe:
    """The same recording with its relative paths, which start at the recipe's folder, made absolute."""

    def at(path: str) -> str:
        return str((folder / path).resolve())

    dataset, reader = recording.dataset, recording.reader
    if not _is_spec(dataset):
        dataset = at(dataset)
    if reader.poses is not None:
        reader = msgspec.structs.replace(reader, poses=at(reader.poses))
    return msgspec.structs.replace(recording, dataset=dataset, reader=reader)


def _is_spec(dataset: str) -> bool:
    """Whether this is a name like `town:terraces:1` or `generated`, and not a path."""
    return bool(re.match(r"[a-z]+(:|\Z)", dataset)) and (":" in dataset or dataset == "generated")
