"""Recipes: what they say, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from potserver.atoms.build.recipe import (
    SHARE_OF_RADIUS,
    RecordingRecipe,
    builtin_recipe,
    located,
    parse_recipe,
    read_recipe,
)
from potserver.errors import SettingsError
from potserver.recordings import Reader, open_recording

ROOMS = {"dataset": "bundled:rooms"}


def test_the_builtin_recipe_learns_from_recordings_that_the_package_ships() -> None:
    recipe = builtin_recipe()
    assert {recording.dims for recording in recipe.recordings} == {2, 3}
    for recording in recipe.recordings:
        assert recording.licence.startswith(("MIT", "Apache-2.0"))
        assert len(open_recording(recording.dataset, recording.reader)) > 0


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({}, "missing required field `recordings`"),
        ({"recordings": []}, "length >= 1"),
        ({"recordings": [{}]}, "missing required field `dataset`"),
        ({"recordings": [ROOMS], "tolerance": 1.0}, "unknown field `tolerance`"),
        ({"recordings": [ROOMS | {"license": "MIT"}]}, "unknown field `license`"),
        ({"recordings": [ROOMS], "tolerance_m": -1.0}, ">= 0.0"),
        ({"recordings": [ROOMS], "max_atoms": 0}, ">= 1"),
        ({"recordings": [ROOMS], "expect_too": ["logs/day1"]}, "^town:"),
        ({"recordings": [ROOMS | {"dims": 4}]}, "dims"),
        ({"recordings": [ROOMS | {"scans": 0}]}, "need at least 1"),
        ({"recordings": [ROOMS | {"scans": "1-5"}]}, "START:STOP:STEP"),
        ({"recordings": [ROOMS | {"name": "../x"}]}, "name"),
        ({"recordings": [ROOMS], "learner": {"max_range": 5.0}}, "did you mean max_range_m?"),
        ({"recordings": [ROOMS | {"learner": {"n_sectors": "six"}}]}, "n_sectors"),
        ({"recordings": [ROOMS | {"reader": {"stride": 2}}]}, "unknown field `stride`"),
        ({"recordings": [ROOMS], "quality": {"min_auc": 2.0}}, "<= 1.0"),
        ({"recordings": [ROOMS, ROOMS]}, "names must differ"),
    ],
)
def test_a_mistake_is_named(tree: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=r"^site\.toml: ") as caught:
        parse_recipe(tree, "site.toml")
    assert message in str(caught.value)


def test_a_file_that_is_missing_or_no_toml(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="cannot read recipe"):
        read_recipe(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("[[recordings]\n")
    with pytest.raises(SettingsError, match="is not TOML"):
        read_recipe(tmp_path / "bad.toml")


@pytest.mark.parametrize(
    ("scans", "expected"),
    [
        (":", range(20)),
        (3, range(3)),
        (99, range(20)),
        ("5:", range(5, 20)),
        (":5", range(5)),
        ("2:12:4", range(2, 12, 4)),
        ("::10", range(0, 20, 10)),
        ("30:", range(0)),
    ],
)
def test_which_scans(scans: int | str, expected: range) -> None:
    assert list(RecordingRecipe(dataset="x", scans=scans).numbers(20)) == list(expected)


@pytest.mark.parametrize(
    ("dataset", "prefix"),
    [
        ("/data/kitti/00", "kitti-00"),
        ("/data/Intel_Lab/intel.gfs.log", "intel-lab-intel.gfs"),
        ("bundled:street-plan", "street-plan"),
        ("town:terraces:2d:7", "town-terraces-2d-7"),
        ("generated", "generated"),
    ],
)
def test_names_come_from_the_dataset(dataset: str, prefix: str) -> None:
    assert RecordingRecipe(dataset=dataset).prefix == prefix
    assert RecordingRecipe(dataset=dataset, name="mine").prefix == "mine"


def test_paths_start_at_the_recipes_folder(tmp_path: Path) -> None:
    def at(dataset: str, poses: str | None = None) -> RecordingRecipe:
        return located(RecordingRecipe(dataset=dataset, reader=Reader(poses=poses)), tmp_path)

    assert at("logs/a.log").dataset == str(tmp_path / "logs" / "a.log")
    assert at("logs", "logs/p.txt").reader.poses == str(tmp_path / "logs" / "p.txt")
    assert at("/data/kitti").dataset == "/data/kitti"
    for spec in ("bundled:rooms", "town:terraces:1", "generated:2d", "generated"):
        assert at(spec).dataset == spec


def test_a_recording_overrides_the_recipe() -> None:
    recipe = parse_recipe(
        {
            "learner": {"n_sectors": 4, "max_range_m": 20.0},
            "recordings": [
                ROOMS | {"learner": {"n_sectors": 8}},
                {"dataset": "generated", "tolerance_m": 0.5},
            ],
        },
        "test",
    )
    rooms, generated = recipe.recordings
    assert (recipe.learner_of(rooms).n_sectors, recipe.learner_of(rooms).max_range_m) == (8, 20.0)
    assert recipe.learner_of(generated).n_sectors == 4
    assert recipe.tolerance_of(generated, 20.0) == 0.5
    assert recipe.tolerance_of(rooms, 20.0) == SHARE_OF_RADIUS * 20.0
