"""`potserver map`: kept maps are listed, exported and imported without a server."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from potclient.kernels import KernelSet as ClientKernels
from potclient.octomap import DEPTH, KEY_ORIGIN, Leaves, OcTreeBuilder, read_bt, write_bt
from potserver import cli
from potserver.commands.maps import places_of
from potserver.errors import SettingsError
from potserver.health import Health
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.storage.map_file import Origin, read_map, write_map
from potserver.storage.map_store import MapStore
from tests.storage.test_map_store import SETTINGS, make_scan

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs `potserver map ...`: exit code, output, errors."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = cli.main(["map", *map(str, arguments)])
        text = capsys.readouterr()
        return code, text.out, text.err

    return run


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved map of two robots."""
    service = MappingService(settings=SETTINGS, threads=1)
    for number, robot in ((1, "ada"), (2, "bob")):
        service.integrate(make_scan(number, robot))
    path = tmp_path_factory.mktemp("saved") / "rooms.map"
    write_map(path, service.state, Origin("site", True, {"ada": {"": 1}, "bob": {"": 2}}))
    return path


# --- info -------------------------------------------------------------------------------------------------------------


def test_info_counts_what_is_there(saved: Path, run: Run) -> None:
    code, out, _ = run("info", saved, "--json")
    assert code == 0
    (told,) = json.loads(out)
    state = read_map(saved).state()
    assert state.tiled is not None
    tiles = state.tiled.tiles.values()
    wanted = {
        "map": "site",
        "format": 2,
        "scans": 2,
        "revision": 2,
        "robots": ["ada", "bob"],
        "tiles": len(tiles),
        "kernels": sum(len(tile.kernels) for tile in tiles),
        "rows": sum(len(tile.rows.occupied) for tile in tiles),
        "bytes": saved.stat().st_size,
    }
    assert {key: told[key] for key in wanted} == wanted
    code, out, _ = run("info", saved)
    assert code == 0
    assert dict(line.split(maxsplit=1) for line in out.splitlines())["robots"] == "ada, bob"


def test_info_of_a_store_lists_its_maps_and_their_journals(tmp_path: Path, run: Run) -> None:
    for map_id, n in (("ground", 1), ("roof", 2)):
        service = MappingService(settings=SETTINGS, threads=1)
        store = MapStore(tmp_path / "store", map_id, keeps_evidence=True, health=Health(), fsync=False)
        store.restore(service)
        store.save("copy" if map_id == "roof" else None, service, {})
        for number in range(n):
            scan = make_scan(number)
            with store.keeping(scan) as commit:
                service.integrate(scan, commit=commit)
        shutil.copytree(
            tmp_path / "store" / map_id, tmp_path / "killed" / map_id
        )  # as a kill would leave it now
        store.close()
    shutil.copytree(tmp_path / "store" / "saved", tmp_path / "killed" / "saved")
    code, out, _ = run("info", tmp_path / "killed", "--json")
    assert code == 0
    told = [(each["map"], each.get("scans in the journal")) for each in json.loads(out)]
    assert told == [("ground", 1), ("roof", 2), ("roof", None)]


def test_info_counts_the_log_of_a_store_that_was_killed(tmp_path: Path, run: Run) -> None:
    service = MappingService(settings=SETTINGS, threads=1)
    store = MapStore(tmp_path / "store", "site", keeps_evidence=True, health=Health(), fsync=False)
    store.restore(service)
    service.integrate(make_scan(1))
    store.save(None, service, {})
    shutil.copytree(tmp_path / "store", tmp_path / "killed")  # as a kill would leave it now
    store.close()
    code, out, _ = run("info", tmp_path / "killed", "--json")
    assert code == 0
    (told,) = json.loads(out)
    assert told["bytes"] > told["bytes of tiles"] > 0


def test_a_store_that_a_server_has_open_is_read_and_said_to_be_in_use(tmp_path: Path, run: Run) -> None:
    service = MappingService(settings=SETTINGS, threads=1)
    folder = tmp_path / "store"
    store = MapStore(folder, "site", keeps_evidence=True, health=Health(), fsync=False)
    store.restore(service)

    def take(number: int) -> None:
        scan = make_scan(number)
        with store.keeping(scan) as commit:
            service.integrate(scan, commit=commit)
        store.advance(service, {})

    take(1)
    code, _, err = run("info", folder)
    assert code == 2
    assert "holds no map yet" in err
    assert "potclient map save" in err
    store.save(None, service, {})
    n = len(service.snapshot)
    take(2)
    code, out, err = run("info", folder, "--json")
    assert (code, err) == (0, "")
    (told,) = json.loads(out)
    assert (told["scans"], told["kernels"]) == (1, n)
    assert "a server runs" in told["in use"]
    assert "scans in the journal" not in told
    for path in (folder, folder / "site"):
        code, _, err = run("export", path, "-f", "npz", "-o", tmp_path / "out.npz", "-q")
        assert code == 0
        assert "a server runs" in err
        assert len(ClientKernels.load(tmp_path / "out.npz")) == n
    code, out, err = run("import", folder, "-o", tmp_path / "copy.map")
    assert code == 0
    assert "a server runs" in err
    take(3)
    assert service.n_scans == 3, "the server goes on"
    assert store.close()
    assert "in use" not in json.loads(run("info", folder, "--json")[1])[0]


def test_what_is_no_map_is_one_line_and_exit_code_two(tmp_path: Path, saved: Path, run: Run) -> None:
    damaged = tmp_path / "damaged.map"
    content = bytearray(saved.read_bytes())
    with contextlib.closing(sqlite3.connect(saved)) as tables:
        (tile,) = tables.execute("SELECT data FROM tiles").fetchone()
    content[content.index(tile[:40]) + 20] ^= 255  # anywhere else it may hit what nobody reads
    damaged.write_bytes(content)
    for path, what in (
        (damaged, "damaged.map is damaged"),
        (tmp_path / "none.map", "no map file at"),
        (tmp_path / "sub", "no map in"),
    ):
        (tmp_path / "sub").mkdir(exist_ok=True)
        code, _, err = run("info", path)
        assert code == 2
        assert what in err
        assert len(err.splitlines()) == 1


# --- export -----------------------------------------------------------------------------------------------------------


def test_a_saved_map_is_exported_as_it_answers(saved: Path, tmp_path: Path, run: Run) -> None:
    state = read_map(saved).state()
    assert state.tiled is not None
    whole = read_map(saved).kernel_map()
    points = np.random.default_rng(0).uniform(-6, 6, (300, 3))

    assert run("export", saved, "-f", "npz", "-o", tmp_path / "a.npz", "-q")[0] == 0
    kernels = ClientKernels.load(tmp_path / "a.npz")
    np.testing.assert_allclose(kernels.occupancy(points).mean, whole.occupancy(points).mean, atol=1e-4)

    assert run("export", saved, "-f", "ply", "-o", tmp_path / "a.ply", "-q")[0] == 0
    assert f"element vertex {len(whole)}\n".encode() in (tmp_path / "a.ply").read_bytes()

    box = ("--lower", -4, -4, 0, "--upper", 4, 4, 1)
    assert run("export", saved, "-f", "bt", "--resolution", 0.5, *box, "-o", tmp_path / "a.bt", "-q")[0] == 0
    leaves, resolution = read_bt(tmp_path / "a.bt")
    finest = leaves.depth == DEPTH
    centres = (leaves.keys[finest] - KEY_ORIGIN + 0.5) * resolution
    answer = whole.occupancy(centres)
    assert answer.observed.all()
    np.testing.assert_array_equal(answer.mean >= 0.5, leaves.occupied[finest])

    code, out, _ = run(
        "export", saved, "-f", "pgm", "--resolution", 0.5, "--band", 0, 1, "-o", tmp_path / "a.pgm", "-q"
    )
    assert code == 0
    assert "a.yaml" in out


def test_flags_that_mean_nothing_are_refused(saved: Path, tmp_path: Path, run: Run) -> None:
    code, _, err = run("export", saved, "-f", "bt", "-o", tmp_path / "a.bt")
    assert (code, "--resolution" in err) == (2, True)
    code, _, err = run("export", saved, "-f", "ply", "--band", 0, 1, "-o", tmp_path / "a.ply")
    assert (code, "no cells" in err) == (2, True)


# --- import -----------------------------------------------------------------------------------------------------------


def _leaf(key: tuple[int, int, int], depth: int, occupied: bool) -> Leaves:
    return Leaves(np.array([key]) + KEY_ORIGIN, np.array([depth]), np.array([occupied]))


def test_a_voxel_of_the_wanted_size_is_one_sample_at_its_centre() -> None:
    places = places_of(_leaf((1, -2, 0), DEPTH, True), 0.2, 0.2)
    np.testing.assert_allclose(places.points, [[0.3, -0.3, 0.1]])
    assert places.occupied.tolist() == [True]
    np.testing.assert_allclose(places.weight, [4.1])


def test_a_large_voxel_is_one_sample_for_each_of_its_parts() -> None:
    places = places_of(_leaf((0, 0, 0), DEPTH - 2, False), 0.1, 0.2)
    assert sorted(map(tuple, places.points.round(6).tolist())) == [
        (x, y, z) for x in (0.1, 0.3) for y in (0.1, 0.3) for z in (0.1, 0.3)
    ]
    assert not places.occupied.any()


@pytest.mark.parametrize("occupied", [True, False])
def test_small_voxels_weigh_together_what_one_would(occupied: bool) -> None:
    def total(resolution: float, depth: int, n: int) -> float:
        axis = np.arange(n)
        keys = np.stack(np.meshgrid(axis, axis, axis if not occupied else [0], indexing="ij"), -1).reshape(
            -1, 3
        )
        leaves = Leaves(keys + KEY_ORIGIN, np.full(len(keys), depth), np.full(len(keys), occupied))
        return float(places_of(leaves, resolution, 0.2).weight.sum())

    # a surface of hits, kept in half voxels, and a volume of free space
    assert total(0.05, DEPTH, 2) == pytest.approx(total(0.1, DEPTH, 1))


def test_an_octomap_comes_back_as_a_map_that_agrees(tmp_path: Path, run: Run) -> None:
    n = 20
    keys = np.stack(np.meshgrid(*[np.arange(-n, n)] * 2, np.arange(0, 8), indexing="ij"), -1).reshape(-1, 3)
    wall = (np.abs(keys[:, 0] + 0.5) > n - 2) | (np.abs(keys[:, 1] + 0.5) > n - 2)
    builder = OcTreeBuilder()
    builder.add(keys + KEY_ORIGIN, wall)
    write_bt(tmp_path / "Small Room.bt", builder.leaves(), 0.2)
    out = tmp_path / "room.map"
    code, said, _ = run("import", tmp_path / "Small Room.bt", "-o", out)
    assert code == 0
    assert "voxels of 0.2 m" in said
    saved = read_map(out)
    assert saved.record.robots == ["small-room"]
    assert saved.record.keeps_evidence
    assert saved.tiled is not None
    answer = saved.kernel_map().occupancy((keys + 0.5) * 0.2)
    assert answer.observed.all()
    assert ((answer.mean > 0.5) == wall).mean() > 0.95
    service = MappingService(settings=SETTINGS, threads=1)
    service.restore(saved.state())
    service.integrate(make_scan(1))
    assert service.state.n_scans == 1, "and scans go on from it"


def test_kernels_come_back_as_they_answer(tmp_path: Path, saved: Path, run: Run) -> None:
    run("export", saved, "-f", "npz", "-o", tmp_path / "a.npz", "-q")
    assert run("import", tmp_path / "a.npz", "-o", tmp_path / "a.map")[0] == 0
    again = read_map(tmp_path / "a.map")
    assert again.tiled is not None
    assert not again.record.keeps_evidence
    points = np.random.default_rng(1).uniform(-6, 6, (300, 3))
    kernels = ClientKernels.load(tmp_path / "a.npz")
    found = again.kernel_map()
    np.testing.assert_allclose(found.occupancy(points).mean, kernels.occupancy(points).mean, atol=1e-4)
    assert "profile paper" in run("info", tmp_path / "a.map")[1]
    paper = MappingService(settings=MappingSettings.of_profile("paper"), threads=1)
    paper.restore(again.state())
    paper.integrate(make_scan(1))


def test_a_snapshot_is_rescued_from_a_store(tmp_path: Path, run: Run) -> None:
    service = MappingService(settings=SETTINGS, threads=1)
    store = MapStore(tmp_path / "store", "default", keeps_evidence=True, health=Health(), fsync=False)
    store.restore(service)
    for number in (1, 2):
        scan = make_scan(number)
        with store.keeping(scan) as commit:
            service.integrate(scan, commit=commit)
        if number == 1:
            store.save(None, service, {"r1": {"": scan.seq}})
            first = service.state
    shutil.copytree(tmp_path / "store", tmp_path / "killed")  # as a kill would leave it now
    store.close()
    code, out, _ = run("import", tmp_path / "killed" / "default", "-o", tmp_path / "rescued.map")
    assert code == 0
    assert "1 scans of the journal are not in it" in out
    rescued = read_map(tmp_path / "rescued.map")
    assert (rescued.record.n_scans, rescued.record.heard) == (1, {"r1": {"": 1}})
    assert rescued.record.answer_rule == first.snapshot.rule


def test_what_cannot_be_imported_says_why(tmp_path: Path, run: Run) -> None:
    empty = tmp_path / "empty.bt"
    write_bt(empty, OcTreeBuilder().leaves(), 0.1)
    (tmp_path / "text.bt").write_text("not a tree")
    for file, what in (
        ("empty.bt", "nothing is known"),
        ("text.bt", "not a binary OctoMap"),
        ("none.bt", "cannot read"),
        ("none.npz", "No such file"),
    ):
        code, _, err = run("import", tmp_path / file, "-o", tmp_path / "out.map")
        assert (code, what in err) == (2, True), err
    assert not (tmp_path / "out.map").exists()
    with pytest.raises(SettingsError, match="--looks"):
        places_of(_leaf((0, 0, 0), DEPTH, True), 0.1, 0.2, looks=0.0)
    with pytest.raises(SettingsError, match="coarser"):
        places_of(_leaf((0, 0, 0), 1, False), 0.1, 0.2)


# --- merge ------------------------------------------------------------------------------------------------------------


def test_two_saved_maps_become_one(tmp_path: Path, saved: Path, run: Run) -> None:
    service = MappingService(settings=SETTINGS, threads=1)
    service.integrate(make_scan(3, "eve"))
    write_map(tmp_path / "eve.map", service.state, Origin("site", True, {"eve": {"": 3}}))
    out = tmp_path / "both.map"
    code, text, _ = run("merge", saved, tmp_path / "eve.map", "--pose", 100, 0, 0, 90, "-o", out)
    assert code == 0
    assert "tiles changed" in text
    merged, alone = read_map(out), read_map(saved)
    assert merged.record.heard == {"ada": {"": 1}, "bob": {"": 2}, "eve": {"": 3}}
    assert merged.state().n_scans == 3
    assert merged.state().tiled.robots == ("ada", "bob", "eve")
    hinge = np.concatenate([part.kernels.hinge_mean for part in merged.tiled.parts.values()])
    near = np.linalg.norm(hinge[:, :2] - [100.0, 0.0], axis=1) < 50.0
    assert near.sum() == pytest.approx(len(service.snapshot), rel=0.05)
    assert (~near).sum() == pytest.approx(sum(len(t.kernels) for t in alone.tiled.tiles.values()), rel=0.05)


def test_maps_of_two_kinds_are_not_merged(tmp_path: Path, saved: Path, run: Run) -> None:
    paper = MappingService(settings=MappingSettings.of_profile("paper"), threads=1)
    paper.integrate(make_scan(1, "ada"))
    write_map(tmp_path / "paper.map", paper.state, Origin("site", False, {"ada": {"": 1}}))
    code, _, err = run("merge", saved, tmp_path / "paper.map", "-o", tmp_path / "out.map")
    assert code == 2
    assert "cannot be merged" in err
    assert not (tmp_path / "out.map").exists()
