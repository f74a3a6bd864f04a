"""The protocol on maps whose answers are known, and what `potserver eval` shows and writes."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest

from potclient.datasets import RecordedScan, Recording, open_dataset
from potclient.holdout import HoldOut
from potserver import AtomDictionary, MappingService, MappingSettings, cli
from potserver.commands.eval import to_markdown
from potserver.domain.kernel_map import KernelMap
from potserver.errors import EmptyError
from potserver.evaluation.ablations import ABLATIONS, label_of
from potserver.evaluation.mappers import Answer, Mapper, ServiceMap, Size, kernel_bytes
from potserver.evaluation.protocol import evaluate
from potserver.recordings import to_scan

WALL_M = 4.0


class Wall(Recording):
    """A sensor that goes along y sees a wall at x = 4 m with most beams; the others, towards -x, end at 10 m with no echo."""

    def __init__(self, n_scans: int = 3) -> None:
        super().__init__(Path("wall"))
        self._n = n_scans

    def __len__(self) -> int:
        return self._n

    def read(self, i: int) -> RecordedScan:
        rng = np.random.default_rng(i)
        aside = rng.uniform(-3.0, 3.0, (300, 2))
        hits = np.column_stack([np.full(300, WALL_M), aside])
        back = np.column_stack([np.full(60, -10.0), np.zeros((60, 2))])
        pose = np.eye(4)
        pose[1, 3] = 0.5 * i
        return RecordedScan(
            points=np.concatenate([hits, back]).astype(np.float32),
            is_return=np.arange(360) < 300,
            T_map_sensor=pose,
            stamp_ns=i * 100_000_000,
            name=f"wall#{i}",
        )


class Oracle(Mapper):
    """Knows where the wall is; notes what it was given."""

    def __init__(self, p_wall: float = 1.0, known: bool = True, name: str = "oracle") -> None:
        self.name, self._p, self._known = name, p_wall, known
        self.scans: list[RecordedScan] = []
        self.given: int | None = None

    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        self.scans.append(scan)
        return {"look": float(len(self.scans))}

    def finish(self, n_kernels: int) -> None:
        self.given = n_kernels

    def occupancy(self, points: np.ndarray) -> Answer:
        at_wall = points[:, 0] > WALL_M - 1e-3
        return Answer(np.where(at_wall, self._p, 1.0 - self._p), np.full(len(points), self._known))

    def size(self) -> Size:
        return Size(17, 1700)


class Batch(Oracle):
    is_batch = True


def test_a_map_that_knows_the_truth_scores_perfectly_and_one_that_knows_nothing_scores_a_half() -> None:
    right, ignorant = Oracle(), Oracle(known=False, name="ignorant")
    found = evaluate("wall", Wall(), range(3), [right, ignorant], hold_out=HoldOut())
    best, worst = (row.scores.protocol_1.held_out for row in found.rows)
    assert (best.accuracy, best.auc, best.share_unknown) == (1.0, 1.0, 0.0)
    assert best.nll == pytest.approx(1e-6, rel=1e-3)
    assert (worst.auc, worst.share_unknown) == (0.5, 1.0)
    assert worst.nll == pytest.approx(np.log(2.0))
    assert worst.brier == pytest.approx(0.25)


def test_no_map_is_given_a_beam_that_it_is_asked_about() -> None:
    oracle, hold_out = Oracle(), HoldOut(0.3, seed=5)
    found = evaluate("wall", Wall(), [2, 0], [oracle], hold_out=hold_out)
    n_asked = 0
    for scan, number in zip(oracle.scans, [2, 0], strict=True):
        held = hold_out.beams(360, number)
        whole = Wall()[number]
        np.testing.assert_array_equal(scan.points, whole.points[~held])
        n_asked += int(
            held.sum() + (held & whole.is_return).sum()
        )  # a free point each, and an end where there is an echo
    assert found.rows[0].scores.protocol_1.held_out.n == n_asked
    assert found.n_beams == sum(map(len, oracle.scans))


def test_what_is_held_out_of_a_scan_is_what_split_holds_out() -> None:
    scan = Wall()[1]
    training, labels = HoldOut().split(scan, 1)
    held = HoldOut().beams(len(scan), 1)
    np.testing.assert_array_equal(training.points, scan.points[~held])
    assert labels.occupied.sum() == (held & scan.is_return).sum()


def test_every_second_beam_is_looked_at() -> None:
    oracle = Oracle()
    evaluate("wall", Wall(), range(1), [oracle], hold_out=HoldOut(), thin=2)
    assert len(oracle.scans[0]) == 180 - HoldOut().beams(180, 0).sum()


def test_batch_maps_get_the_first_maps_number_of_kernels_and_their_time_is_shared_out() -> None:
    first, batch = Oracle(), Batch(name="batch")
    found = evaluate("wall", Wall(), range(3), [first, batch], hold_out=HoldOut())
    assert batch.given == 17
    assert found.rows[1].is_batch
    assert len(found.rows[1].scan_ms) == len(found.rows[1].cpu_ms) == 3


def test_stages_are_medians_and_the_way_is_as_long_as_the_poses_say() -> None:
    found = evaluate("wall", Wall(), range(3), [Oracle()], hold_out=HoldOut())
    assert found.rows[0].stage_ms == {"look": 2.0}
    assert found.path_m == pytest.approx(1.0)
    assert found.reach_m == pytest.approx(10.0)
    assert found.n_scans == 3


def test_no_scan_is_an_error() -> None:
    with pytest.raises(EmptyError, match="nothing to judge a map by"):
        evaluate("wall", Wall(), [], [Oracle()], hold_out=HoldOut())


class Solid(Oracle):
    """A map of kernels that is sure of a wall, and of free space up to it but not behind the sensor."""

    def __init__(self, wall_m: float = WALL_M) -> None:
        super().__init__(name=f"wall at {wall_m} m")
        self._wall_m = wall_m

    @property
    def kernel_map(self) -> KernelMap:
        side = np.arange(-4.0, 4.5, 0.5)
        y, z = (a.ravel() for a in np.meshgrid(side, side))
        wall = np.column_stack([np.full(len(y), self._wall_m), y, z])
        free = np.concatenate([wall - [back, 0.0, 0.0] for back in np.arange(0.5, self._wall_m + 0.5, 0.5)])
        n = len(wall) + len(free)
        weight = np.where(np.arange(n) < len(wall), 60.0, -20.0)
        return KernelMap.from_arrays(np.concatenate([wall, free]), np.full(n, 3.0), weight, np.zeros(n))


def test_rays_are_scored_by_where_held_out_beams_ended() -> None:
    maps = [Solid(), Solid(WALL_M - 1.0)]
    right, short = (
        row.scores.rays for row in evaluate("wall", Wall(), range(3), maps, hold_out=HoldOut()).rows
    )
    assert right is not None
    assert short is not None
    assert 0 < right.n_free < right.n_returns
    assert right.range_error_m < 0.6  # about the width of its kernels
    assert short.range_error_m > right.range_error_m + 0.9
    assert (
        right.false_return > 0.9
    )  # nobody told it that there is free space behind: an even chance every width


def test_maps_without_kernels_are_asked_for_no_rays() -> None:
    assert evaluate("wall", Wall(), range(1), [Oracle()], hold_out=HoldOut()).rows[0].scores.rays is None


def test_towns_are_asked_about_their_truth() -> None:
    pytest.importorskip("open3d")
    recording = open_dataset("town:offices:2d:3", max_range_m=8.0)
    town = recording.town

    class Truth(Oracle):
        def occupancy(self, points: np.ndarray) -> Answer:
            occupied = town.occupied(points, recording[4].stamp_ns / 1e9)
            return Answer(occupied.astype(float), np.ones(len(points), bool))

    found = evaluate("town", recording, [0, 4], [Truth()], hold_out=HoldOut())
    assert set(found.rows[0].scores.protocol_1.truth) == {"uniform", "near_surfaces"}
    for metrics in found.rows[0].scores.protocol_1.truth.values():
        assert metrics.accuracy == metrics.auc == 1.0
        assert metrics.n > 30


def test_ablations_are_what_their_names_say() -> None:
    assert list(ABLATIONS) == ["POT, not refined", "RePOT, transported prior", "RePOT, flat prior"]
    rows = {name: MappingService(threads=2, make_pipeline=pipeline) for name, pipeline in ABLATIONS.items()}
    updates = {name: service.integrate(to_scan(Wall()[0], 0)) for name, service in rows.items()}
    pot, repot, flat = updates.values()
    assert not rows["POT, not refined"].keeps_evidence
    assert pot.n_kernels_added == pot.n_kernels_transported == len(pot.kernels) > 0
    for update in (repot, flat):
        assert update.n_kernels_transported == update.n_kernels_added == pot.n_kernels_transported
    priors = {
        name: np.concatenate([tile.kernels.prior_mean for tile in service.state.tiled.tiles.values()])
        for name, service in rows.items()
    }
    assert np.abs(priors["RePOT, transported prior"]).max() > 0.1
    np.testing.assert_array_equal(priors["RePOT, flat prior"], 0.0)


def test_ablations_of_another_profile_are_refused() -> None:
    assert cli.main(["eval", "bundled:plan", "--profile", "paper", "--ablations"]) == 2


def test_a_label_says_what_ran() -> None:
    assert label_of(MappingSettings()) == "default"
    assert label_of(MappingSettings.of_profile("paper")) == "paper"
    assert (
        label_of(MappingSettings(gone_odds=0.0, max_range_m=9.0)) == "default, max_range_m=9.0, gone_odds=0.0"
    )


def test_our_map_is_the_services() -> None:
    service = ServiceMap("ours", MappingService(AtomDictionary(), MappingSettings(), threads=1))
    timings = service.integrate(Wall()[0])
    assert timings.keys() >= {"label", "fuse"}
    size = service.size()
    assert size.cells == len(service.kernel_map) > 0
    assert size.n_bytes == kernel_bytes(service.kernel_map.kernels) == 40 * size.cells
    mean, observed, var = service.occupancy(
        np.array([[WALL_M + 0.1, 0.0, 0.0], [2.0, 0.0, 0.0], [500.0, 0.0, 0.0]])
    )
    assert mean[0] > 0.8
    assert mean[1] < 0.2
    assert observed.tolist() == [True, True, False]
    assert var is not None
    assert var[1] < 0.05 < var[2]


# --- the command ---------------------------------------------------------------------------------------------------------


def run(*flags: str) -> int:
    return cli.main(["eval", "generated", "--scans", "2", "--thin", "8", "--threads", "1", *flags])


def test_the_command_prints_a_row_a_map_and_writes_all_numbers(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    numbers, document = tmp_path / "eval.json", tmp_path / "eval.md"
    assert (
        run(
            "--peers",
            "bgk:0.5,grid",
            "--max-range",
            "12",
            "--json",
            str(numbers),
            "--markdown",
            str(document),
        )
        == 0
    )
    text = capsys.readouterr().out
    report = json.loads(numbers.read_text())
    rows = report["evaluations"][0]["rows"]
    assert [row["name"] for row in rows] == ["default", "BGK 0.5 m", "grid BHM, joint"]
    assert report["options"]["thin"] == 8
    assert "1 threads" in report["machine"]
    for row in rows:
        lines = [line for line in text.splitlines() if line.startswith(row["name"])]
        for metrics in (row["beams"]["metrics"], row["protocol_1"]["held_out"]):
            assert any(f"{metrics['auc']:.4f}" in line for line in lines)
            assert 0.5 < metrics["auc"] <= 1.0
        assert len(row["scan_ms"]) == 2
    assert rows[2]["cells"] == pytest.approx(rows[0]["cells"], rel=0.1)
    assert "label" in text  # the stages of ours
    assert f"| {rows[0]['beams']['metrics']['auc']:.4f} |" in document.read_text()


def test_held_out_beams_beyond_the_maps_reach_are_pointed_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--set", "mapping.max_range_m=9") == 0
    assert "look 9 m far" in capsys.readouterr().out
    assert run("--set", "mapping.max_range_m=9", "--max-range", "9") == 0
    assert "m far" not in capsys.readouterr().out


def test_tables_of_a_document_have_as_many_cells_as_heads() -> None:
    lines = to_markdown([evaluate("wall", Wall(), range(2), [Solid()], hold_out=HoldOut())]).splitlines()
    tables = [
        [line.count("|") for line in block]
        for is_table, block in itertools.groupby(lines, lambda line: line.startswith("|"))
        if is_table
    ]
    assert [len(table) for table in tables] == [3, 3, 3, 3, 3]  # cost, beams, near, rays, protocol 1
    assert [set(table) for table in tables] == [{7}, {11}, {9}, {4}, {8}]


def test_bundled_recordings_are_measured_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", "bundled:plan", "--scans", "1", "--thin", "4", "--threads", "1"]) == 0
    assert "bundled:plan: 1 scans" in capsys.readouterr().out
    assert cli.main(["eval", "bundled:plan", "--max-range", "5"]) == 2
    assert "take no reader options" in capsys.readouterr().err


@pytest.mark.parametrize("dataset", ["bundled:x", "/no/such/folder", "town:x"])
def test_a_recording_that_is_not_there_is_named_once(
    capsys: pytest.CaptureFixture[str], dataset: str
) -> None:
    assert cli.main(["eval", dataset]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.count(dataset) == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--peers", "voxels"], "no peer 'voxels'"),
        (["--peers", "bgk:x"], "not a number of metres"),
        (["--peers", "bgk:99"], "between 0.01 and 10 m"),
        (["--peers", "grid:1"], "no peer 'grid:1'"),
        (["--scans", "x"], "need a number, or START:STOP:STEP"),
        (["--hold-out", "1.5"], "hold-out fraction"),
        (["--json", "/no/such/folder/x.json"], "no folder"),
        (["--set", "mapping.nothing=1"], "mapping.nothing"),
        (["--min-range", "5", "--max-range", "2"], "ranges"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_two(
    capsys: pytest.CaptureFixture[str], flags: list[str], message: str
) -> None:
    assert cli.main(["eval", "generated", *flags]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("potserver: ")
    assert message in error
