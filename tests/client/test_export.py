"""Maps as files of other programs, against what the same map answers point by point."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest
import yaml

from potclient import export
from potclient.client import MapClient
from potclient.errors import MapServerError, UsageError
from potclient.export import CellBox, export_bt, export_npz, export_pgm, export_ply
from potclient.kernels import KernelSet
from potclient.octomap import DEPTH, KEY_ORIGIN, read_bt
from potschemas.messages import ErrorCode
from tests.integration.fake_server import FakeServer

Array = np.ndarray[Any, Any]
BOX = CellBox.around([-2.0, -1.0, -0.6], [2.2, 1.6, 0.9], 0.2)


@pytest.fixture(scope="module")
def server() -> Iterator[FakeServer]:
    with FakeServer() as server:
        server.points = np.random.default_rng(0).uniform([-2, -1, 0], [2, 1.5, 0.5], (40, 3))
        server.revision = 7
        yield server


@pytest.fixture
def client(server: FakeServer) -> Iterator[MapClient]:
    server.script.fail.clear()
    with MapClient(server.endpoint) as client:
        client.wait_ready()
        yield client


def cells_of(box: CellBox) -> Array:
    return np.argwhere(np.ones(tuple(box.stop - box.first))) + box.first


def answers(client: MapClient, box: CellBox) -> tuple[Array, Array, Array]:
    """Cells, their means, and whether they are observed."""
    cells = cells_of(box)
    answer = client.occupancy((cells + 0.5) * box.resolution)
    return cells, answer.mean, answer.observed


def test_ply_has_all_ten_numbers_of_every_kernel(client: MapClient, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    done = export_ply(client, tmp_path / "k.ply", progress=lambda *at: seen.append(at))
    assert (done.n, done.revisions) == (40, (7,))
    assert seen == [(1, 2), (2, 2)]
    ply = plyfile.PlyData.read(tmp_path / "k.ply")
    rows, kernels = ply["vertex"].data, client.params()
    np.testing.assert_array_equal(np.stack([rows[a] for a in "xyz"], 1), kernels.hinge_mean)
    for axis, name in enumerate("xyz"):
        np.testing.assert_array_equal(rows[f"hinge_var_{name}"], kernels.hinge_var[:, axis])
    for name in ("gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(rows[name], getattr(kernels, name))
    assert (rows["red"] > 230).all(), "a weight of 3 is occupied"
    assert {f"{name} {value:g}" for name, value in kernels.rule.fields().items()} <= set(ply.comments)
    assert "prior_var 50" in ply.comments
    assert "map_revision 7" in ply.comments
    assert [p.name for p in tmp_path.iterdir()] == ["k.ply"]


def test_ply_of_a_box(client: MapClient, tmp_path: Path) -> None:
    done = export_ply(client, tmp_path / "k.ply", lower=[-1, -1, -1], upper=[1, 1, 1])
    assert done.n == len(client.params([-1, -1, -1], [1, 1, 1]))
    assert 0 < done.n < 40


def test_npz_is_what_the_client_reads(client: MapClient, tmp_path: Path) -> None:
    done = export_npz(client, tmp_path / "k.npz")
    back = KernelSet.load(tmp_path / "k.npz")
    assert done == export.Exported(40, (7,))
    np.testing.assert_array_equal(back.hinge_mean, client.params().hinge_mean)


@pytest.mark.parametrize("tile_cells", [60, 250_000])
def test_a_picture_is_the_likeliest_of_each_column(
    client: MapClient, tmp_path: Path, tile_cells: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "_TILE_CELLS", tile_cells)
    seen: list[tuple[int, int]] = []
    done = export_pgm(
        client,
        tmp_path / "map.pgm",
        BOX,
        occupied_above=0.7,
        free_below=0.6,
        progress=lambda *at: seen.append(at),
    )
    assert seen[-1] == (len(seen), len(seen))
    assert (len(seen) == 8) == (tile_cells == 250_000), "cut at 0, as an octree is, and where it must be"
    nx, ny, nz = (BOX.stop - BOX.first).tolist()
    assert done == export.Exported(nx * ny, (7,))
    raw = (tmp_path / "map.pgm").read_bytes()
    head = f"P5\n{nx} {ny}\n255\n".encode()
    assert raw.startswith(head)
    image = np.frombuffer(raw[len(head) :], np.uint8).reshape(ny, nx)
    _, mean, observed = answers(client, BOX)
    mean, observed = mean.reshape(nx, ny, nz), observed.reshape(nx, ny, nz)
    assert set(np.unique(image)) == {0, 205, 254}
    for i in range(nx):
        for j in range(ny):
            known = mean[i, j][observed[i, j]]
            highest = known.max() if len(known) else None
            expected = 205 if highest is None or 0.6 <= highest < 0.7 else 0 if highest >= 0.7 else 254
            assert image[ny - 1 - j, i] == expected


def test_the_yaml_gives_the_pixels_back_their_meaning(client: MapClient, tmp_path: Path) -> None:
    export_pgm(client, tmp_path / "map.pgm", BOX)
    meta = yaml.safe_load((tmp_path / "map.yaml").read_text())
    assert meta["image"] == "map.pgm"
    assert meta["mode"] == "trinary"
    assert meta["resolution"] == 0.2
    assert meta["negate"] == 0
    np.testing.assert_allclose(meta["origin"], [-2.0, -1.0, 0.0])
    for pixel, meaning in ((0, "occupied"), (254, "free"), (205, "unknown")):
        occupancy = (255 - pixel) / 255  # as map_server computes it
        said = (
            "occupied"
            if occupancy > meta["occupied_thresh"]
            else "free"
            if occupancy < meta["free_thresh"]
            else "unknown"
        )
        assert said == meaning


@pytest.mark.parametrize("tile_cells", [60, 250_000])
def test_an_octomap_has_the_observed_cells(
    client: MapClient, tmp_path: Path, tile_cells: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "_TILE_CELLS", tile_cells)
    done = export_bt(client, tmp_path / "map.bt", BOX, occupied_above=0.7, free_below=0.6)
    leaves, resolution = read_bt(tmp_path / "map.bt")
    assert resolution == 0.2
    cells, mean, observed = answers(client, BOX)
    expected = {
        tuple(cell): bool(p >= 0.7)
        for cell, p, known in zip(cells.tolist(), mean, observed, strict=True)
        if known and not 0.6 <= p < 0.7
    }
    found = {}
    for key, depth, occupied in zip(*(column.tolist() for column in leaves), strict=True):
        for offset in np.ndindex(*[2 ** (DEPTH - depth)] * 3):
            found[tuple(k + o - KEY_ORIGIN for k, o in zip(key, offset, strict=True))] = occupied
    assert found == expected
    assert done.n == len(expected)
    assert 0 < sum(expected.values()) < len(expected) < len(cells)


@pytest.mark.parametrize("max_cells", [1, 10, 64, 1000, 10**6])
def test_tiles_are_the_box_each_cell_once(max_cells: int) -> None:
    tiles = BOX.tiles(max_cells)
    shapes = [tile.stop - tile.first for tile in tiles]
    assert all(shape.prod() <= max_cells for shape in shapes)
    cells = np.concatenate([cells_of(tile) for tile in tiles])
    assert len(np.unique(cells, axis=0)) == len(cells) == (BOX.stop - BOX.first).prod()


def test_boxes_of_whole_cells_have_no_more_and_flat_ones_are_asked_at_their_height() -> None:
    box = CellBox.around([0.0, 0.3, -0.1], [1.0, 0.9, 0.1], 0.1)
    assert (box.stop - box.first).tolist() == [10, 6, 2]
    assert box.raised_m == 0.0
    flat = CellBox.around([0.0, 0.0, 0.3], [1.0, 1.0, 0.3], 0.25)
    assert (flat.stop - flat.first)[2] == 1
    assert (flat.first[2] + 0.5) * 0.25 + flat.raised_m == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("lower", "upper"), [([0, 0], [1, 1]), ([0, 0, np.nan], [1, 1, 1]), ([0, 0, 0], [1, -1, 1])]
)
def test_boxes_that_are_none_are_refused(lower: Any, upper: Any) -> None:
    with pytest.raises(UsageError, match="box"):
        CellBox.around(lower, upper, 0.1)


def test_what_cannot_be_written_is_refused(client: MapClient, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="thresholds"):
        export_pgm(client, tmp_path / "m.pgm", BOX, occupied_above=0.2, free_below=0.6)
    with pytest.raises(UsageError, match="picture"):
        export_pgm(client, tmp_path / "m.yaml", BOX)
    with pytest.raises(UsageError, match="coarser"):
        export_bt(client, tmp_path / "m.bt", CellBox.around([0, 0, 0], [7000, 1, 1], 0.2))
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_no_file(server: FakeServer, client: MapClient, tmp_path: Path) -> None:
    server.script.fail.update(params=ErrorCode.INTERNAL, grid=ErrorCode.INTERNAL)
    for write in (
        lambda: export_ply(client, tmp_path / "k.ply"),
        lambda: export_npz(client, tmp_path / "k.npz"),
        lambda: export_pgm(client, tmp_path / "m.pgm", BOX),
        lambda: export_bt(client, tmp_path / "m.bt", BOX),
    ):
        with pytest.raises(MapServerError):
            write()
    assert list(tmp_path.iterdir()) == []
