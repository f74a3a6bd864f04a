"""Kernels as a client holds them: answers, files, messages; and the scores and the split that judge maps."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potclient.datasets import RecordedScan
from potclient.errors import BadReplyError, UsageError
from potclient.holdout import HoldOut, LabelledPoints
from potclient.kernels import KernelSet
from potclient.metrics import score
from potschemas import messages
from potschemas.answers import AnswerRule
from potschemas.wire import encode_array


def kernels(k: int = 50, seed: int = 0, *, offset_m: float = 0.0, revision: int = 3) -> KernelSet:
    rng = np.random.default_rng(seed)

    def f32(low: float, high: float, *shape: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        return rng.uniform(low, high, shape).astype(np.float32)

    return KernelSet(
        hinge_mean=rng.uniform(-5, 5, (k, 3)) + offset_m,
        hinge_var=f32(0.01, 0.1, k, 3),
        gamma_shape=f32(1, 3, k),
        gamma_rate=f32(1, 3, k),
        weight_mean=f32(-4, 4, k),
        weight_var=f32(0.1, 3, k),
        rule=AnswerRule(observed_activation=0.05, prior_var=40.0, residual_var=20.0, mean_moderation=0.25),
        map_revision=revision,
    )


def slow_answer(
    ks: KernelSet, x: np.ndarray[tuple[int, ...], np.dtype[np.float64]]
) -> tuple[float, float, float, float, bool]:
    """The contract's formulas for one point, kernel by kernel in Python floats."""
    mu = s2 = activation = 0.0
    for m in range(len(ks)):
        gamma = float(ks.gamma_shape[m]) / float(ks.gamma_rate[m])
        phi = math.exp(
            -gamma * sum((float(a) - float(b)) ** 2 for a, b in zip(x, ks.hinge_mean[m], strict=True))
        )
        mu += float(ks.weight_mean[m]) * phi
        s2 += float(ks.weight_var[m]) * phi * phi
        activation += max(0.0, 1.0 - float(ks.weight_var[m]) / ks.rule.prior_var) * phi
    s2 += ks.rule.residual_var * max(0.0, 1.0 - activation)
    observed = activation >= ks.rule.observed_activation
    if not observed:
        mu, s2 = 0.0, ks.rule.prior_var
    scale = 1.0 / math.sqrt(1.0 + math.pi * s2 / 8.0)
    mean = 1.0 / (1.0 + math.exp(-mu / math.sqrt(1.0 + ks.rule.mean_moderation * math.pi * s2 / 8.0)))
    return mean, mean * (1.0 - mean) * (1.0 - scale), mu, s2, observed


@pytest.mark.parametrize("offset_m", [0.0, 5e5])
def test_occupancy_is_the_contract_formula(offset_m: float) -> None:
    ks = kernels(offset_m=offset_m)
    points = np.random.default_rng(1).uniform(-8, 8, (40, 3)) + offset_m
    answer = ks.occupancy(points)
    expected = [slow_answer(ks, p) for p in points]
    for i, name in enumerate(("mean", "var", "latent_mean", "latent_var")):
        np.testing.assert_allclose(getattr(answer, name), [e[i] for e in expected], rtol=1e-5, atol=1e-6)
    assert answer.observed.tolist() == [e[4] for e in expected]
    assert answer.revision == 3


def test_far_from_all_kernels_is_unknown_and_not_free() -> None:
    ks = kernels()
    answer = ks.occupancy([[1000.0, 0.0, 0.0]])
    scale = 1 / math.sqrt(1 + math.pi * ks.rule.prior_var / 8)
    assert not answer.observed[0]
    assert answer.mean[0] == 0.5
    assert answer.latent_mean[0] == 0.0
    assert answer.latent_var[0] == ks.rule.prior_var
    assert answer.var[0] == pytest.approx(0.25 * (1 - scale))


def test_no_kernels_answer_unknown_and_no_points_answer_nothing() -> None:
    empty = kernels(0)
    assert not empty.occupancy(np.zeros((3, 3))).observed.any()
    assert len(kernels().occupancy(np.zeros((0, 3)))) == 0


@pytest.mark.parametrize(("leaf", "block"), [(1, 1), (5, 7), (1000, 7)])
def test_blocks_and_neighbourhoods_do_not_change_the_answer(
    monkeypatch: pytest.MonkeyPatch, leaf: int, block: int
) -> None:
    rng = np.random.default_rng(2)
    ks = KernelSet.concatenate([kernels(), kernels(seed=1, offset_m=200.0)])
    points = np.concatenate(
        [rng.uniform(-6, 6, (33, 3)), rng.uniform(195, 205, (20, 3)), rng.normal(size=(9, 3)) * 500]
    )
    expected = [slow_answer(ks, p) for p in points]
    monkeypatch.setattr("potclient.kernels._BLOCK_ELEMENTS", block)
    monkeypatch.setattr("potclient.kernels._LEAF_POINTS", leaf)
    answer = ks.occupancy(points)
    for i, name in enumerate(("mean", "var", "latent_mean", "latent_var", "observed")):
        np.testing.assert_allclose(getattr(answer, name), [e[i] for e in expected], rtol=1e-5, atol=1e-6)


def test_two_columns_mean_z_is_zero() -> None:
    ks = kernels()
    np.testing.assert_array_equal(ks.occupancy([[1.0, 2.0]]).mean, ks.occupancy([[1.0, 2.0, 0.0]]).mean)


@given(seed=st.integers(0, 2**31), scale=st.floats(0.0, 100.0))
def test_answers_stay_in_their_bounds(seed: int, scale: float) -> None:
    answer = kernels(20, seed).occupancy(np.random.default_rng(seed).normal(size=(10, 3)) * scale)
    assert ((answer.mean >= 0) & (answer.mean <= 1)).all()
    assert ((answer.var >= 0) & (answer.var <= 0.25)).all()
    assert (answer.latent_var >= 0).all()


@pytest.mark.parametrize("points", [np.zeros((2, 4)), [[0, 0, math.nan]], "abc", np.zeros((1, 2, 3))])
def test_points_that_are_none_are_refused(points: object) -> None:
    with pytest.raises(UsageError, match="points"):
        kernels().occupancy(points)  # type: ignore[arg-type]


def test_a_set_whose_arrays_disagree_is_refused() -> None:
    with pytest.raises(UsageError, match="weight_mean"):
        KernelSet(
            **{
                **{
                    f: getattr(kernels(), f)
                    for f in ("hinge_mean", "hinge_var", "gamma_shape", "gamma_rate", "weight_var")
                },
                "weight_mean": np.zeros(3, np.float32),
                "rule": AnswerRule(0.1, 1.0, 1.0),
            }
        )


def test_saved_kernels_come_back(tmp_path: Path) -> None:
    ks = kernels(offset_m=4e5)
    ks.save(tmp_path / "k.npz")
    back = KernelSet.load(tmp_path / "k.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["k.npz"], "nothing half-written stays behind"
    for name in ("hinge_mean", "hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(getattr(back, name), getattr(ks, name))
        assert getattr(back, name).dtype == getattr(ks, name).dtype
    assert (back.rule, back.map_revision) == (ks.rule, 3)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 truncated", b"hello"])
def test_files_that_are_no_kernels_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "k.npz").write_bytes(content)
    with pytest.raises(UsageError, match=r"k\.npz"):
        KernelSet.load(tmp_path / "k.npz")
    with pytest.raises(UsageError, match="absent"):
        KernelSet.load(tmp_path / "absent")


def test_a_message_keeps_precision_far_from_the_origin() -> None:
    ks = kernels(offset_m=5e6)
    back = KernelSet.from_message(ks.to_message(), map_revision=3)
    np.testing.assert_allclose(back.hinge_mean, ks.hinge_mean, atol=1e-5)
    np.testing.assert_array_equal(back.weight_var, ks.weight_var)
    assert len(KernelSet.from_message(kernels(0).to_message())) == 0


def test_a_message_with_arrays_that_disagree_is_a_bad_reply() -> None:
    message = msgspec.structs.replace(kernels().to_message(), weight_var=encode_array(np.ones(3, np.float32)))
    assert isinstance(message, messages.Kernels)
    with pytest.raises(BadReplyError, match="weight_var"):
        KernelSet.from_message(message)


def test_a_message_with_a_rule_that_is_none_is_a_bad_reply() -> None:
    message = msgspec.structs.replace(kernels().to_message(), prior_var=-1.0)
    with pytest.raises(BadReplyError, match="prior_var"):
        KernelSet.from_message(message)


@pytest.mark.parametrize(("missing", "value"), [("mean_moderation", 1.0), ("full_activation", 0.0)])
def test_early_files_lack_numbers_of_the_rule(tmp_path: Path, missing: str, value: float) -> None:
    ks = kernels()
    ks = dataclasses.replace(ks, rule=dataclasses.replace(ks.rule, full_activation=3.0))
    ks.save(tmp_path / "k.npz")
    with np.load(tmp_path / "k.npz") as stored:
        arrays = {name: stored[name] for name in stored if name != missing}
    np.savez(tmp_path / "early.npz", **arrays)
    early = KernelSet.load(tmp_path / "early.npz")
    assert early.rule == dataclasses.replace(ks.rule, **{missing: value})
    del arrays["prior_var"]
    np.savez(tmp_path / "none.npz", **arrays)
    with pytest.raises(UsageError, match="prior_var"):
        KernelSet.load(tmp_path / "none.npz")


def test_sets_of_one_map_join_and_sets_of_two_do_not() -> None:
    ks = kernels()
    halves = [ks.take(slice(0, 20)), ks.take(slice(20, None))]
    np.testing.assert_array_equal(KernelSet.concatenate(halves).hinge_mean, ks.hinge_mean)
    with pytest.raises(UsageError, match="different maps or revisions"):
        KernelSet.concatenate([ks, kernels(revision=4)])


# --- metrics -------------------------------------------------------------------------------------------------------


def test_scores_of_a_worked_example() -> None:
    m = score([0.9, 0.8, 0.3, 0.6], [True, True, False, False])
    assert m.accuracy == 0.75
    assert m.auc == 1.0
    assert m.nll == pytest.approx(-(math.log(0.9) + math.log(0.8) + math.log(0.7) + math.log(0.4)) / 4)
    assert m.brier == pytest.approx((0.01 + 0.04 + 0.09 + 0.36) / 4)
    assert m.ece == pytest.approx((0.1 + 0.2 + 0.3 + 0.6) / 4), "each in a bin of its own"
    assert m.share_unknown == 0.0


def test_unknown_counts_as_one_half_whatever_it_says() -> None:
    m = score([0.0, 1.0], [True, False], [False, False])
    assert m.nll == pytest.approx(math.log(2))
    assert m.auc == 0.5
    assert m.accuracy == 0.5, "a tie counts as occupied"
    assert m.share_unknown == 1.0


def test_certain_and_wrong_costs_the_clip_and_no_more() -> None:
    assert score([0.0], [True]).nll == pytest.approx(-math.log(1e-6))
    assert math.isnan(score([0.3], [True]).auc)


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=2, max_size=40))
def test_auc_is_the_share_of_pairs_in_the_right_order(data: list[tuple[float, bool]]) -> None:
    p, y = zip(*data, strict=True)
    positive, negative = [a for a, b in data if b], [a for a, b in data if not b]
    if positive and negative:
        pairs = [(a > b) + 0.5 * (a == b) for a in positive for b in negative]
        assert score(p, y).auc == pytest.approx(sum(pairs) / len(pairs))


@pytest.mark.parametrize(
    ("p", "y"), [([], []), ([0.1], [True, False]), ([1.5], [True]), ([math.nan], [True])]
)
def test_scores_of_nonsense_are_refused(p: list[float], y: list[bool]) -> None:
    with pytest.raises(UsageError):
        score(p, y)


# --- held-out beams ------------------------------------------------------------------------------------------------


def scan(n: int = 1000) -> RecordedScan:
    rng = np.random.default_rng(5)
    pose = np.eye(4)
    pose[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = [10, 20, 30]
    return RecordedScan(
        points=rng.normal(size=(n, 3)).astype(np.float32) * 3,
        is_return=rng.random(n) < 0.8,
        T_map_sensor=pose,
        stamp_ns=1,
        name="made",
    )


def test_held_out_beams_are_not_in_the_training_scan() -> None:
    whole = scan()
    training, labels = HoldOut(0.2, seed=3).split(whole)
    rest = {tuple(p) for p in whole.points} - {tuple(p) for p in training.points}
    assert len(rest) + len(training) == len(whole)
    assert 0.1 < len(rest) / len(whole) < 0.3
    held_returns = [p for p, r in zip(whole.points, whole.is_return, strict=True) if r and tuple(p) in rest]
    assert int(labels.occupied.sum()) == len(held_returns), "a beam without an echo has no occupied end"


def test_free_points_lie_on_their_beam_and_half_a_metre_before_its_end() -> None:
    whole = scan()
    _, labels = HoldOut(0.5, seed=3).split(whole)
    back = (labels.points[~labels.occupied] - whole.T_map_sensor[:3, 3]) @ whole.T_map_sensor[:3, :3]
    ends = whole.points.astype(np.float64)
    range_m = np.linalg.norm(ends, axis=1)
    free_m = np.linalg.norm(back, axis=1)
    along = (back / free_m[:, None]) @ (ends / range_m[:, None]).T
    beam = along.argmax(axis=1)
    assert along.max(axis=1).min() > 1 - 1e-9
    assert (free_m <= range_m[beam] - 0.5 + 1e-9).all()


def test_the_split_depends_on_the_seed_alone() -> None:
    a, b, c = (HoldOut(0.2, seed=s).split(scan())[1] for s in (1, 1, 2))
    np.testing.assert_array_equal(a.points, b.points)
    assert len(a) != len(c) or not np.array_equal(a.points, c.points)
    assert len(LabelledPoints.concatenate([])) == 0


def test_what_is_held_out_of_a_scan_depends_on_its_number_alone() -> None:
    in_turn = HoldOut(0.2, seed=1)
    scans = [scan(), scan(), scan()]
    splits = [in_turn.split(s)[1].points for s in scans]
    alone = HoldOut(0.2, seed=1).split(scans[2], 2)[1].points
    np.testing.assert_array_equal(splits[2], alone)
    assert not np.array_equal(splits[0], alone)


@pytest.mark.parametrize("fraction", [0.0, 1.0, -1.0, math.nan])
def test_a_fraction_that_is_none_is_refused(fraction: float) -> None:
    with pytest.raises(UsageError, match="fraction"):
        HoldOut(fraction)
