"""Maps as files of other programs, against what the same map answers point by point."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import plyfile
import pytest
import yaml

from potclient import export
from potclient.errors import InternalError, UsageError
from potclient.export import CellBox, export_bt, export_npz, export_pgm, export_ply
from potclient.kernels import KernelSet
from potclient.occupancy import Grid
from potclient.octomap import DEPTH, KEY_ORIGIN, read_bt
from potschemas import messages
from potschemas.answers import AnswerRule
from potschemas.examples import examples

Array = np.ndarray[Any, Any]
BOX = CellBox.around([-2.0, -1.0, -0.6], [2.2, 1.6, 0.9], 0.2)


class HeldMap:
    """A map of 40 kernels that answers like a `MapClient`, its kernels in two parts."""

    def __init__(self, max_grid_cells: int = 250_000) -> None:
        self.max_grid_cells = max_grid_cells
        hinges = np.random.default_rng(0).uniform([-2, -1, 0], [2, 1.5, 0.5], (40, 3))
        one = np.ones(40, np.float32)
        self.kernels = KernelSet(
            hinge_mean=hinges,
            hinge_var=np.full((40, 3), 0.01, np.float32),
            gamma_shape=2 * one,
            gamma_rate=one,
            weight_mean=3 * one,
            weight_var=0.5 * one,
            rule=AnswerRule(prior_var=50.0, residual_var=20.0),
            map_revision=7,
        )

    def info(self) -> messages.Info:
        info: Any = examples()[messages.Info.schema]
        limits = msgspec.structs.replace(info.limits, max_grid_cells=self.max_grid_cells)
        return msgspec.structs.replace(info, limits=limits)

    def params_parts(self, lower: Any = None, upper: Any = None) -> Iterator[tuple[int, int, KernelSet]]:
        inside = np.ones(40, np.bool_)
        if lower is not None:
            inside &= (self.kernels.hinge_mean >= lower).all(axis=1)
        if upper is not None:
            inside &= (self.kernels.hinge_mean <= upper).all(axis=1)
        for part, half in enumerate(np.array_split(np.flatnonzero(inside), 2)):
            yield part, 2, self.kernels.take(half)

    def grid(self, lower: Any, upper: Any, resolution: float) -> Grid:
        low = np.asarray(lower, np.float64)
        shape = tuple(np.ceil((np.asarray(upper) - low) / resolution - 1e-6).astype(int))
        answer = self.kernels.occupancy(low + (np.argwhere(np.ones(shape)) + 0.5) * resolution)
        names = ("mean", "var", "latent_mean", "latent_var", "observed", "borrowed")
        cells = {name: getattr(answer, name).reshape(shape) for name in names}
        return Grid(lower=low, resolution=resolution, revision=7, **cells)


class BrokenMap(HeldMap):
    """The same map on a server that fails."""

    def params_parts(self, lower: Any = None, upper: Any = None) -> Iterator[tuple[int, int, KernelSet]]:
        yield next(super().params_parts())
        raise InternalError("a bug")

    def grid(self, lower: Any, upper: Any, resolution: float) -> Grid:
        raise InternalError("a bug")


@pytest.fixture
def source() -> HeldMap:
    return HeldMap()


def cells_of(box: CellBox) -> Array:
    return np.argwhere(np.ones(tuple(box.stop - box.first))) + box.first


def answers(source: HeldMap, box: CellBox) -> tuple[Array, Array, Array]:
    """Cells, their means, and whether they are observed."""
    cells = cells_of(box)
    answer = source.kernels.occupancy((cells + 0.5) * box.resolution)
    return cells, answer.mean, answer.observed


def test_ply_has_all_ten_numbers_of_every_kernel(source: HeldMap, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    done = export_ply(source, tmp_path / "k.ply", progress=lambda *at: seen.append(at))
    assert (done.n, done.revisions) == (40, (7,))
    assert seen == [(1, 2), (2, 2)]
    ply = plyfile.PlyData.read(tmp_path / "k.ply")
    rows, kernels = ply["vertex"].data, source.kernels
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


def test_ply_of_a_box(source: HeldMap, tmp_path: Path) -> None:
    done = export_ply(source, tmp_path / "k.ply", lower=[-1, -1, -1], upper=[1, 1, 1])
    kernels = source.kernels.hinge_mean
    assert done.n == ((kernels >= -1) & (kernels <= 1)).all(axis=1).sum()
    assert 0 < done.n < 40


def test_npz_is_what_the_client_reads(source: HeldMap, tmp_path: Path) -> None:
    done = export_npz(source, tmp_path / "k.npz")
    back = KernelSet.load(tmp_path / "k.npz")
    assert done == export.Exported(40, (7,))
    np.testing.assert_array_equal(back.hinge_mean, source.kernels.hinge_mean)


@pytest.mark.parametrize("tile_cells", [60, 250_000])
def test_a_picture_is_the_likeliest_of_each_column(tmp_path: Path, tile_cells: int) -> None:
    source = HeldMap(max_grid_cells=tile_cells)
    seen: list[tuple[int, int]] = []
    done = export_pgm(
        source,
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
    _, mean, observed = answers(source, BOX)
    mean, observed = mean.reshape(nx, ny, nz), observed.reshape(nx, ny, nz)
    assert set(np.unique(image)) == {0, 205, 254}
    for i in range(nx):
        for j in range(ny):
            known = mean[i, j][observed[i, j]]
            highest = known.max() if len(known) else None
            expected = 205 if highest is None or 0.6 <= highest < 0.7 else 0 if highest >= 0.7 else 254
            assert image[ny - 1 - j, i] == expected


def test_the_yaml_gives_the_pixels_back_their_meaning(source: HeldMap, tmp_path: Path) -> None:
    export_pgm(source, tmp_path / "map.pgm", BOX)
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
def test_an_octomap_has_the_observed_cells(tmp_path: Path, tile_cells: int) -> None:
    source = HeldMap(max_grid_cells=tile_cells)
    done = export_bt(source, tmp_path / "map.bt", BOX, occupied_above=0.7, free_below=0.6)
    leaves, resolution = read_bt(tmp_path / "map.bt")
    assert resolution == 0.2
    cells, mean, observed = answers(source, BOX)
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


def test_what_cannot_be_written_is_refused(source: HeldMap, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="thresholds"):
        export_pgm(source, tmp_path / "m.pgm", BOX, occupied_above=0.2, free_below=0.6)
    with pytest.raises(UsageError, match="picture"):
        export_pgm(source, tmp_path / "m.yaml", BOX)
    with pytest.raises(UsageError, match="coarser"):
        export_bt(source, tmp_path / "m.bt", CellBox.around([0, 0, 0], [7000, 1, 1], 0.2))
    assert list(tmp_path.iterdir()) == []


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    source = BrokenMap()
    for write in (
        lambda: export_ply(source, tmp_path / "k.ply"),
        lambda: export_npz(source, tmp_path / "k.npz"),
        lambda: export_pgm(source, tmp_path / "m.pgm", BOX),
        lambda: export_bt(source, tmp_path / "m.bt", BOX),
    ):
        with pytest.raises(InternalError):
            write()
    assert list(tmp_path.iterdir()) == []
