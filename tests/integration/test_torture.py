"""A short torture: some of the faults, damages and messages of `make torture`, which has them all."""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from benchmarks import fleet, torture_damage
from benchmarks.torture import run_calls
from benchmarks.torture_damage import damages, torture_copies, torture_files, torture_pages
from benchmarks.torture_messages import mutated, torture_messages
from benchmarks.torture_store import STEPS, Driven, digest, wanted


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="the library that catches calls needs a C compiler")
def test_a_fault_at_some_calls_loses_nothing_acknowledged() -> None:
    outcomes = run_calls(every=37)
    assert [outcome.name for outcome in outcomes] == [
        "killed",
        "torn",
        "refused once",
        "refused from",
        "power cut, all lost that was not synced",
        "power cut, any of its pages lost",
    ]
    assert all(outcome.n >= 5 for outcome in outcomes), "the library catches the calls"
    assert [line for outcome in outcomes for line in outcome.wrong] == []
    for outcome in outcomes:
        assert (
            sum(n for word, n in outcome.counts.items() if word.startswith("all acknowledged")) == outcome.n
        )


def test_what_is_lost_would_be_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The judge is no rubber stamp: a store that forgets a step is told apart from one that does not."""
    driven = Driven(tmp_path)
    for number in range(len(STEPS)):
        driven.do(number)
    steps = tuple(range(len(STEPS)))
    assert digest(driven.mapper.state) == wanted(steps)
    assert digest(driven.mapper.state) != wanted(steps[:-1])
    driven.store.close()
    monkeypatch.setattr(torture_damage, "reopened", lambda store: "0" if "damaged" in store.name else "1")
    assert any(outcome.wrong for outcome in torture_files(100_000, 0, lambda line: None))


def test_damage_is_told_or_harmless() -> None:
    outcomes = torture_files(40_000, 1, lambda line: None)
    assert len(outcomes) > 9
    assert [line for outcome in outcomes for line in outcome.wrong] == []
    assert {word for outcome in outcomes for word in outcome.counts} == {"the same", "refused"}


def test_damage_of_pages_is_told() -> None:
    outcome = torture_pages(20_000, 1, lambda line: None)
    assert outcome.wrong == []
    assert outcome.counts["refused"] > 10


def test_every_run_of_bytes_meets_a_flip() -> None:
    found = list(damages(1000, 64, random.Random(0)))
    assert {place // 64 for kind, place in found if kind == "flip"} == set(range(16))
    assert {kind for kind, place in found if place // 64 == 8} == {"flip", "clear", "cut"}


def test_a_copy_of_a_running_store_is_whole_or_refused() -> None:
    outcome = torture_copies(lambda line: None)
    assert outcome.wrong == []
    assert set(outcome.counts) == {"refused", "all acknowledged"}


def test_hostile_messages_get_typed_answers() -> None:
    queries, clouds = torture_messages(300, 2, lambda line: None)
    assert (queries.n, clouds.n) == (200, 100)
    assert queries.wrong + clouds.wrong == []
    assert len(queries.counts) > 2
    assert len(clouds.counts) > 2


def test_mutations_are_many() -> None:
    rng = random.Random(3)
    assert len({mutated(b"a message of some length", [b"another"], rng) for _ in range(100)}) > 90


@pytest.mark.slow
def test_a_small_fleet_is_answered_and_its_clouds_are_in_the_map() -> None:
    found = fleet.measure(3, 6, 4.0)
    assert found["wrong"] == []
    words = found["what became of clouds and questions"]
    assert words["cloud accepted"] >= 3
    assert words["question answered"] >= 6
