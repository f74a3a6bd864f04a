"""What is built on `MapClient`: playing a recording, and the load test."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from potclient import MapClient
from potclient.datasets import open_dataset
from potclient.errors import ClosedError
from potclient.holdout import HoldOut
from potclient.loadtest import LoadSettings, run_load
from potclient.play import Sending, play
from potclient.session import SessionOptions
from potschemas.messages import ErrorCode
from potserver.errors import EmptyError

from .scripted import ScriptedServer


def refuse(rig: Any, monkeypatch: pytest.MonkeyPatch, is_refused: Callable[[int], bool]) -> None:
    """Let the server's mapper reject clouds by how many came before."""
    integrate, n = rig.mapper.integrate, 0

    def integrate_or_not(scan: Any, **options: Any) -> Any:
        nonlocal n
        n += 1
        if is_refused(n):
            raise EmptyError("scripted")
        return integrate(scan, **options)

    monkeypatch.setattr(rig.mapper, "integrate", integrate_or_not)


@pytest.mark.parametrize("acknowledged", [False, True])
def test_playing_a_recording_accounts_for_every_scan(make_rig: Any, acknowledged: bool) -> None:
    rig = make_rig()
    recording = open_dataset("generated:2d", n_generated=5)
    seen: list[int] = []
    with MapClient(rig.server.endpoint) as client:
        report = play(
            client,
            recording,
            Sending(acknowledged=acknowledged),
            hold_out=HoldOut(0.2),
            on_outcome=lambda outcome: seen.append(outcome.index),
        )
    assert report.all_accepted
    assert [s.index for s in report.scans] == sorted(seen) == list(range(5))
    assert report.held_out is not None
    assert report.held_out.n == report.n_held_out > 0
    scans = rig.mapper.scans
    assert all(scan.is_planar for scan in scans), "points of two columns are a planar scan"
    sent = [len(scan.points) for scan in scans]
    assert sent == [s.n_points for s in report.scans]
    assert all(n < len(scan) for n, scan in zip(sent, recording, strict=True)), (
        "held-out beams are never sent"
    )
    stamps = [scan.stamp_ns for scan in scans]
    assert stamps == sorted(set(stamps))


def test_a_recording_may_keep_its_stamps(make_rig: Any) -> None:
    rig = make_rig()
    recording = open_dataset("generated:2d", n_generated=3)
    with MapClient(rig.server.endpoint) as client:
        assert play(client, recording, Sending(keep_stamps=True, robot="old")).all_accepted
        again = play(client, recording, Sending(keep_stamps=True, robot="old", acknowledged=True))
    assert [scan.stamp_ns for scan in rig.mapper.scans] == [scan.stamp_ns for scan in recording]
    assert {(s.status, s.reason) for s in again.scans} == {("rejected", "old_seq")}


def test_a_scan_that_is_not_accepted_shows_in_the_report(
    make_rig: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig()
    refuse(rig, monkeypatch, lambda n: n == 2)
    with MapClient(rig.server.endpoint) as client:
        report = play(client, open_dataset("generated:2d", n_generated=3))
        assert client.on_receipt is None
    assert not report.all_accepted
    assert [s.status for s in report.scans] == ["accepted", "rejected", "accepted"]
    assert report.to_json()["counts"]["rejected"] == 1


def test_a_recording_that_fails_midway_reports_what_was_sent() -> None:
    sent = 0

    def close_after_two(_: Any) -> None:
        nonlocal sent
        sent += 1
        if sent == 2:
            client.close()

    with ScriptedServer() as server, MapClient(server.endpoint) as client:
        server.on("integrate", ErrorCode.INTERNAL)  # booked as rejected: the server answered
        recording = open_dataset("generated:2d", n_generated=4)
        report = play(client, recording, Sending(acknowledged=True), on_outcome=close_after_two)
    assert isinstance(report.failure, ClosedError)
    assert report.to_json()["failure"] == "the client is closed"
    assert [s.status for s in report.scans] == ["rejected", "rejected"]
    assert not report.all_accepted


def test_a_load_test_accounts_for_every_cloud(make_rig: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = make_rig()
    refuse(rig, monkeypatch, lambda n: n % 3 == 0)
    settings = LoadSettings(
        robots=2, rate_hz=40, planners=1, planner_hz=40, duration_s=0.5, n_points=50, query_points=20
    )
    report = run_load(
        settings,
        open_dataset("generated:2d", n_generated=3),
        options=SessionOptions(connect=(rig.server.endpoint,)),
    )
    c = report.clouds
    assert report.nothing_lost
    assert c.offered == c.dropped_by_client + c.accepted + c.dropped + c.rejected + c.unknown > 0
    assert sum(report.reasons.values()) == c.rejected + c.dropped > 0
    assert report.receipts.n == c.accepted + c.rejected + c.dropped
    assert report.asked == report.answered == report.queries.n > 0
    assert report.server_stats is not None
    assert report.to_json()["nothing_lost"] is True


def test_a_load_test_that_loses_receipts_says_so() -> None:
    settings = LoadSettings(
        robots=1, rate_hz=20, planners=1, duration_s=1.0, n_points=50, query_points=20, receipt_timeout_s=0.1
    )
    with ScriptedServer() as server:
        server.on_clouds(lambda robot, cloud: None)
        server.on("points", ErrorCode.INTERNAL)
        report = run_load(
            settings, open_dataset("generated:2d"), options=SessionOptions(connect=(server.endpoint,))
        )
    assert not report.nothing_lost
    assert report.clouds.unknown > 0
    assert report.clouds.accounted
    assert report.failed == {"InternalError": report.asked}
