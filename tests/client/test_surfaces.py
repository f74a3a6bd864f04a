"""Ground heights, pictures above the ground, and meshes, of a made-up place whose surfaces are known."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from potclient.cells import CellBox, layer_of
from potclient.errors import UsageError
from potclient.export import Band, export_bt, export_pgm
from potclient.ground import estimate_ground
from potclient.mesh import export_mesh, mesh_of, meshes, sd_colours
from potclient.occupancy import Grid
from potschemas import messages
from potschemas.examples import examples
from tests.map_server import FREE, OCCUPIED, UNKNOWN, load_map

Array = np.ndarray[Any, Any]
LOWER, UPPER = [-6.0, -4.0, -1.5], [10.0, 6.0, 4.0]
_SOFT_M = 0.1  # how softly a surface is answered
_SENSOR, _BLIND_M = np.array([2.0, 0.0]), 1.5  # nothing below was seen so near to the sensor


def ground_m(x: Array) -> Array:
    """A ramp that begins at x = 0."""
    return 0.1 * np.maximum(x, 0.0)


def depth_inside(p: Array) -> Array:
    """m: how deep points (N, 3) are in something; negative in free space."""
    x, y, z = p.T
    ground = ground_m(x)
    wall = np.minimum.reduce([y - 4.0, 4.6 - y, 2.5 - (z - ground)])
    table = np.minimum.reduce([0.8 - np.abs(x + 3), 0.8 - np.abs(y), 0.9 - (z - ground)])
    return np.maximum.reduce([ground - z, wall, table, z - 3.2])  # and a ceiling


class Place:
    """It answers as a map would; below the ground by more than half a metre, and in the walls' middle, nothing was seen."""

    def __init__(self) -> None:
        self.n_questions = 0

    def info(self) -> messages.Info:
        info: Any = examples()[messages.Info.schema]
        limits = msgspec.structs.replace(info.limits, max_grid_cells=250_000)
        return msgspec.structs.replace(info, limits=limits, lower=LOWER, upper=UPPER)

    def params_parts(self, lower: Any = None, upper: Any = None) -> Any:
        raise AssertionError("surfaces are made of grids")

    def grid(self, lower: Any, upper: Any, resolution: float) -> Grid:
        self.n_questions += 1
        low = np.asarray(lower, np.float64)
        shape = tuple(np.ceil((np.asarray(upper) - low) / resolution - 1e-6).astype(int))
        p = low + (np.argwhere(np.ones(shape)) + 0.5) * resolution
        depth = depth_inside(p)
        mean = 1 / (1 + np.exp(-np.clip(depth / _SOFT_M * 4, -30, 30)))
        blind = (np.linalg.norm(p[:, :2] - _SENSOR, axis=1) < _BLIND_M) & (p[:, 2] < ground_m(p[:, 0]) + 0.3)
        observed = (depth < 0.5) & ~blind
        mean[~observed] = 0.5
        as_cells = {
            "mean": mean,
            "var": mean * (1 - mean),
            "latent_mean": depth,
            "latent_var": depth * 0 + 1,
            "borrowed": depth * 0,
        }
        cells = {name: array.reshape(shape).astype(np.float32) for name, array in as_cells.items()}
        return Grid(lower=low, resolution=resolution, revision=7, observed=observed.reshape(shape), **cells)


@pytest.fixture
def place() -> Place:
    return Place()


def test_the_ground_is_found_under_tables_beside_walls_and_under_the_sensor(place: Place) -> None:
    ground = estimate_ground(place, LOWER, UPPER)
    x, y = (ground.box.centres()[axis] for axis in (0, 1))
    error = ground.height - ground_m(x)[:, None]
    in_wall = (y > 4) & (y < 4.6)
    assert not np.isnan(error[:, ~in_wall]).any()
    assert np.abs(error[:, ~in_wall]).max() < 0.15, "the filled disc under the sensor is on a ramp"
    assert np.median(np.abs(error)) < 0.02


def test_no_ground_is_said(place: Place) -> None:
    with pytest.raises(UsageError, match="no ground"):
        estimate_ground(place, [-6, -4, 1.2], [0, 3, 3.0])


def test_a_picture_above_the_ground_knows_floor_from_things(place: Place, tmp_path: Path) -> None:
    band = Band(estimate_ground(place, LOWER, UPPER), 0.15, 1.5)
    low, high = band.heights()
    box = CellBox.around([*LOWER[:2], low], [*UPPER[:2], high], 0.1)
    export_pgm(place, tmp_path / "map.pgm", box, band=band)
    loaded = load_map(tmp_path / "map.yaml")
    assert loaded.data.shape == (100, 160)
    assert [loaded.at(-3, 0), loaded.at(0, 4.2), loaded.at(8, 4.2)] == [OCCUPIED] * 3, "table and wall"
    assert [loaded.at(x, y) for x, y in ((-5, -3), (9, -2), (2, 0), (0, 3.5))] == [FREE] * 4, (
        "floor, ramp, below the sensor, before the wall"
    )
    x = np.arange(-6, 10, 0.1) + 0.05
    things = depth_inside(np.stack([x, np.full_like(x, -2.0), ground_m(x) + 0.2], axis=1)) > 0
    assert not things.any()
    assert (loaded.data[20] == FREE).all(), "a straight line over floor and ramp"
    box = CellBox.around([*LOWER[:2], 0.1], [*UPPER[:2], 1.5], 0.1)
    export_pgm(place, tmp_path / "fixed.pgm", box)
    assert load_map(tmp_path / "fixed.yaml").at(9, -2) == OCCUPIED, "a band of the map frame meets the ramp"


def test_columns_without_ground_are_unknown(place: Place, tmp_path: Path) -> None:
    ground = estimate_ground(place, LOWER, UPPER)
    ground.height[:40] = np.nan
    band = Band(ground, 0.15, 1.5)
    box = CellBox.around([*LOWER[:2], band.heights()[0]], [*UPPER[:2], band.heights()[1]], 0.1)
    export_pgm(place, tmp_path / "map.pgm", box, band=band)
    loaded = load_map(tmp_path / "map.yaml")
    assert (loaded.data[:, :80] == UNKNOWN).all()
    assert (loaded.data[:, 80:] == FREE).any()


def test_an_octomap_is_what_octomap_itself_reads(place: Place, tmp_path: Path) -> None:
    pyoctomap = pytest.importorskip("pyoctomap")
    box = CellBox.around([-4.0, -1.0, -0.6], [0.0, 1.0, 1.4], 0.2)
    done = export_bt(place, tmp_path / "map.bt", box)
    tree = pyoctomap.OcTree(0.2)
    assert tree.readBinary(str(tmp_path / "map.bt"))
    assert tree.getResolution() == pytest.approx(0.2)
    grid = place.grid(box.first * 0.2, box.stop * 0.2, 0.2)
    n_known = 0
    for cell in np.ndindex(grid.shape):
        node = tree.search(((np.array(cell) + box.first + 0.5) * 0.2).tolist())
        assert (node is not None) == bool(grid.observed[cell])
        if node is not None:
            n_known += 1
            assert bool(tree.isNodeOccupied(node)) == bool(grid.mean[cell] >= 0.5)
    assert n_known == done.n > 500


# --- meshes ----------------------------------------------------------------------------------------------------------


def test_a_mesh_lies_on_the_surface_and_tiles_meet(place: Place) -> None:
    box = CellBox.around(LOWER, UPPER, 0.1)
    parts = [mesh for mesh, _ in meshes(place, box)]
    assert len(parts) > 1
    vertices = np.concatenate([mesh.vertices for mesh in parts]).astype(np.float64)
    assert len(vertices) > 10_000
    assert np.quantile(np.abs(depth_inside(vertices)), 0.95) < 0.05
    whole = mesh_of(place.grid(LOWER, UPPER, 0.1))
    area = [mesh_area(mesh.vertices, mesh.faces) for mesh in (*parts, whole)]
    assert sum(area[:-1]) == pytest.approx(area[-1], rel=1e-4), "no gap, and nothing twice"
    floor = whole.vertices[(whole.vertices[:, 2] < 0.05) & (whole.vertices[:, 0] < -4.2)]
    assert len(floor)
    normals = face_normals(whole.vertices, whole.faces)
    on_floor = whole.vertices[whole.faces].max(axis=(1,))[:, 2] < 0.05
    assert (normals[on_floor, 2] > 0).mean() > 0.95, "they look into free space"


def mesh_area(vertices: Array, faces: Array) -> float:
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def face_normals(vertices: Array, faces: Array) -> Array:
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize(("kind", "ending"), [("mesh", ".ply"), ("gltf", ".glb")])
def test_mesh_files_are_read_by_other_programs(place: Place, tmp_path: Path, kind: str, ending: str) -> None:
    import open3d

    box = CellBox.around([-5.0, -2.0, -0.4], [-1.0, 2.0, 1.6], 0.1)
    n, revisions = export_mesh(place, tmp_path / f"a{ending}", box, kind)
    assert revisions == (7,)
    mesh = open3d.io.read_triangle_mesh(str(tmp_path / f"a{ending}"))
    assert len(mesh.triangles) == n
    points = np.asarray(mesh.vertices)
    if kind == "gltf":  # y is up there
        points = points[:, [0, 2, 1]] * [1, -1, 1]
    assert np.quantile(np.abs(depth_inside(points)), 0.95) < 0.05
    assert mesh.has_vertex_colors()


def test_no_surface_is_said_and_leaves_no_file(place: Place, tmp_path: Path) -> None:
    box = CellBox.around([-5.0, -3.0, 1.2], [-4.0, -2.0, 2.0], 0.1)
    with pytest.raises(UsageError, match="no surface"):
        export_mesh(place, tmp_path / "a.ply", box, "mesh")
    assert not any(tmp_path.iterdir())


def test_colours_go_from_sure_to_unsure() -> None:
    colours = sd_colours(np.array([0.0, 0.25, 0.5, 9.0], np.float32))
    assert colours.tolist() == [[68, 1, 84], [33, 145, 140], [253, 231, 37], [253, 231, 37]]


def test_a_planar_map_has_one_layer(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    assert layer_of(place) is None
    info = msgspec.structs.replace(place.info(), lower=[-1, -1, 1e-7], upper=[1, 1, 3e-7])
    monkeypatch.setattr(place, "info", lambda: info)
    assert layer_of(place) == pytest.approx(2e-7)
