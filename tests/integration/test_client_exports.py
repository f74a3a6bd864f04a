"""`potclient export` against a server: each kind of file, and pictures of planar maps and of floors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from potclient.client import MapClient
from potclient.datasets import open_dataset
from potclient.kernels import KernelSet
from potserver.server import MapServer
from tests.map_server import FREE, OCCUPIED, load_map

from .conftest import Run

CORNERS = ("--lower", "-2", "-2", "-2", "--upper", "2", "2", "2")


@pytest.mark.parametrize("kind", ["ply", "npz", "pgm", "bt", "mesh", "gltf"])
def test_export_writes_each_kind(run: Run, map_client: MapClient, tmp_path: Path, kind: str) -> None:
    cells = [*CORNERS, "--resolution", "0.5"]
    grid = {"pgm": [*cells, "--band", "0", "1"], "bt": cells}.get(kind, [])
    grid = ["--resolution", "0.3"] if kind in ("mesh", "gltf") else grid
    name = {"mesh": "map.ply", "gltf": "map.glb"}.get(kind, f"map.{kind}")
    status, out, err = run("export", kind, "-o", str(tmp_path / name), *grid)
    assert (status, err) == (0, "")
    assert f"revision {map_client.info().map_revision}" in out
    expected = {name} | ({"map.yaml"} if kind == "pgm" else set())
    assert {p.name for p in tmp_path.iterdir()} == expected
    if kind == "npz":
        assert len(KernelSet.load(tmp_path / "map.npz")) == map_client.info().n_kernels


def test_a_planar_map_is_one_layer_of_a_picture(
    run_at: Run, map_server: MapServer, map_client: MapClient, tmp_path: Path
) -> None:
    angle = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    square = 3.0 / np.maximum(np.abs(np.cos(angle)), np.abs(np.sin(angle)))
    map_client.integrate(np.stack([square * np.cos(angle), square * np.sin(angle)], axis=1), np.eye(4))
    words = ("export", "pgm", "--resolution", "0.1", "-o", str(tmp_path / "map.pgm"))
    for more in ((), ("--band", "-1", "1")):
        status, _, err = run_at(map_server.endpoint, *words, *more)
        assert (status, err) == (0, "")
        loaded = load_map(tmp_path / "map.yaml")
        assert [loaded.at(0, 0), loaded.at(2, 1), loaded.at(-1, -2)] == [FREE] * 3
        assert [loaded.at(3.05, 0), loaded.at(0, -3.05)] == [OCCUPIED] * 2
    for more, message in (
        (("--band", "0.5", "1"), "leave it out"),
        (("--above-ground", "0", "1"), "no ground"),
    ):
        status, _, err = run_at(map_server.endpoint, *words, *more)
        assert status == 2
        assert message in err


def test_a_band_that_touches_the_floor_is_warned_of(
    run_at: Run, map_server: MapServer, map_client: MapClient, tmp_path: Path
) -> None:
    for scan in open_dataset("generated", n_generated=100, max_range_m=12.0)[:3]:
        map_client.integrate(scan.points, scan.T_map_sensor, is_return=scan.is_return)
    box = ("--lower", "4", "-5", "-1", "--upper", "14", "5", "2.5", "--resolution", "0.2")
    words = ("export", "pgm", "-o", str(tmp_path / "map.pgm"), *box)
    status, _, err = run_at(map_server.endpoint, *words, "--band", "0.0", "1.5")
    assert status == 0
    assert "the floor becomes an obstacle there. --above-ground LOW HIGH follows it" in err
    touched = (load_map(tmp_path / "map.yaml").data == FREE).mean()
    status, _, err = run_at(map_server.endpoint, *words, "--above-ground", "0.2", "1.5")
    assert status == 0
    assert "ground mostly at" in err
    assert (load_map(tmp_path / "map.yaml").data == FREE).mean() > touched + 0.1
