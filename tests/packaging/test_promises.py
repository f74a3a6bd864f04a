"""Every promise of docs/reliability.md names tests that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_TABLE = (ROOT / "docs" / "reliability.md").read_text().split("## Every promise has a test")[1]
_ROWS = [line.split("|")[1:4] for line in _TABLE.splitlines() if line.startswith("| ")][2:]
_TESTED = re.compile(
    r"(?:\[(test_\w+)\]\(([^)]+)\)|(test_\w+))(?: \(([^)]*)\))?"
)  # a file, perhaps with names in brackets


def test_there_are_promises() -> None:
    assert len(_ROWS) > 15


@pytest.mark.parametrize(("promise", "tests", "figure"), _ROWS, ids=[row[0].strip() for row in _ROWS])
def test_the_tests_of_a_promise_are_there(promise: str, tests: str, figure: str) -> None:
    files = {name: ROOT / "docs" / to for _, row, _ in _ROWS for name, to, *_ in _TESTED.findall(row) if to}
    named = _TESTED.findall(tests)
    assert named, promise
    for linked, to, bare, words in named:
        file = ROOT / "docs" / to if linked else files[bare]
        text = file.read_text()
        for word in re.findall(r"`([^`]+)`", words):
            wanted = r"\w*".join(re.escape(part) for part in word.split("..."))
            assert re.search(rf"def test_\w*{wanted}\w*\(", text), word
    for script in re.findall(r"`(benchmarks/\w+\.py|docker/\w+)", figure):
        assert (ROOT / script).is_file()
