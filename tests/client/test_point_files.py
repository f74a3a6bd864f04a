"""Files of points as other programs write them, and those without a header."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.datasets import DatasetError, open_dataset
from potclient.datasets.files import kind_of, read_beams

# Five points, written by pcl-tools 1.13, Open3D 0.19, VTK 9.7, MeshLab 2025, LASzip 3.5 and copc-lib 2.6.
DIALECTS = Path(__file__).parent / "dialects"
POINTS = np.array([[1, 2, 3], [4, 5, 6.5], [-7, 8, 0.25], [0.5, 0.5, 0.5], [-20.125, 3.75, -1.5]])


@pytest.mark.parametrize("file", sorted(DIALECTS.iterdir()), ids=lambda path: path.name)
def test_what_other_programs_write_is_read(file: Path) -> None:
    beams = read_beams(file)
    np.testing.assert_array_equal(beams.points, POINTS)
    assert beams.is_return.all()
    is_double = "doubles" in file.name or file.suffix in (".las", ".laz")
    assert beams.points.dtype == (np.float64 if is_double else np.float32)


def test_the_dialects_are_what_their_names_say() -> None:
    heads = {file.name: file.read_bytes() for file in DIALECTS.iterdir()}
    assert sum(b"DATA binary_compressed" in head for head in heads.values()) == 3
    assert b"format binary_big_endian" in heads["vtk_big_endian_faces.ply"]
    assert b"property list" in heads["meshlab_doubles_lists.ply"]
    assert b"SIZE 8 8 8 4" in heads["pcl_doubles.pcd"]
    assert b"COUNT 1 1 1 3" in heads["pcl_doubles.pcd"]
    for name, version in {"laszip.las": 2, "laszip.laz": 2, "copclib_copc.laz": 4}.items():
        assert heads[name][:4] + heads[name][24:26] == b"LASF" + bytes([1, version])
    assert b"LASzip DLL 3.5" in heads["laszip.las"]
    assert b"laszip encoded" in heads["laszip.laz"]
    assert b"copc" in heads["copclib_copc.laz"]


# --- binary files without a header -----------------------------------------------------------------------------------


def rows(columns: int, n: int = 60) -> np.ndarray[Any, np.dtype[np.float32]]:
    rng = np.random.default_rng(columns)
    table = rng.normal(size=(n, columns)) * 10
    table[:, 3:] = np.abs(table[:, 3:])
    return table.astype("<f4")


@pytest.mark.parametrize(("columns", "said"), [(3, "3 float32"), (4, "4 float32"), (5, "5 float32")])
@pytest.mark.parametrize("compressed", [False, True])
def test_the_layout_is_known_from_the_numbers(
    tmp_path: Path, columns: int, said: str, compressed: bool
) -> None:
    table = rows(columns)
    file = tmp_path / ("a.bin.gz" if compressed else "a.bin")
    file.write_bytes(gzip.compress(table.tobytes()) if compressed else table.tobytes())
    beams = read_beams(file)
    np.testing.assert_array_equal(beams.points, table[:, :3])
    assert said in beams.layout
    assert said in " ".join(open_dataset(file).notes)


def test_nclt_in_half_centimetres(tmp_path: Path) -> None:
    records = np.zeros(40, [("xyz", "<u2", 3), ("intensity", "u1"), ("laser", "u1")])
    records["xyz"] = np.random.default_rng(0).integers(18_000, 22_000, (40, 3))
    records["laser"] = np.arange(40) % 32
    (tmp_path / "1326652795280148.bin").write_bytes(records.tobytes())
    recording = open_dataset(tmp_path / "1326652795280148.bin")
    np.testing.assert_allclose(recording[0].points, records["xyz"] * 0.005 - 100, atol=1e-5)
    assert recording[0].stamp_ns == 1_326_652_795_280_148_000, "its name is its time in microseconds"
    assert "NCLT" in " ".join(recording.notes)


def test_layouts_can_be_named_and_nothing_is_guessed_wildly(tmp_path: Path) -> None:
    table = rows(4)
    table[:, 3] = -1  # a reflectance that no layout of four expects
    (tmp_path / "a.bin").write_bytes(table.tobytes())
    named = read_beams(tmp_path / "a.bin", "xyzi")
    np.testing.assert_array_equal(named.points, table[:, :3])
    (tmp_path / "b.bin").write_bytes(np.full(120, np.nan, "<f4").tobytes()[:-4])
    with pytest.raises(
        DatasetError, match="none of the layouts xyzi, xyzir, xyz, nclt; name one with --layout"
    ):
        read_beams(tmp_path / "b.bin")
    with pytest.raises(DatasetError, match="not whole points of 4 float32"):
        read_beams(tmp_path / "b.bin", "xyzi")
    (tmp_path / "c.bin.gz").write_bytes(gzip.compress(table.tobytes())[:-20])
    with pytest.raises(DatasetError, match="not a readable gzip file"):
        read_beams(tmp_path / "c.bin.gz")


# --- numpy, LAS, feather ---------------------------------------------------------------------------------------------


def test_numpy_files(tmp_path: Path) -> None:
    np.save(tmp_path / "rows.npy", np.column_stack([POINTS, np.arange(5)]))
    np.save(tmp_path / "picture.npy", POINTS[:4].reshape(2, 2, 3).astype(np.float32))
    fields = np.zeros(5, [("intensity", "f4"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    for axis, column in zip("xyz", POINTS.T, strict=True):
        fields[axis] = column
    np.save(tmp_path / "fields.npy", fields)
    np.savez(
        tmp_path / "named.npz", other=np.zeros((9, 4)), points=POINTS, is_return=np.array([1, 1, 0, 1, 1])
    )
    np.savez(tmp_path / "only.npz", whatever=POINTS)
    for name, n in {"rows.npy": 5, "picture.npy": 4, "fields.npy": 5, "named.npz": 5, "only.npz": 5}.items():
        np.testing.assert_array_equal(read_beams(tmp_path / name).points, POINTS[:n], err_msg=name)
    assert read_beams(tmp_path / "named.npz").is_return.tolist() == [True, True, False, True, True]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"a": np.zeros((3, 3)), "b": np.zeros((3, 3))}, r"holds a \(3, 3\), b \(3, 3\): need one array"),
        ({"points": np.zeros((3, 2))}, "need one array"),
        ({"points": np.array([["x"] * 3])}, "need one array"),
        ({"points": np.zeros((4, 3)), "is_return": np.zeros(3)}, r"is_return \(3,\) for 4 points"),
        ({"points": np.array([{}], dtype=object)}, "not a readable .npz"),
    ],
)
def test_npz_files_without_one_cloud_say_what_they_hold(
    tmp_path: Path, arrays: dict[str, Any], message: str
) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(DatasetError, match=message):
        read_beams(tmp_path / "a.npz")


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las_files_keep_their_millimetres(tmp_path: Path, ending: str) -> None:
    laspy = pytest.importorskip("laspy")
    at = np.array([691_000.0, 5_334_000.0, 520.0])  # UTM
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.offsets, header.scales = at, [0.001] * 3
    las = laspy.LasData(header)
    las.xyz = POINTS + at
    las.write(tmp_path / f"a.{ending}")
    np.testing.assert_allclose(read_beams(tmp_path / f"a.{ending}").points, POINTS + at, atol=6e-4)
    scan = open_dataset(tmp_path / f"a.{ending}", origin=at)[0]
    np.testing.assert_allclose(scan.points, POINTS, atol=6e-4)
    np.testing.assert_allclose(scan.T_map_sensor[:3, 3], at)


def test_feather_files(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather

    columns = {axis: column.astype(np.float16) for axis, column in zip("xyz", POINTS.T, strict=True)}
    feather.write_feather(pyarrow.table(columns), str(tmp_path / "a.feather"))
    beams = read_beams(tmp_path / "a.feather")
    np.testing.assert_array_equal(beams.points, POINTS)
    assert beams.points.dtype == np.float32
    feather.write_feather(pyarrow.table({"u": [1.0]}), str(tmp_path / "b.feather"))
    with pytest.raises(DatasetError, match="fields u, need x y z"):
        read_beams(tmp_path / "b.feather")


@pytest.mark.parametrize("ending", ["npy", "npz", "las", "laz", "feather", "pcd", "ply"])
def test_files_that_are_something_else_are_named(tmp_path: Path, ending: str) -> None:
    file = tmp_path / f"a.{ending}"
    for content in (b"", b"nonsense\n" * 40):
        file.write_bytes(content)
        with pytest.raises(DatasetError, match=r"a\.\S+: (not a readable|cannot be read)") as caught:
            read_beams(file)
        assert "\n" not in str(caught.value)
    with pytest.raises(DatasetError, match="cannot be read"):
        read_beams(tmp_path / f"absent.{ending}")


@pytest.mark.parametrize(
    ("ending", "package"), [("las", "laspy"), ("feather", "pyarrow"), ("pcd", "pypcd4"), ("ply", "plyfile")]
)
def test_a_missing_package_is_named_with_the_command(
    tmp_path: Path, ending: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DatasetError, match=rf"needs the package {package}: pip install 'potserver\[files\]'"):
        read_beams(tmp_path / f"a.{ending}")


def test_kinds_go_by_the_longest_ending() -> None:
    names = {
        "a.pcd.bin": "nuScenes",
        "A.BIN": "binary",
        "a.bin.gz": "binary",
        "a.PCD": "PCD",
        "a.laz": "LAS",
        "a.txt": None,
    }
    assert {name: kind_of(Path(name)) for name in names} == names
