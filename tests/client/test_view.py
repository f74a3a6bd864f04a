"""What the 3D view makes of single tiles, planar and not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from potclient.occupancy import Grid
from potclient.view.layers import tile_box, tiles_between
from potclient.view.picture import MapPicture

pytest.importorskip("rerun")


class Heard:
    """In place of Rerun's recording: the last thing logged to each entity."""

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}

    def log(self, entity: str, thing: Any, *_: Any, **__: Any) -> None:
        self.last[entity] = thing


def grid(mean: Any, observed: Any) -> Grid:
    p = np.asarray(mean, np.float32)
    return Grid(
        lower=np.zeros(3), resolution=0.5, revision=1, mean=p, var=p * (1 - p), latent_mean=p, latent_var=p,
        observed=np.asarray(observed, np.bool_),
    )  # fmt: skip


@pytest.fixture
def picture() -> MapPicture:
    picture = MapPicture("test")
    picture.recording = Heard()
    return picture


def points_of(thing: Any) -> Any:
    return np.asarray(thing.positions.as_arrow_array().to_pylist())


def test_a_planar_tile_is_its_cells(picture: MapPicture) -> None:
    mean = np.array([[0.9, 0.1, 0.5], [0.1, 0.1, 0.5]])[:, :, None]
    observed = np.array([[1, 1, 0], [1, 1, 0]])[:, :, None]
    picture.draw_tile((3, -1, 0), grid(mean, observed))
    heard = picture.recording.last
    np.testing.assert_allclose(points_of(heard["map/surface/3_-1_0"]), [[0.25, 0.25, 0.25]])
    assert len(points_of(heard["map/free/3_-1_0"])) == 3
    np.testing.assert_allclose(
        points_of(heard["map/unknown/3_-1_0"])[:, 1], 1.25, err_msg="beside free cells"
    )


def test_what_is_no_longer_there_is_cleared(picture: MapPicture) -> None:
    mean = np.full((4, 4, 4), 0.1)
    mean[:, :, :2] = 0.9
    picture.draw_tile((0, 0, 0), grid(mean, np.ones((4, 4, 4))))
    assert type(picture.recording.last["map/surface/0_0_0"]).__name__ == "Mesh3D"
    picture.draw_tile((0, 0, 0), grid(np.full((4, 4, 4), 0.5), np.zeros((4, 4, 4))))
    kinds = {name: type(thing).__name__ for name, thing in picture.recording.last.items()}
    assert kinds == {f"map/{layer}/0_0_0": "Clear" for layer in ("surface", "free", "unknown")}


def test_tiles_and_their_cells() -> None:
    assert tiles_between([-0.1, 0, 0], [10.0, 9, 1], 10.0) == [(-1, 0, 0), (0, 0, 0), (1, 0, 0)]
    box = tile_box((1, 0, -1), 10.0, 0.5, None)
    assert (box.first.tolist(), box.stop.tolist()) == ([20, 0, -20], [41, 21, 1])
    flat = tile_box((1, 0, 0), 10.0, 0.5, 0.1)
    assert flat.stop[2] - flat.first[2] == 1
    np.testing.assert_allclose(flat.centres()[2], [0.1])
