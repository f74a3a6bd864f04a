"""From a recipe to a dictionary: what one scan gives, what is refused and why, and what the atoms say about themselves."""

from __future__ import annotations

import argparse
import functools
import json
import os
import pickle
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient.datasets import open_dataset
from potclient.holdout import HoldOut
from potclient.metrics import score
from potschemas import __version__
from potserver import cli
from potserver.atoms import learning
from potserver.atoms.build import scan_task
from potserver.atoms.build.builder import COVERED, OVER_LIMIT, Built, build, expectation_of, scan_tasks
from potserver.atoms.build.engines import in_order, processes, ray_cluster
from potserver.atoms.build.recipe import Recipe, parse_recipe
from potserver.atoms.build.scan_task import NOT_JUDGED, Progress, ScanResult, ScanTask, learn_scan
from potserver.commands.atoms_build import recipe_of
from potserver.domain.kernel_map import KernelMap
from potserver.errors import DictionaryError, SolverError
from potserver.numerics.geometry import in_sector, rotation_z, yaw_of
from potserver.numerics.ground import ground_of
from potserver.numerics.surroundings import Surroundings
from potserver.recordings import Reader, open_recording, to_scan

FAST = {"max_kernels": 40, "max_epochs": 3, "max_range_m": 10.0, "max_labelled": 300, "min_hits": 20}
PLAN = {"dataset": "bundled:plan", "scans": 3, "licence": "MIT", "learner": FAST}


class Serial:
    """An engine without processes."""

    def map(self, function: Callable[[Any], Any], tasks: Iterable[Any]) -> Iterator[Any]:
        return map(function, tasks)


def recipe(*recordings: dict[str, Any], **changes: Any) -> Recipe:
    return parse_recipe({"recordings": list(recordings) or [PLAN], **changes}, "test")


def run(made: Recipe, **options: Any) -> Built:
    return build(made, scan_tasks(made, Path.cwd()), Serial(), **options)


@functools.cache
def plan() -> Built:
    return run(recipe(tolerance_m=0.5))


@functools.cache
def first_scan() -> ScanResult:
    return learn_scan(scan_tasks(recipe(seed=5), Path.cwd())[0])


def test_a_dictionary_learns_what_to_expect_of_its_recordings_in_3d() -> None:
    street = {"dataset": "town:suburb:vlp16:40m:3", "scans": "0:1", "licence": "MIT", "learner": FAST}
    made = recipe(PLAN, street)
    net = expectation_of(made, scan_tasks(made, Path.cwd()))
    assert net is not None
    assert net.is_sound
    scan = to_scan(open_recording("town:suburb:vlp16:40m:4", Reader(max_range_m=20.0))[3], 0)
    view = Surroundings.of(scan.beams, ground_of(scan.beams.ends[scan.is_return]))
    ends = scan.beams.ends[scan.is_return]
    assert view.expected(ends, net).mean() > 1.0 > -1.0 > view.expected(0.5 * ends, net).mean()
    assert plan().dictionary.expectation is None


def test_further_towns_teach_what_to_expect_and_give_no_atoms() -> None:
    street = {"dataset": "town:suburb:vlp16:40m:3", "scans": "0:1", "licence": "MIT", "learner": FAST}
    with_it = {"expect_too": ["town:terraces:vlp16:30m:6"]}
    tasks, more = (scan_tasks(recipe(street, **also), Path.cwd()) for also in ({}, with_it))
    assert more == tasks
    alone, net = (expectation_of(recipe(street, **also), tasks) for also in ({}, with_it))
    assert alone is not None
    assert net is not None
    assert not np.array_equal(alone.first, net.first)
    flat = recipe(PLAN | {"dims": 2}, **with_it)
    assert expectation_of(flat, scan_tasks(flat, Path.cwd())) is None
    with pytest.raises(DictionaryError, match="nowhere"):
        scan_tasks(recipe(street, expect_too=["town:nowhere"]), Path.cwd())


# --- one scan -----------------------------------------------------------------------------------------------


def test_a_task_travels_and_its_result_depends_on_it_alone() -> None:
    task = first_scan().task
    again: ScanResult = pickle.loads(pickle.dumps(learn_scan(pickle.loads(pickle.dumps(task)))))
    assert again.task == task
    assert again.candidates
    for one, other in zip(first_scan().candidates, again.candidates, strict=True):
        assert one.atom.provenance == other.atom.provenance
        assert (one.scores, one.later) == (other.scores, other.later)
        np.testing.assert_array_equal(one.atom.kernels.weight_mean, other.atom.kernels.weight_mean)
        np.testing.assert_array_equal(one.atom.free_points, other.atom.free_points)


def test_atoms_say_where_they_are_from_and_how_good_they_are() -> None:
    task = first_scan().task
    for atom, scores, later, content in first_scan().candidates:
        noted = atom.provenance
        assert (noted["source"], noted["licence"], noted["version"]) == ("bundled:plan", "MIT", __version__)
        assert (noted["scan_number"], noted["seed"]) == ("0", "5")
        assert atom.atom_id == f"plan-0-s{noted['sector']}"
        assert json.loads(noted["settings"]) | FAST == json.loads(noted["settings"])
        assert json.loads(noted["reader"])["max_range_m"] is None
        for key, value in (
            ("acc", scores.accuracy),
            ("auc", scores.auc),
            ("nll", scores.nll),
            ("ece", scores.ece),
        ):
            assert float(noted[f"held_out_{key}"]) == pytest.approx(value, abs=1e-4)
        assert int(noted["held_out_n"]) == scores.n >= task.quality.min_points
        assert int(noted["content_nats"]) == round(content)
        assert len(task.later) == 2
        if later is None:
            assert noted["later_scans"] == "0"
            assert "later_auc" not in noted
        else:
            assert 1 <= int(noted["later_scans"]) <= 2
            assert float(noted["later_auc"]) == pytest.approx(later.auc, abs=1e-4)
        assert all(isinstance(value, str) for value in noted.values())
    assert any(candidate.later for candidate in first_scan().candidates)


def test_scores_are_those_of_held_out_beams_in_the_sector() -> None:
    from potserver import bundled

    recorded = bundled.open_bundled("plan")[0]
    _, held_out = HoldOut().split(recorded)
    for atom, scores, _, content in first_scan().candidates:
        width = atom.azimuth_width_rad
        turn = rotation_z(yaw_of(recorded.T_map_sensor) + int(atom.provenance["sector"]) * width)
        local = (held_out.points - recorded.T_map_sensor[:3, 3]) @ turn
        inside = in_sector(local, -width / 2, width / 2, atom.radius_m)
        k = atom.kernels
        answer = KernelMap.from_arrays(k.hinge_mean, k.gamma, k.weight_mean, np.zeros(len(k))).occupancy(
            local[inside]
        )
        truth = held_out.occupied[inside]
        assert scores == score(answer.mean, truth, answer.observed)
        constant = score(np.full(len(truth), truth.mean()), truth)
        assert content == pytest.approx(len(truth) * (constant.nll - scores.nll))


def test_no_atom_holds_a_held_out_hit() -> None:
    """Whatever came before: a dictionary from every tenth scan leaves out what publishing all of them holds out."""
    recording = open_dataset("generated:2d:3")
    in_turn = [labels for _, labels in map(HoldOut().split, recording[:3])]
    made = recipe(
        {"dataset": "generated:2d:3", "scans": "2:3", "learner": FAST | {"max_range_m": 25.0}},
        quality={"min_auc": 0.0, "max_nll": 9.0},
    )
    result = learn_scan(scan_tasks(made, Path.cwd())[0])
    assert result.candidates
    recorded, held = recording[2], in_turn[2].points[in_turn[2].occupied]
    for atom, *_ in result.candidates:
        bearing = yaw_of(recorded.T_map_sensor) + int(atom.provenance["sector"]) * atom.azimuth_width_rad
        hits = atom.hit_points @ rotation_z(bearing).T + recorded.T_map_sensor[:3, 3]
        assert np.linalg.norm(hits[:, None] - held, axis=2).min() > 1e-4


@pytest.mark.parametrize(
    ("quality", "reason"),
    [
        ({"min_points": 10_000}, NOT_JUDGED),
        ({"min_auc": 1.0, "max_nll": 9.0}, "AUC below 1"),
        ({"max_nll": 0.0, "min_auc": 0.0}, "NLL above 0"),
    ],
)
def test_atoms_that_are_not_good_enough_are_refused_with_a_reason(
    quality: dict[str, float], reason: str
) -> None:
    result = learn_scan(scan_tasks(recipe(quality=quality), Path.cwd())[0])
    assert reason in result.refused.values()
    assert not {c.atom.atom_id for c in result.candidates} & set(result.refused)
    assert len(result.candidates) + len(result.refused) + result.n_without_hits == 6
    assert result.failure is None


def test_a_scan_that_fails_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    wrong = learn_scan(scan_tasks(recipe(PLAN | {"dims": 3}), Path.cwd())[0])
    assert wrong.candidates == []
    assert "2 dimensions, where the recipe says 3" in (wrong.failure or "")

    def no_result(*_: Any, **__: Any) -> None:
        raise SolverError("did not converge")

    monkeypatch.setattr(scan_task, "learn_atoms", no_result)
    assert learn_scan(first_scan().task).failure == "did not converge"


def test_a_sector_that_diverges_is_refused_and_the_others_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    learn_kernels = learning.learn_kernels
    calls: list[int] = []

    def first_diverges(*arguments: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == 1:
            raise SolverError("diverged")
        return learn_kernels(*arguments, **options)

    whole = first_scan()
    monkeypatch.setattr(learning, "learn_kernels", first_diverges)
    result = learn_scan(whole.task)
    assert "diverged" in result.refused.values()
    assert result.n_without_hits == whole.n_without_hits
    assert len(result.candidates) + len(result.refused) == len(whole.candidates) + len(whole.refused)
    assert result.failure is None


def test_a_window_of_scans_is_learned_together() -> None:
    made_up = {"dataset": "generated:2d:3", "scans": 1, "learner": FAST | {"max_range_m": 25.0}}
    alone, together = (
        learn_scan(scan_tasks(recipe(made_up | {"window": window}), Path.cwd())[0]).candidates[0]
        for window in (1, 3)
    )
    assert (alone.atom.provenance["scans"], together.atom.provenance["scans"]) == ("1", "3")
    assert together.scores.n > alone.scores.n, "judged on the held-out beams of all of them"


def test_scores_are_shown_while_a_sector_is_learned() -> None:
    shown: list[Progress] = []
    result = learn_scan(first_scan().task, shown.append)
    candidate = result.candidates[0]
    own = [at for at in shown if at.sector == int(candidate.atom.provenance["sector"])]
    assert [at.epoch for at in own] == list(range(len(own)))
    assert int(candidate.atom.provenance["learner_epochs"]) == len(own) - 1
    scores = own[-1].scores
    assert scores is not None
    # up to the float32 in which gammas are kept
    assert scores.nll == pytest.approx(candidate.scores.nll, rel=1e-3)
    assert scores.n == candidate.scores.n


# --- a dictionary -------------------------------------------------------------------------------------------


def test_a_dictionary_of_what_covers_the_candidates() -> None:
    built = plan()
    (report,) = built.reports
    assert report.n_candidates == len(report.kept) + report.refused.total()
    assert report.refused[COVERED] > 0
    assert [atom.atom_id for atom in built.dictionary] == [c.atom.atom_id for c in report.kept]
    covered = sum(int(atom.provenance["covers"]) for atom in built.dictionary)
    assert covered == len(report.kept) + report.refused[COVERED]
    assert {atom.provenance["tolerance_m"] for atom in built.dictionary} == {"0.5"}


def test_limits_of_the_recipe_and_of_a_recording() -> None:
    others = PLAN | {"name": "others", "scans": "3:6"}
    one, rest = run(recipe(PLAN | {"max_atoms": 1}, others, tolerance_m=0.0)).reports
    assert len(one.kept) == 1
    assert one.refused[OVER_LIMIT] > 0
    assert (len(rest.kept) > 1, rest.refused[OVER_LIMIT]) == (True, 0)
    assert len(run(recipe(PLAN, others, tolerance_m=0.0, max_atoms=3)).dictionary) == 3


def test_every_scan_is_shown_in_order_and_every_choice() -> None:
    shown: list[int] = []
    chosen: list[tuple[int, int, int]] = []
    built = run(
        recipe(tolerance_m=0.5),
        on_scan=lambda result: shown.append(result.task.number),
        on_chosen=lambda *numbers: chosen.append(numbers),
    )
    assert shown == [0, 1, 2]
    assert [n for _, n, _ in chosen] == list(range(1, len(built.dictionary) + 1))
    assert {dims for dims, _, _ in chosen} == {2}


def _folder_with_a_damaged_scan(tmp_path: Path) -> dict[str, Any]:
    folder = tmp_path / "velodyne"
    folder.mkdir()
    for i in range(3):
        beams = open_dataset("generated:3")[i].points
        np.concatenate([beams, np.zeros((len(beams), 1), np.float32)], axis=1).tofile(folder / f"{i:06d}.bin")
    (folder / "000001.bin").write_bytes(b"damaged")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    return {"dataset": str(tmp_path), "learner": FAST}


def test_a_scan_that_cannot_be_read_is_counted(tmp_path: Path) -> None:
    made = recipe(_folder_with_a_damaged_scan(tmp_path), quality={"min_auc": 0.0, "max_nll": 9.0})
    (report,) = run(made).reports
    assert (report.n_scans, report.n_failed) == (3, 1)
    assert {candidate.atom.provenance["scan_number"] for candidate in report.kept} <= {"0", "2"}
    with pytest.raises(DictionaryError, match="scan 1: "):
        run(made, strict=True)


def test_nothing_left_is_an_error_that_says_why() -> None:
    with pytest.raises(DictionaryError, match=r"refused \(NLL above 0\)"):
        run(recipe(quality={"max_nll": 0.0, "min_auc": 0.0}))
    with pytest.raises(DictionaryError, match="3 scans failed, the first: plan, scan 0: "):
        run(recipe(PLAN | {"dims": 3}))


def test_recordings_that_are_not_there(tmp_path: Path) -> None:
    for recording, message in (
        ({"dataset": "none"}, "no such file"),
        ({"dataset": "bundled:plan", "scans": "99:"}, "no scans in 99:"),
    ):
        with pytest.raises(DictionaryError, match=message):
            scan_tasks(recipe(recording), tmp_path)


# --- the command --------------------------------------------------------------------------------------------


def _flags(*datasets: str, **changes: Any) -> argparse.Namespace:
    stated = {
        "out": "x.atoms", "recipe": None, "builtin": False, "strict": False, "workers": None, "ray": None,
        "scans": None, "tolerance": None, "max_atoms": None, "licence": None, "learner": [],
    }  # fmt: skip
    return argparse.Namespace(datasets=list(datasets), **stated | changes)


def test_flags_spell_out_a_recipe() -> None:
    made, folder = recipe_of(
        _flags("a/b", "c/d", scans="4", tolerance=1.5, max_atoms=7, licence="MIT", learner=["n_sectors=8"])
    )
    assert folder == Path.cwd()
    assert (made.tolerance_m, made.max_atoms) == (1.5, 7)
    assert [(r.dataset, r.numbers(9), r.licence) for r in made.recordings] == [
        ("a/b", range(4), "MIT"),
        ("c/d", range(4), "MIT"),
    ]
    assert made.learner_of(made.recordings[0]).n_sectors == 8


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "name recordings"),
        (["a/b", "--builtin"], "not two of them"),
        (["--builtin", "--recipe", "r.toml"], "not two of them"),
        (["--builtin", "--tolerance", "1"], "tolerance_m: stated by the recipe"),
        (["a/b", "--learner", "n_sectors"], "need KEY=VALUE"),
        (["bundled:plan", "--workers", "0"], "--workers 0"),
        (["bundled:plan", "--watch", "--workers", "2"], "in this process alone"),
        (["bundled:plan", "-o", "/no/such/folder/x.atoms"], "no folder"),
    ],
)
def test_wrong_flags(flags: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["atoms", "build", "-o", "x.atoms", *flags]) == 2
    assert message in capsys.readouterr().err


# --- engines ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ahead", [1, 3, 99])
def test_results_come_in_order_and_few_are_held(ahead: int) -> None:
    held = most = 0

    def submit(task: int) -> int:
        nonlocal held, most
        held += 1
        most = max(most, held)
        return task

    def result_of(handle: int) -> int:
        nonlocal held
        held -= 1
        return handle * 10

    assert list(in_order(submit, result_of, range(7), ahead)) == [10 * i for i in range(7)]
    assert most == min(ahead, 7)


def test_processes_give_results_in_order_with_one_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with processes(2) as engine:
        assert list(engine.map(os.getenv, ["OMP_NUM_THREADS"])) == ["1"]
        assert list(engine.map(abs, range(-9, 0))) == list(range(9, 0, -1))
        with pytest.raises(ZeroDivisionError):
            list(engine.map((1).__truediv__, [1, 0]))
    assert os.environ["OMP_NUM_THREADS"] == "7"


def test_a_worker_that_dies_is_an_error() -> None:
    with pytest.raises(DictionaryError, match="a worker process died"), processes(1) as engine:
        list(engine.map(os._exit, [3]))


def test_ray_that_is_not_installed_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(DictionaryError, match=r"pip install 'potserver\[ray\]'"), ray_cluster("local", 1):
        pass


def test_a_task_is_small() -> None:
    task: ScanTask = first_scan().task
    assert len(pickle.dumps(task)) < 5_000
