"""`potserver eval paper`: tables in seconds, taken up again where they ended, and the parts they are made of."""

from __future__ import annotations

import dataclasses
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from potclient.datasets import open_dataset
from potclient.holdout import LabelledPoints
from potserver import AtomDictionary, MappingService, MappingSettings, cli
from potserver.atoms.learning import LearningSettings
from potserver.errors import SettingsError
from potserver.evaluation.mappers import Answer
from potserver.evaluation.paper import mass, rivalry
from potserver.evaluation.paper.icp import icp
from potserver.evaluation.paper.rivals import AbhmPipeline, BhmPipeline
from potserver.evaluation.paper.scenes import (
    KITTI,
    KITTI_RING,
    TOWNS_2D,
    LevelRing,
    NoDataError,
    Scene,
    open_scene,
)
from potserver.evaluation.paper.shipped import authors_refined
from potserver.evaluation.paper.sizes import FULL, QUICK, SMALL
from potserver.evaluation.paper.sources import Sources
from potserver.evaluation.paper.table import Cell, Found, Lab, Results, Shown, Table
from potserver.evaluation.paper.tables import TABLES
from potserver.evaluation.paper.trial import fitted, scored
from potserver.numerics.coupling import couple
from potserver.numerics.displacement import OutOfSample, barycentric_images, carry
from potserver.numerics.geometry import rotation_z
from potserver.recordings import to_scan
from tests.conformance import reference


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the quick size of the towns' table leaves."""
    folder = tmp_path_factory.mktemp("paper")
    assert (
        cli.main(["eval", "paper", "--quick", "--table", "towns", "--threads", "2", "--out", str(folder)])
        == 0
    )
    return folder


def test_a_table_is_written_as_numbers_words_and_a_picture(out: Path) -> None:
    kept = json.loads((out / "towns.json").read_text())
    assert list(kept["cells"]) == ["Town 1, 2D to Town 1, 2D", "Town 1, 3D to Town 1, 3D"]
    for rows in kept["cells"].values():
        scores = {row["map"]: row for row in rows}
        assert list(scores) == ["POT", "RePOT", "RePOT, flat prior", "RePOT fitted to the test points"]
        assert scores["RePOT"]["auc"] > scores["POT"]["auc"]
        assert scores["RePOT fitted to the test points"]["nll"] < scores["POT"]["nll"]
        assert scores["POT"]["scans"] == QUICK.scans
    text = (out / "towns.md").read_text()
    assert "$ potserver eval paper --table towns --size quick" in text
    assert "(0.79)" in text, "the paper's figure stands beside ours"
    assert "not run" in text, "what the quick size leaves out is said"
    assert (out / "towns.png").read_bytes().startswith(b"\x89PNG")
    assert len(AtomDictionary.load(out / "atoms-quick" / "town-1-2d-first-1.atoms")) > 0


def test_what_is_known_is_not_run_again(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (out / "towns.json").read_bytes()
    kept = json.loads(before)
    del kept["cells"]["Town 1, 2D to Town 1, 2D"]
    (out / "towns.json").write_text(json.dumps(kept))
    ran = []
    real = TABLES["towns"]
    told = real._replace(
        cells=lambda lab: [
            Cell(cell.key, partial(lambda cell: ran.append(cell.key) or cell.run(), cell))
            for cell in real.cells(lab)
        ]
    )
    monkeypatch.setitem(TABLES, "towns", told)
    assert (
        cli.main(["eval", "paper", "--quick", "--table", "towns", "--threads", "2", "--out", str(out)]) == 0
    )
    assert ran == ["Town 1, 2D to Town 1, 2D"]
    again = json.loads((out / "towns.json").read_text())["cells"]
    for key, rows in json.loads(before)["cells"].items():
        for one, other in zip(rows, again[key], strict=True):
            assert one["nll"] == pytest.approx(other["nll"], abs=0.02), "the seeds are fixed"


def test_tables_are_listed_and_wrong_words_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cli.main(["eval", "paper"]) == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in TABLES)
    few = ["eval", "paper", "--quick", "--table", "ranking", "--only", "no such cell", "--out", str(tmp_path)]
    assert cli.main(few) == 0
    assert not (tmp_path / "ranking.json").exists(), "nothing ran"
    for wrong in (
        ["paper", "--table", "nothing"],
        ["paper", "--table", "towns", "--size", "huge"],
        ["paper", "bundled:plan", "--table", "towns"],
        ["bundled:plan", "--quick"],
        ["bundled:plan", "--table", "towns"],
    ):
        assert cli.main(["eval", *wrong, "--out", str(tmp_path)]) == 2, wrong


def _lab(tmp_path: Path) -> Lab:
    return Lab(QUICK, None, 2, Sources(tmp_path / "atoms", None, QUICK, 2), lambda: None)


def test_every_table_has_cells_of_different_names(tmp_path: Path) -> None:
    for name, table in TABLES.items():
        for size in (QUICK, SMALL):
            keys = [cell.key for cell in table.cells(_lab(tmp_path)._replace(size=size))]
            assert len(keys) == len(set(keys)) > 0, name
        assert table.name == name
        assert int(table.minutes) > 0


def test_cells_without_data_are_left_out_with_the_reason(tmp_path: Path) -> None:
    table = TABLES["shipped"]
    results = Results(tmp_path / "shipped.json", table, QUICK)
    results.run(table.cells(_lab(tmp_path)))
    assert results.cells == {}
    assert "--data" in results.missing["Town 1 to Town 1, as shipped"]
    for scene in (KITTI, KITTI_RING):
        with pytest.raises(NoDataError):
            open_scene(scene, tmp_path, 100)


def _table(cells: list[Cell]) -> Table:
    def show(found: Found) -> list[Shown]:
        return []

    return Table("one", "One", "nothing", "1", lambda lab: cells, show)


def test_an_error_loses_no_cell_and_other_results_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.json"

    def fails() -> list[dict]:
        raise RuntimeError("stopped here")

    table = _table([Cell("first", lambda: [{"map": "a", "nll": 1.0}]), Cell("second", fails)])
    with pytest.raises(RuntimeError):
        Results(path, table, QUICK).run(table.cells(_lab(tmp_path)))
    assert Results(path, table, QUICK).cells == {"first": [{"map": "a", "nll": 1.0}]}
    with pytest.raises(SettingsError, match="another --out"):
        Results(path, table, SMALL)
    path.write_text("{}")
    with pytest.raises(SettingsError, match="not results"):
        Results(path, table, QUICK)


# --- parts ----------------------------------------------------------------------------------------------------------------


def test_only_the_level_ring_of_a_scan_is_kept() -> None:
    scan = LevelRing(open_dataset("town:terraces:hdl64:1", max_range_m=20.0))[3]
    assert scan.is_planar
    assert 100 < len(scan) < 6000
    assert not scan.points[:, 2].any()
    assert np.linalg.norm(scan.points, axis=1).max() <= 20.01
    to_scan(scan, 0)  # a valid planar scan


@pytest.fixture(scope="module")
def clouds() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(60, 3)).astype(np.float32)
    return x, (x + np.array([0.5, 0, 0]) + rng.normal(0, 0.05, x.shape)).astype(np.float32)


def test_unbalanced_transport_of_equal_clouds_is_about_balanced_and_leaves_what_is_far(clouds) -> None:
    x, y = clouds
    options = {"reg": 0.002, "tolerance": 1e-3, "max_iterations": 2000}
    loose = mass.unbalanced(x, y, **options)
    assert loose.converged
    balanced = barycentric_images(couple(x, y, **options), y)
    assert np.abs(barycentric_images(loose, y) - balanced).mean() < 0.5
    far = np.concatenate([y, np.full((30, 3), 40.0, np.float32)])  # mass that nothing in the source explains
    images = barycentric_images(mass.unbalanced(x, far, **options), far)
    pulled = barycentric_images(couple(x, far, **options), far)
    assert (images[:, 1] > 20).mean() < 0.02
    assert (pulled[:, 1] > 20).mean() > 0.2


def test_partial_transport_moves_a_share(clouds) -> None:
    x, y = clouds
    found = mass.partial_share(x, y, reg=0.002, tolerance=1e-3, max_iterations=3000)
    assert found.converged
    total = 2.0 - 0.7  # of both, before the bins are taken off
    assert found.plan.sum() * total == pytest.approx(0.7, abs=0.03)
    assert (found.plan.sum(axis=1) > 0).all()


def test_icp_finds_a_turn_and_follows_no_stretch(clouds) -> None:
    x, _ = clouds
    options = {"reg": 0.002, "tolerance": 1e-3, "max_iterations": 100}
    turn = rotation_z(0.1)
    turned = (x @ turn.T).astype(np.float32)
    found = icp(x, turned, **options)
    assert found.converged
    np.testing.assert_allclose(carry(x, x, turned, found, OutOfSample.RIGID), turned, atol=1e-5)
    stretched = (x * [3, 1, 1]).astype(np.float32)
    left = carry(x, x, stretched, icp(x, stretched, **options), OutOfSample.RIGID) - stretched
    by_transport = carry(x, x, stretched, couple(x, stretched, **options), OutOfSample.NEAREST) - stretched
    assert np.square(left).mean() > 3.0 * np.square(by_transport).mean()


def _scans(n: int) -> list:
    recording = open_dataset("town:suburb:2d:7", max_range_m=20.0)
    return [to_scan(recording[10 * k], k) for k in range(n)]


def test_rivals_learn_from_scans_alone() -> None:
    settings = MappingSettings.of_profile("paper")
    learning = LearningSettings(
        max_range_m=20.0, max_kernels=20, points_per_kernel=2, max_epochs=1, dispersion_epochs=1, steps=5
    )
    makers = {
        "bhm": partial(BhmPipeline, spacing_m=1.0),
        "abhm": partial(AbhmPipeline, learning=learning),
    }
    for name, make in makers.items():
        service = MappingService(AtomDictionary(), settings, threads=2, make_pipeline=make)
        for scan in _scans(2):
            service.integrate(scan)
        scan = _scans(1)[0]
        beams = scan.beams
        hits = service.snapshot.occupancy(beams.ends[beams.is_return] + scan.origin).mean
        free = service.snapshot.occupancy(0.5 * beams.ends[beams.is_return] + scan.origin).mean
        assert hits.mean() > free.mean() + 0.2, name


def test_a_lattice_has_one_kernel_a_node_after_many_scans() -> None:
    make = partial(BhmPipeline, spacing_m=1.0)
    service = MappingService(
        AtomDictionary(), MappingSettings.of_profile("paper"), threads=2, make_pipeline=make
    )
    for scan in _scans(3):
        service.integrate(scan)
    hinge = service.snapshot.kernels.hinge_mean
    assert len(np.unique(np.round(hinge, 3), axis=0)) == len(hinge) > 300


def test_the_largest_step_within_the_budget_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = {"a": 1.0, "b": 3.0, "c": 9.0}
    monkeypatch.setattr(rivalry, "_cost_ms", lambda made, scans: cost[made])
    ladder = [partial(str, name) for name in cost]
    assert rivalry._most([], 5.0, ladder) == "b"
    assert rivalry._most([], 0.1, ladder) == "a"
    assert rivalry._most([], 50.0, ladder) == "c"


def _labels(n: int) -> LabelledPoints:
    rng = np.random.default_rng(5)
    points = rng.uniform(-5, 5, (n, 3)) * [1, 1, 0]
    return LabelledPoints(points=points, occupied=points[:, 0] > 0)


def test_a_fit_to_the_test_points_is_better_on_them_than_what_it_started_from() -> None:
    rng, labels = np.random.default_rng(1), _labels(400)
    kernels = reference.kernels_at(rng.uniform(-5, 5, (60, 3)) * [1, 1, 0], rng)
    before = scored(Answer(np.full(400, 0.5), np.ones(400, bool)), labels)
    for prior in (kernels, authors_refined(kernels, labels)):
        after = scored(fitted(prior, labels.points, labels.occupied, threads=2)(labels.points), labels)
        assert after["nll"] < 0.6 * before["nll"]
        assert after["auc"] > 0.95


def test_the_authors_refinement_counts_data_five_times() -> None:
    """One kernel far from all others, one point on it: five updates of its weight, each from the one before."""
    rng = np.random.default_rng(2)
    kernels = reference.kernels_at([[0.0, 0.0, 0.0]], rng).replace(
        weight_mean=np.zeros(1, np.float32), weight_var=np.ones(1, np.float32)
    )
    label = LabelledPoints(points=np.zeros((1, 3)), occupied=np.array([True]))
    found = authors_refined(kernels, label)
    mean, var, bound = 0.0, 1.0, 1.0
    for _ in range(5):
        tightness = 0.5 / bound * (1 / (1 + np.exp(-bound)) - 0.5)
        precision = 1 / var + 2 * tightness
        mean, var = (mean / var + 0.5) / precision, 1 / precision
        bound = np.sqrt(var + mean**2)
    assert found.weight_mean[0] == pytest.approx(mean, rel=1e-5)
    assert found.weight_var[0] == pytest.approx(var, rel=1e-5)


def test_the_authors_nll_has_their_clip() -> None:
    labels = LabelledPoints(points=np.zeros((2, 3)), occupied=np.array([True, False]))
    row = scored(Answer(np.array([0.0, 0.0]), np.ones(2, bool)), labels)
    assert row["nll_authors_clip"] == pytest.approx(-np.log(1e-15) / 2)
    assert row["nll"] == pytest.approx(-np.log(1e-6) / 2, rel=1e-5)


def test_a_smaller_pool_is_part_of_a_larger_one_and_both_lie_along_the_drives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = {}

    def learned(sources: Sources, scene: Scene, frames: range) -> list:
        taken[scene.name] = frames
        points = np.ones((3, 3), np.float32)
        kernels = reference.kernels_at(points, np.random.default_rng(0))
        return [
            reference.atom(f"{scene.key}-{n}-{s}", points, points, kernels, dims=2)
            for n in frames
            for s in range(4)
        ]

    monkeypatch.setattr(Sources, "_learned", learned)
    sources = Sources(tmp_path, None, FULL, 2)
    pool = [atom.atom_id for atom in sources.pool(TOWNS_2D[:2], 600)]
    assert len(pool) == len(set(pool)) == 600
    assert pool == [atom.atom_id for atom in sources.pool(TOWNS_2D[:2], 600)], "the order is drawn once"
    for scene in TOWNS_2D[:2]:
        n_scans = len(open_scene(scene, None, FULL.drive))
        assert 0.9 * n_scans < max(taken[scene.name]) < n_scans


def test_atoms_are_learned_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sources = Sources(tmp_path, None, QUICK, 2)
    made = sources.of(TOWNS_2D[0])
    monkeypatch.setattr(Sources, "_learned", lambda *a: pytest.fail("learned again"))
    assert [atom.atom_id for atom in sources.of(TOWNS_2D[0])] == [atom.atom_id for atom in made]
    assert dataclasses.asdict(made.atoms[0])["provenance"]["dataset"] == TOWNS_2D[0].dataset
