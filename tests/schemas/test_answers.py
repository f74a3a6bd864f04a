"""Answers from sums: bounds, limits, gradients, the rule in messages. Quadrature: tests/conformance/test_eq1_occupancy.py."""

from __future__ import annotations

import dataclasses
import math
import re
import subprocess
import sys
from pathlib import Path
from types import CodeType, SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from potschemas import messages
from potschemas.answers import (
    FREE_FROM,
    OCCUPIED_FROM,
    ROOM,
    ROOM_IN_SOLID,
    RULE_FIELDS,
    SURE,
    AnswerRule,
    LatentGradients,
    LatentSums,
    answer,
    gradients,
    occupancy_mean,
    occupancy_var,
    sigmoid,
)
from potschemas.examples import examples
from potschemas.lean import LeanAt
from potserver.mapping.pipeline import DEFAULT_RULE
from potserver.numerics import rays

Array = np.ndarray[Any, Any]

MEAN, VAR = np.meshgrid(np.linspace(-60, 60, 121), np.concatenate([[0.0], np.logspace(-6, 8, 60)]))
RULES = [
    AnswerRule(),
    DEFAULT_RULE,
    AnswerRule(0.3, 7.0, 20.0, 0.25),
    AnswerRule(0.0, 50.0, 2.0, 0.0),
    AnswerRule(0.4, 80.0, 20.0, 0.1, 1.5),
]


def both(mean: Array, var: Array, moderation: float = 1.0) -> tuple[Array, Array]:
    p = occupancy_mean(mean, var, moderation)
    return p, occupancy_var(p, var)


def sums_of(n: int, seed: int, dtype: type = np.float64) -> LatentSums:
    rng = np.random.default_rng(seed)
    return LatentSums(
        rng.normal(0.0, 4.0, n).astype(dtype),
        (10.0 ** rng.uniform(-3, 3, n)).astype(dtype),
        rng.uniform(0.0, 2.0, n).astype(dtype),
    )


# --- the probability ------------------------------------------------------------------------------------------------


def test_ranges() -> None:
    mean, var = both(MEAN, VAR)
    assert ((mean >= 0) & (mean <= 1)).all()
    assert ((var >= 0) & (var <= 0.25)).all()
    assert (var <= mean * (1 - mean) + 1e-15).all()


def test_no_variance_is_the_plain_sigmoid() -> None:
    mean, var = both(np.array([-2.0, 0.0, 3.0]), np.zeros(3))
    np.testing.assert_allclose(mean, 1 / (1 + np.exp([2.0, 0.0, -3.0])))
    np.testing.assert_array_equal(var, 0.0)


def test_symmetric_in_the_sign_of_the_latent() -> None:
    one, other = both(MEAN, VAR), both(-MEAN, VAR)
    np.testing.assert_allclose(one[0], 1 - other[0], atol=1e-12)
    np.testing.assert_allclose(one[1], other[1], atol=1e-12)


def test_more_variance_pulls_the_mean_towards_one_half() -> None:
    mean = occupancy_mean(MEAN, VAR)
    assert (np.diff(np.abs(mean - 0.5), axis=0) <= 1e-12).all()
    assert np.abs(occupancy_mean(np.array([10.0]), np.array([1e12])) - 0.5) < 1e-4


def test_the_moderation_scales_the_variance_for_the_mean_alone() -> None:
    np.testing.assert_allclose(occupancy_mean(MEAN, VAR, 0.25), occupancy_mean(MEAN, 0.25 * VAR))
    np.testing.assert_allclose(occupancy_mean(MEAN, VAR, 0.0), sigmoid(MEAN))
    mean, var = MEAN[:, 50:71], VAR[:, 50:71]  # elsewhere p rounds to 0 or 1
    part, full = both(mean, var, 0.25), both(mean, var)
    np.testing.assert_allclose(
        part[1] / (part[0] * (1 - part[0])), full[1] / (full[0] * (1 - full[0])), atol=1e-9
    )


def test_all_uncertain_is_the_variance_of_a_coin() -> None:
    assert both(np.zeros(1), np.array([1e12]))[1][0] == pytest.approx(0.25, abs=1e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_sigmoid_never_overflows_and_keeps_its_dtype(dtype: type) -> None:
    x = np.array([-np.inf, -1e4, -90.0, 0.0, 90.0, 1e4, np.inf], dtype)
    s = sigmoid(x)
    assert s.dtype == dtype
    np.testing.assert_allclose(s, [0, 0, 0, 0.5, 1, 1, 1], atol=1e-30)
    assert (np.diff(s) >= 0).all()
    assert sigmoid(np.array([-80.0], dtype))[0] > 0


# --- sums and rule ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", RULES)
def test_an_answer_is_the_rule_point_by_point(rule: AnswerRule) -> None:
    sums = sums_of(300, 0)
    got = answer(sums, rule)
    for i, (f, v, a) in enumerate(zip(*sums, strict=True)):
        known = a >= rule.observed_activation
        mu, s2 = (f, v + rule.residual_var * max(0.0, 1.0 - a)) if known else (0.0, rule.prior_var)
        spread = math.sqrt(1 + rule.mean_moderation * math.pi * s2 / 8)
        if known and rule.full_activation:
            density = a / rule.full_activation
            mu = min(mu, spread * (2.15 + 7 * max(0, density - 0.66)))
        mean = 1 / (1 + math.exp(-mu / spread))
        var = mean * (1 - mean) * (1 if rule.full_activation else 1 - 1 / math.sqrt(1 + math.pi * s2 / 8))
        if known and rule.full_activation:
            less = 3.1 - 0.017 * s2 + 2.5 * min(max(density - 1, 0), 1)
            true = 0.00005 + 0.9999 / (1 + math.exp(less - 0.86 * mu / spread))
            var = min(true * (1 - mean) ** 2 + (1 - true) * mean**2, 0.25)
        np.testing.assert_allclose([column[i] for column in got], [mean, var, mu, s2, known, 0], rtol=1e-12)


def test_float32_sums_keep_float32_latents_and_get_float64_probabilities() -> None:
    rule = AnswerRule(np.float64(0.05), np.float64(50), residual_var=20, mean_moderation=1)
    got = answer(sums_of(50, 1, np.float32), rule)
    assert got.latent_mean.dtype == got.latent_var.dtype == np.float32
    assert got.mean.dtype == got.var.dtype == np.float64
    assert {type(value) for value in rule.fields().values()} == {float}


def test_a_lean_answers_where_nothing_was_seen_and_yields_where_all_was() -> None:
    rule = DEFAULT_RULE
    sums = LatentSums(np.full(4, -5.0), np.full(4, 9.0), np.array([0.0, 1.0, 2.4, 3.4]))
    lean = np.full(4, 2.0)
    got, own = answer(sums, rule, lean), answer(sums, rule, lean, evidence_only=True)
    np.testing.assert_allclose(got.borrowed, [1.0, 1.0, 0.5, 0.0], atol=1e-12)
    np.testing.assert_allclose(got.mean[:2], sigmoid(lean)[:2])
    k = 1 / np.sqrt(1 + rule.mean_moderation * math.pi / 8 * 9.0)
    np.testing.assert_allclose(got.mean[2:], sigmoid(np.array([2.0 - 0.5 * k * 5.0, 2.0 - k * 5.0])))
    np.testing.assert_allclose(own.mean, [0.5, 0.5, got.mean[3], got.mean[3]])
    # what is not expected to be solid is free as soon as it is seen to be
    assert not answer(sums, rule, -lean).borrowed[2:].any()
    assert not own.borrowed.any()
    for other in (own, answer(sums, rule)):
        np.testing.assert_array_equal(got.observed, other.observed)
        np.testing.assert_array_equal(got.latent_var, other.latent_var)


@pytest.mark.parametrize("lean", [None, np.linspace(-8.0, 8.0, 161)])
def test_what_is_observed_is_only_as_sure_as_evidence_is_dense(lean: Array | None) -> None:
    rule, n = dataclasses.replace(DEFAULT_RULE, mean_moderation=0.0), 161
    ends = []
    for density in (0.45, FREE_FROM, OCCUPIED_FROM, 0.8, 1.0):
        activation = np.full(n, density * rule.full_activation)
        sums = [LatentSums(np.full(n, f), np.full(n, 1.0), activation) for f in (-999.0, 999.0)]
        ends.append([answer(both_ways, rule, lean).latent_mean for both_ways in sums])
    low, high = np.array(ends)[:, 0], np.array(ends)[:, 1]
    np.testing.assert_allclose(high[:3], SURE)
    assert (np.diff(high[2:], axis=0) > 0.5).all()
    if lean is None:  # free space without a lean ends nowhere
        assert (low < -10).all()
    else:  # but that which is expected to be free is, even where little was seen
        np.testing.assert_allclose(low[:2], np.minimum(lean, -SURE) + np.zeros((2, 1)))
        assert (np.diff(low[1:], axis=0) <= 0.0).all()
    unobserved = LatentSums(np.zeros(n), np.ones(n), np.zeros(n))
    np.testing.assert_allclose(answer(unobserved, rule, lean).mean, 0.5 if lean is None else sigmoid(lean))


def test_the_variance_is_that_of_a_face_and_more_for_what_is_called_occupied() -> None:
    """By volume: half of a face is free, and beams call it occupied. Free space is as free as it is called, or more."""
    z = np.array([-6.0, -3.0, 3.0, 6.0])
    sums = LatentSums(z, np.full(4, 70.0), np.full(4, 1.3 * DEFAULT_RULE.full_activation))
    got = answer(sums, dataclasses.replace(DEFAULT_RULE, mean_moderation=0.0))
    plain = got.mean * (1 - got.mean)
    assert (got.var[:2] < plain[:2]).all()
    assert (got.var[2:] > 4 * plain[2:]).all()
    assert got.var[2] == 0.25, "no probability varies more"
    behind = answer(sums._replace(var=np.full(4, 110.0)), DEFAULT_RULE)
    assert (behind.var[:2] > got.var[:2]).all()


@pytest.mark.parametrize("evidence_only", [False, True])
def test_where_there_is_no_lean_an_answer_is_that_of_a_map_without_one(evidence_only: bool) -> None:
    sums = sums_of(300, 6)
    got = answer(sums, DEFAULT_RULE, np.full(300, np.nan), evidence_only=evidence_only)
    for one, other in zip(got, answer(sums, DEFAULT_RULE), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


@pytest.mark.parametrize("rule", RULES)
def test_gradients_are_the_central_differences(rule: AnswerRule) -> None:
    """Along a line in the space of the sums: a change of x moves all three."""
    sums, rng = sums_of(500, 2), np.random.default_rng(3)
    slopes = LatentGradients(*rng.normal(size=(3, 500, 3)))
    got = gradients(sums, slopes, rule)
    # the answer has a jump where a point becomes observed, and a kink at an activation of 1
    full = rule.full_activation
    edges = np.stack(
        [np.abs(sums.activation - edge) for edge in (rule.observed_activation, 1.0, OCCUPIED_FROM * full)]
    )
    smooth = (edges > 1e-3).all(axis=0)
    assert smooth.sum() > 450
    if full:
        assert (
            answer(sums, rule).mean.max()
            < answer(sums, dataclasses.replace(rule, full_activation=0.0)).mean.max()
        )
    for axis in range(3):
        step = LatentSums(*(1e-6 * slope[:, axis] for slope in slopes))
        ahead, behind = (
            answer(LatentSums(*(s + sign * d for s, d in zip(sums, step, strict=True))), rule)
            for sign in (1, -1)
        )
        for slope, name in ((got.mean, "mean"), (got.latent_mean, "latent_mean")):
            difference = (getattr(ahead, name) - getattr(behind, name)) / 2e-6
            np.testing.assert_allclose(slope[smooth, axis], difference[smooth], rtol=1e-5, atol=1e-8)
    assert not got.mean[~answer(sums, rule).observed].any()


@pytest.mark.parametrize("rule", RULES)
def test_the_compiled_copy_in_the_rays_is_the_same_answer(rule: AnswerRule) -> None:
    sums = sums_of(2000, 4)
    got = answer(sums, rule)
    moderated = [
        rays.moderated(*at, rule.residual_var, rule.mean_moderation) for at in zip(*sums, strict=True)
    ]
    z = [
        rays.ended(at, activation, rule.full_activation, math.nan)
        for at, activation in zip(moderated, sums.activation, strict=True)
    ]
    np.testing.assert_allclose(sigmoid(np.array(z))[got.observed], got.mean[got.observed], rtol=1e-12)
    lean = np.random.default_rng(5).normal(0.0, 4.0, 2000)
    z = [
        rays.ended(at + g, activation, rule.full_activation, g)
        for at, activation, g in zip(moderated, sums.activation, lean, strict=True)
    ]
    got = answer(sums, rule, lean, evidence_only=True)  # what is observed counts in full
    np.testing.assert_allclose(sigmoid(np.array(z))[got.observed], got.mean[got.observed], rtol=1e-12)


# --- the formulas of the contract --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def formulas(root: Path) -> CodeType:
    """The Python of the README's section, to be run as it stands."""
    section = (root / "schemas" / "README.md").read_text().partition("### From kernels to answers\n")[2]
    blocks = re.findall(r"^```python\n(.*?)^```", section.partition("\n### ")[0], re.MULTILINE | re.DOTALL)
    assert len(blocks) == 2
    return compile("\n".join(blocks), "schemas/README.md", "exec")


@pytest.mark.parametrize("leans", ["", "leans", "evidence only"])
@pytest.mark.parametrize("rule", RULES)
def test_the_formulas_of_the_contract_are_the_answers(
    formulas: CodeType, rule: AnswerRule, leans: str
) -> None:
    rng, k, n = np.random.default_rng(5), 60, 250
    kernels = {
        "origin": np.array([400.0, -300.0, 2.0]),
        "hinge_mean": rng.uniform(-3, 3, (k, 3)),
        "gamma_shape": rng.uniform(1, 4, k),
        "gamma_rate": rng.uniform(1, 4, k),
        "weight_mean": rng.normal(0, 4, k),
        "weight_var": rng.uniform(0.1, 9, k),
    }
    points = kernels["origin"] + rng.uniform(-4, 4, (n, 3))
    tilt = rng.normal(size=3)  # of a lean that is linear
    evidence_only = leans == "evidence only"

    def told(x: Array) -> SimpleNamespace:
        lean = (x - kernels["origin"]) @ tilt if leans else None
        names = {**kernels, **rule.fields(), "x": x, "lean": lean, "lean_gradient": tilt}
        names["evidence_only"] = evidence_only
        exec(formulas, names)
        return SimpleNamespace(**names)

    at = [told(x) for x in points]
    a, grad_a = np.stack([t.a for t in at]), np.stack([t.grad_a for t in at])
    w, v = kernels["weight_mean"], kernels["weight_var"]
    known = np.maximum(1.0 - v / rule.prior_var, 0.0)
    sums = LatentSums(a @ w, a**2 @ v, a @ known)
    slopes = LatentGradients(
        np.einsum("k,nkd->nd", w, grad_a),
        np.einsum("nk,nkd->nd", 2 * v * a, grad_a),
        np.einsum("k,nkd->nd", known, grad_a),
    )
    lean = None
    if leans:
        log_odds = (points - kernels["origin"]) @ tilt
        lean = LeanAt(log_odds, np.broadcast_to(tilt, (n, 3)))
    got = answer(sums, rule, None if lean is None else lean.log_odds, evidence_only=evidence_only)
    of_got = gradients(sums, slopes, rule, lean, evidence_only=evidence_only)
    edges = [np.full(n, rule.observed_activation), np.ones(n)]
    if lean is not None:
        solid = np.where(sums.mean < 0, np.clip(lean.log_odds, 0, 1), 0)
        edges.append(rule.observed_activation + ROOM + (ROOM_IN_SOLID - ROOM) * solid)
    edges += [np.full(n, from_density * rule.full_activation) for from_density in (OCCUPIED_FROM, FREE_FROM)]
    near_edge = np.abs(sums.activation - edges).min(axis=0) < 1e-4
    if lean is not None:  # kinks
        near_edge |= np.abs(np.stack([lean.log_odds, lean.log_odds - 1, sums.mean])).min(axis=0) < 1e-4
    if rule.observed_activation > 0:
        assert (~got.observed).sum() > 5
    if rule.observed_activation < 1:
        assert (got.observed & (sums.activation < 1)).sum() > 25
    assert (sums.activation > 1).sum() > 25
    for name, values in got._asdict().items():
        np.testing.assert_allclose([getattr(t, name) for t in at], values, rtol=1e-12)
    np.testing.assert_allclose([t.gradient for t in at], of_got.mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose([t.latent_gradient for t in at], of_got.latent_mean, rtol=1e-9, atol=1e-12)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        for name, slope in (("mean", of_got.mean), ("latent_mean", of_got.latent_mean)):
            ahead, behind = (np.array([getattr(told(x + s), name) for x in points]) for s in (step, -step))
            difference = (ahead - behind) / 2e-6
            np.testing.assert_allclose(slope[~near_edge, axis], difference[~near_edge], rtol=1e-5, atol=1e-6)


# --- the rule in messages ---------------------------------------------------------------------------------------------


def test_every_message_with_a_rule_gives_and_takes_it_whole() -> None:
    def structs(value: Any) -> Any:
        if isinstance(value, msgspec.Struct):
            yield value
            for name in value.__struct_fields__:
                yield from structs(getattr(value, name))

    found = {
        type(s): s
        for example in examples().values()
        for s in structs(example)
        if "prior_var" in s.__struct_fields__
    }
    assert set(found) == {messages.Kernels, messages.TilesPart, messages.Info}
    for message in found.values():
        rule = AnswerRule.of(message)
        assert rule.fields() == {name: getattr(message, name) for name in RULE_FIELDS}
        other = dataclasses.replace(rule, mean_moderation=0.75)
        assert AnswerRule.of(msgspec.structs.replace(message, **other.fields())) == other


@pytest.mark.parametrize("name", RULE_FIELDS)
@pytest.mark.parametrize("value", [-1e-9, math.nan, math.inf])
def test_numbers_that_are_no_rule_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        AnswerRule(**{name: value})


def test_the_formulas_load_without_the_wire() -> None:
    code = "import sys, potschemas.answers; print(*{'msgspec', 'msgpack'} & set(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == ""
