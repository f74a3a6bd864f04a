"""Audit lines: none is missing, and a flood of refusals does not become a flood of lines."""

from __future__ import annotations

from typing import Any

import pytest

from potserver.adapters import audit
from potserver.adapters.audit import Audit
from potserver.errors import OverloadedError, UnknownRobotError


def lines_of(caplog: pytest.LogCaptureFixture) -> list[Any]:
    return [record.msg for record in caplog.records if record.name == "potserver.audit"]


def test_refusals_of_a_kind_are_counted_in_one_line(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    now = [100.0]
    monkeypatch.setattr(audit.time, "monotonic", lambda: now[0])
    ours = Audit("site")
    with caplog.at_level("INFO", logger="potserver.audit"):
        for _ in range(5):
            ours.refused("clouds", "r1", UnknownRobotError("no"), seq=3)
        ours.refused("clouds", "r1", OverloadedError("full"))
        now[0] += 2.0
        ours.refused("clouds", "", UnknownRobotError("no"))
    lines = lines_of(caplog)
    assert [(line["what"], line["who"], line["reason"], line["n"]) for line in lines] == [
        ("clouds", "r1", "unknown_robot", 1),
        ("clouds", "r1", "overloaded", 1),
        ("clouds", "unnamed", "unknown_robot", 5),
    ]
    assert lines[0]["seq"] == 3


def test_every_change_is_a_line(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level("INFO", logger="potserver.audit"):
        Audit("site").changed("control.clear", "abc", result="the map is empty")
    (line,) = lines_of(caplog)
    assert (line["event"], line["map_id"], line["what"], line["who"]) == (
        "change_made",
        "site",
        "control.clear",
        "abc",
    )
