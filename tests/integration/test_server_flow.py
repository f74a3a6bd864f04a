"""Load, order, deadlines, presence and life of a server, over real sessions, with a mapper that the test can hold."""

from __future__ import annotations

import collections
import json
import math
import queue
import signal
import subprocess
import sys
import threading
import time
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zenoh

from potschemas import messages, wire
from potschemas.keys import stats_key
from potschemas.messages import ErrorCode, ReceiptStatus
from potserver.adapters.intake import Barrier
from potserver.config import load_settings
from potserver.domain.running_scores import RunningScores
from potserver.errors import EmptyError, SettingsError
from potserver.server import MapServer

from .conftest import DEADLINE_S, ROOT, Client, FakeSnapshot, make_cloud, points_query, until

HERE = points_query([[0.0, 0, 0]])
MakeRig = Callable[..., Any]


def in_background(work: Callable[[], Any]) -> Callable[[], Any]:
    """Start work on a thread; the result waits for it and returns its value or raises its error."""
    outcome: queue.Queue[tuple[Any, BaseException | None]] = queue.Queue()

    def run() -> None:
        try:
            outcome.put((work(), None))
        except BaseException as error:
            outcome.put((None, error))

    threading.Thread(target=run, daemon=True).start()

    def result() -> Any:
        value, error = outcome.get(timeout=DEADLINE_S)
        if error is not None:
            raise error
        return value

    return result


def drain(inbox: queue.Queue[Any], n: int) -> list[Any]:
    """The next `n` messages."""
    return [inbox.get(timeout=DEADLINE_S) for _ in range(n)]


def balance(counters: dict[str, int]) -> int:
    """Clouds received less clouds that ended."""
    ended = sum(
        n
        for name, n in counters.items()
        if name.startswith(("clouds.accepted", "clouds.rejected.", "clouds.dropped."))
    )
    return counters["clouds.received"] - ended


# --- what an accepted cloud sets off ------------------------------------------------------------------------


def test_a_cloud_gives_one_receipt_its_parameters_and_a_tick(make_rig: MakeRig) -> None:
    client = make_rig().client()
    receipts, params = client.receipts("r1"), client.listen(client.keys.params("r1"))
    ticks = client.listen(client.keys.revision)
    client.put_cloud(make_cloud(seq=7))
    receipt = receipts.get(timeout=DEADLINE_S)
    assert (receipt.status, receipt.seq, receipt.robot) == (ReceiptStatus.ACCEPTED, 7, "r1")
    assert (receipt.map_revision, receipt.n_points, receipt.n_kernels) == (1, 600, 120)
    assert receipt.kernels is None, "the parameters travel on their own key"
    sent = params.get(timeout=DEADLINE_S)
    assert (sent.seq, sent.robot, sent.map_revision) == (7, "r1", 1)
    assert sent.kernels.hinge_mean.shape == [120, 3]
    tick = ticks.get(timeout=DEADLINE_S)
    assert (tick.map_revision, tick.n_kernels, tick.changed_tiles) == (1, 120, [[0, 0, 0]])


def test_integrate_replies_with_receipt_and_kernels_and_no_publication(make_rig: MakeRig) -> None:
    client = make_rig().client()
    receipts = client.receipts("r1")
    ticks = client.listen(client.keys.revision)
    receipt = client.one("integrate", make_cloud(seq=1, robot="r1"))
    assert receipt.status is ReceiptStatus.ACCEPTED
    assert receipt.kernels.hinge_mean.shape == [120, 3]
    assert ticks.get(timeout=DEADLINE_S).map_revision == 1
    client.put_cloud(make_cloud(seq=2))
    assert receipts.get(timeout=DEADLINE_S).seq == 2, "the receipt of seq 1 was the reply"


def test_kernels_far_from_the_origin_keep_their_precision(make_rig: MakeRig) -> None:
    rig = make_rig()
    pose = np.eye(4)
    pose[:3, 3] = (691_608.123, 5_335_799.456, 500.789)
    receipt = rig.client().one("integrate", make_cloud(robot="r1", T_map_sensor=wire.encode_array(pose)))
    kernels = receipt.kernels
    offsets = wire.decode_array(kernels.hinge_mean, "h", dtypes=(messages.DType.FLOAT32,), shape=(None, 3))
    error = np.asarray(kernels.origin) + offsets - rig.mapper.snapshot.kernels.hinge_mean
    assert np.abs(error).max() < 1e-6


def test_a_refusal_of_the_mapper_is_a_rejection(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    rig.mapper.failure = EmptyError("none in range")
    assert client.error("integrate", make_cloud(robot="r1")).code is ErrorCode.EMPTY


def test_a_bug_of_the_mapper_is_internal_and_its_traceback_stays_here(
    make_rig: MakeRig, caplog: pytest.LogCaptureFixture
) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.failure = ZeroDivisionError("secret detail")
    client.put_cloud(make_cloud(seq=3))
    receipt = receipts.get(timeout=DEADLINE_S)
    assert (receipt.status, receipt.reason) == (ReceiptStatus.REJECTED, "internal")
    assert "secret" not in (receipt.message or "")
    assert any("scan_failed" in str(record.msg) for record in caplog.records)
    rig.mapper.failure = None
    assert client.one("integrate", make_cloud(seq=4, robot="r1")).map_revision == 1


def test_a_bug_in_a_query_is_internal_and_the_worker_lives(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1)
    client = rig.client()
    rig.mapper.snapshot.occupancy = None  # type: ignore[assignment]
    error = client.error("points", HERE)
    assert error.code is ErrorCode.INTERNAL
    assert client.one("info").n_kernels == 0
    assert client.stats().counters["queries.points.internal"] == 1


# --- load ---------------------------------------------------------------------------------------------------


def test_every_cloud_of_a_flood_gets_exactly_one_receipt(make_rig: MakeRig) -> None:
    rig = make_rig(intake__max_queued=3)
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud(seq=0))
    rig.mapper.mapping.wait_entered()
    for seq in range(1, 40):
        client.put_cloud(make_cloud(seq=seq))
    refused = drain(receipts, 36)  # at once, while the mapper stands still
    assert {r.seq for r in refused} == set(range(4, 40))
    assert {(r.status, r.reason) for r in refused} == {(ReceiptStatus.DROPPED, "overloaded")}
    assert {r.queue_depth for r in refused} == {3}
    rig.mapper.mapping.release()
    assert [r.seq for r in drain(receipts, 4)] == [0, 1, 2, 3]
    stats = client.stats()
    assert stats.counters["clouds.dropped.overloaded"] == 36
    assert stats.counters["clouds.accepted"] == 4
    assert balance(stats.counters) == 0
    until(lambda: client.stats().counters.get("receipts.sent") == 40, "all receipts counted")
    assert stats.queues["clouds.depth"] == 0
    assert receipts.empty()


def test_the_queue_is_bounded_in_bytes(make_rig: MakeRig) -> None:
    size = len(wire.encode(make_cloud()))
    rig = make_rig(limits__max_cloud_bytes=size + 100, intake__max_queued_bytes=2 * size + 100)
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud(seq=0))
    rig.mapper.mapping.wait_entered()
    for seq in range(1, 5):
        client.put_cloud(make_cloud(seq=seq))
    assert [r.seq for r in drain(receipts, 2)] == [3, 4]
    assert 0 < client.stats().queues["clouds.bytes"] <= 2 * size + 100


def test_a_flooding_robot_does_not_shut_others_out(make_rig: MakeRig) -> None:
    rig = make_rig(intake__max_queued=4)
    client = rig.client()
    receipts = client.receipts()
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud(seq=0), robot="loud")
    rig.mapper.mapping.wait_entered()
    for seq in range(1, 5):
        client.put_cloud(make_cloud(seq=seq), robot="loud")
    until(lambda: client.stats().queues["clouds.depth"] == 4, "four clouds waiting")
    client.put_cloud(make_cloud(seq=0), robot="quiet")
    evicted = receipts.get(timeout=DEADLINE_S)
    assert (evicted.robot, evicted.seq, evicted.reason) == ("loud", 4, "overloaded")
    rig.mapper.mapping.release()
    order = [(r.robot, r.seq) for r in drain(receipts, 5)]
    assert order == [("loud", 0), ("loud", 1), ("quiet", 0), ("loud", 2), ("loud", 3)]


def test_a_refused_query_waits_for_no_outbox_and_keeps_no_bytes(make_rig: MakeRig) -> None:
    size = len(wire.encode(make_cloud()))
    rig = make_rig(limits__max_cloud_bytes=size - 1)
    client = rig.client()
    outbox = rig.server._nodes["default"].prompt
    gate = threading.Event()
    outbox.post_now(lambda: gate.wait(DEADLINE_S) and None, 2**40)  # full for all who wait
    refused = [in_background(lambda: client.error("integrate", make_cloud(robot="r1"))) for _ in range(3)]
    until(lambda: outbox.depth == 3, "three refusals behind the gate")
    assert outbox._n_bytes == 2**40
    assert client.one("info").n_kernels == 0, "the thread that admits is free"
    gate.set()
    assert {result().code for result in refused} == {ErrorCode.TOO_LARGE}


def test_integrate_is_refused_at_once_when_the_queue_is_full(make_rig: MakeRig) -> None:
    rig = make_rig(intake__max_queued=1)
    client = rig.client()
    rig.mapper.mapping.hold()
    first = in_background(lambda: client.one("integrate", make_cloud(seq=0, robot="r1")))
    rig.mapper.mapping.wait_entered()
    second = in_background(lambda: client.one("integrate", make_cloud(seq=1, robot="r1")))
    until(lambda: client.stats().queues["clouds.depth"] == 1, "one cloud waiting")
    error = client.error("integrate", make_cloud(seq=2, robot="r1"))
    assert (error.code, error.retryable, error.retry_after_s) == (ErrorCode.OVERLOADED, True, 0.5)
    rig.mapper.mapping.release()
    assert (first().seq, second().seq) == (0, 1)
    assert client.stats().counters["queries.integrate.overloaded"] == 1


def test_stats_publish_how_well_each_map_answers(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    before = (client.stats().map_scores or {})["default"]
    assert before.n_points == 0
    assert math.isnan(before.nll)
    asked = np.full(50, 2.0, np.float32)
    rig.mapper.scores = RunningScores().with_points(asked, np.zeros(50, np.float32), np.ones(50, bool), 1.0)
    after = (client.stats().map_scores or {})["default"]
    p = 1.0 / (1.0 + math.exp(-2.0))
    assert after.n_points == 50
    assert after.nll == pytest.approx(-math.log(p))
    assert after.brier == pytest.approx((1 - p) ** 2)
    assert after.ece == pytest.approx(1 - p)
    assert after.mean_moderation == FakeSnapshot.rule.mean_moderation


def test_queries_never_wait_for_a_scan(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud())
    rig.mapper.mapping.wait_entered()
    assert client.one("points", HERE).map_revision == 0
    assert client.one("info").map_revision == 0


def test_a_full_query_queue_answers_at_once_and_loses_nobody(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1, queries__max_queued=4)
    client = rig.client()
    rig.mapper.queries.hold()
    held = in_background(lambda: client.one("points", HERE))
    rig.mapper.queries.wait_entered()
    asked = [in_background(lambda: client.ask("points", HERE)) for _ in range(30)]
    until(lambda: client.stats().counters.get("queries.points.overloaded") == 26, "26 refusals")
    rig.mapper.queries.release()
    held()
    answers: collections.Counter[str] = collections.Counter()
    for result in asked:
        (answer,) = result()
        refused = isinstance(answer, messages.ErrorReply)
        assert not refused or (answer.code is ErrorCode.OVERLOADED and answer.retry_after_s == 0.2)
        answers["refused" if refused else "ok"] += 1
    assert answers == {"ok": 4, "refused": 26}


def test_work_past_its_deadline_is_not_started(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1)
    client = rig.client()
    rig.mapper.queries.hold()
    held = in_background(lambda: client.one("points", HERE))
    rig.mapper.queries.wait_entered()
    late = [
        in_background(lambda: client.error("points", points_query([[0.0, 0, 0]], deadline_ms=1.0))),
        in_background(
            lambda: client.error(
                "grid", messages.GridQuery(lower=[0.0] * 3, upper=[1.0] * 3, resolution=0.5, deadline_ms=1.0)
            )
        ),
    ]
    patient = in_background(lambda: client.one("points", points_query([[0.0, 0, 0]], deadline_ms=1e6)))
    until(lambda: client.stats().queues["queries.depth"] == 3, "three queries waiting")
    time.sleep(0.002)  # the deadline itself
    rig.mapper.queries.release()
    held()
    for result in late:
        error = result()
        assert (error.code, error.retryable) == (ErrorCode.DEADLINE, True)
    patient()
    assert rig.mapper.queries.entered.qsize() == 1, "only the patient one reached the map"


def _grid_of_parts(**changes: Any) -> messages.GridQuery:
    return messages.GridQuery(lower=[0.0] * 3, upper=[2.0] * 3, resolution=0.5, **changes)  # 64 cells


def test_a_grid_stops_between_its_parts_at_the_deadline(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig(queries__grid_part_cells=16)
    client = rig.client()
    late_s = 0.0
    clock = types.SimpleNamespace(monotonic=lambda: time.monotonic() + late_s)
    monkeypatch.setattr("potserver.adapters.queryables.time", clock)
    rig.mapper.queries.hold()
    asked = in_background(lambda: client.ask("grid", _grid_of_parts(deadline_ms=1e6)))
    rig.mapper.queries.wait_entered()
    late_s = 1e4
    rig.mapper.queries.release()
    part, error = asked()
    assert (part.n_parts, error.code) == (4, ErrorCode.DEADLINE)
    counters = client.stats().counters
    assert counters["queries.grid.deadline"] == 1
    assert "queries.grid.ok" not in counters


def test_a_grid_stops_between_its_parts_when_the_server_closes(make_rig: MakeRig) -> None:
    rig = make_rig(queries__grid_part_cells=16)
    client = rig.client()
    rig.mapper.queries.hold()
    asked = in_background(lambda: client.ask("grid", _grid_of_parts()))
    rig.mapper.queries.wait_entered()
    stopped = in_background(rig.server.stop)
    until(lambda: rig.server._pool.is_closing, "the pool to close")
    rig.mapper.queries.release()
    part, error = asked()
    assert (part.n_parts, error.code) == (4, ErrorCode.SHUTTING_DOWN)
    assert stopped() is True
    assert rig.server.health.counters()["queries.grid.shutting_down"] == 1


def test_a_query_that_holds_its_worker_is_cut_off_with_an_answer_and_the_stop_is_not_clean(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potserver.server._FLUSH_S", 0.05)
    rig = make_rig()
    client = rig.client()
    rig.mapper.queries.hold()
    asked = in_background(lambda: client.error("points", HERE))
    rig.mapper.queries.wait_entered()
    assert rig.server.stop() is False
    assert asked().code is ErrorCode.SHUTTING_DOWN
    assert rig.server.health.counters()["queries.points.shutting_down"] == 1


def test_info_does_not_wait_behind_grids(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1)
    client = rig.client()
    rig.mapper.queries.hold()
    grids = [in_background(lambda: client.ask("grid", _grid_of_parts())) for _ in range(3)]
    rig.mapper.queries.wait_entered()
    assert client.one("info").n_kernels == 0
    assert client.one("atoms").atoms == []
    rig.mapper.queries.release()
    for grid in grids:
        assert len(grid()) == 1


def test_a_query_over_the_byte_limit_of_zenoh_itself_is_no_answer_at_all(make_rig: MakeRig) -> None:
    """The hard guard, far above our own limits, drops without a word: an empty reply is an error for every client."""
    settings = {"limits__max_query_bytes": 5000, "limits__max_cloud_bytes": 10_000}
    client = make_rig(**settings).client()
    assert client.error("points", b"x" * 5001).code is ErrorCode.TOO_LARGE
    assert client.error("points", b"x" * 39_000).code is ErrorCode.TOO_LARGE
    assert client.get(client.keys.query("points"), b"x" * 41_000) == []
    assert client.one("info").n_kernels == 0


# --- who may, and which operations there are ----------------------------------------------------------------


def test_robots_off_the_allow_list_are_refused(make_rig: MakeRig) -> None:
    client = make_rig(intake__robots=["r1"]).client()
    receipts = client.receipts()
    client.put_cloud(make_cloud(seq=1), robot="r2")
    receipt = receipts.get(timeout=DEADLINE_S)
    assert (receipt.robot, receipt.seq, receipt.reason) == ("r2", 1, "unknown_robot")
    assert client.error("integrate", make_cloud(robot="r2")).code is ErrorCode.UNKNOWN_ROBOT
    assert client.one("integrate", make_cloud(robot="r1")).status is ReceiptStatus.ACCEPTED


def test_puts_on_wild_keys_are_counted_and_reach_nobody(
    make_rig: MakeRig, caplog: pytest.LogCaptureFixture
) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts()
    cloud, pose = make_cloud(), _pose_message(1, 0.0)
    wild = [client.keys.cloud("*"), client.keys.cloud("r$*"), f"{ROOT}/default/in/**"]
    for key in wild:
        client.session.put(key, wire.encode(cloud), encoding=wire.encoding_of(cloud))
    client.session.put(client.keys.pose("*"), wire.encode(pose), encoding=wire.encoding_of(pose))

    def both_refused() -> bool:
        counters = client.stats().counters
        return (counters.get("clouds.rejected.bad_key"), counters.get("poses.rejected.bad_key")) == (3, 2)

    until(both_refused, "the refusals")
    counters = client.stats().counters
    assert not {"clouds.received", "poses.received"} & counters.keys()
    client.put_cloud(make_cloud(seq=1))
    assert receipts.get(timeout=DEADLINE_S).seq == 1
    assert not [record for record in caplog.records if record.exc_info]


def test_a_token_without_a_legal_robot_is_counted(make_rig: MakeRig) -> None:
    client = make_rig().client()
    token = client.session.liveliness().declare_token(client.keys.robot_token("Robot!"))
    until(lambda: client.stats().counters.get("presence.rejected.bad_key") == 1, "the refusal")
    assert client.stats().counters["robots.alive"] == 0
    token.undeclare()


def test_what_changes_a_map_must_name_it(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    (answer,) = client.get(f"{ROOT}/*/q/integrate", make_cloud(robot="r1"))
    assert answer.code is ErrorCode.UNSUPPORTED
    (answer,) = client.get(f"{ROOT}/*/ctl/clear")
    assert answer.code is ErrorCode.UNSUPPORTED
    (answer,) = client.get(f"{ROOT}/*/q/info")
    assert answer.map == "default", "a question may go to all maps"
    assert rig.mapper.scans == []


def test_unknown_operations_and_verbs_are_unsupported(make_rig: MakeRig) -> None:
    client = make_rig().client()
    assert client.error("fly").code is ErrorCode.UNSUPPORTED
    assert client.control("save").code is ErrorCode.UNSUPPORTED
    assert client.stats().counters["queries.unknown.unsupported"] == 1


def test_a_stamp_from_the_future_is_refused_and_not_remembered(make_rig: MakeRig) -> None:
    client = make_rig().client()
    wild = make_cloud(robot="r1", stamp_ns=time.time_ns() + 3600 * 10**9)
    error = client.error("integrate", wild)
    assert error.code is ErrorCode.OLD_STAMP
    assert "ahead of the server's clock" in error.message
    assert client.one("integrate", make_cloud(seq=1, robot="r1")).map_revision == 1
    pose = _pose_message(2**62, 1.0)
    client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.rejected.old_stamp") == 1, "the refusal")


def test_old_stamps_may_be_allowed(make_rig: MakeRig) -> None:
    client = make_rig(intake__allow_old_stamps=True).client()
    client.one("integrate", make_cloud(seq=5, robot="r1"))
    assert client.one("integrate", make_cloud(seq=4, robot="r1")).map_revision == 2


# --- poses --------------------------------------------------------------------------------------------------


def _pose_message(stamp_ns: int, x_m: float) -> messages.Pose:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return messages.Pose(stamp_ns=stamp_ns, T_map_sensor=wire.encode_array(pose))


def test_a_cloud_without_a_pose_takes_the_one_at_its_stamp(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    for stamp_ns, x_m in ((1_000_000_000, 10.0), (1_200_000_000, 12.0)):
        pose = _pose_message(stamp_ns, x_m)
        client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.accepted") == 2, "two poses")
    client.one("integrate", make_cloud(robot="r1", T_map_sensor=None, stamp_ns=1_050_000_000))
    np.testing.assert_allclose(rig.mapper.scans[0].T_map_sensor[:3, 3], (10.5, 0, 0), atol=1e-12)
    for stamp_ns in (900_000_000, 1_300_000_000):  # before and after the stream
        error = client.error("integrate", make_cloud(robot="r2", T_map_sensor=None, stamp_ns=stamp_ns))
        assert error.code is ErrorCode.NO_POSE


def test_a_cloud_waits_a_moment_for_the_pose_after_it(make_rig: MakeRig) -> None:
    rig = make_rig(poses__wait_s=DEADLINE_S)
    client = rig.client()
    pose = _pose_message(1_000_000_000, 1.0)
    client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.accepted") == 1, "a pose")
    waiting = in_background(
        lambda: client.one("integrate", make_cloud(robot="r1", T_map_sensor=None, stamp_ns=1_100_000_000))
    )
    pose = _pose_message(1_200_000_000, 3.0)
    client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    assert waiting().status is ReceiptStatus.ACCEPTED
    np.testing.assert_allclose(rig.mapper.scans[0].T_map_sensor[0, 3], 2.0)


def test_bad_poses_are_counted(make_rig: MakeRig) -> None:
    client = make_rig().client()
    mirrored = messages.Pose(stamp_ns=1, T_map_sensor=wire.encode_array(np.diag([1.0, 1, -1, 1])))
    client.put(client.keys.pose("r1"), wire.encode(mirrored), wire.encoding_of(mirrored))
    client.put(client.keys.pose("r1"), b"\x00")
    until(lambda: client.stats().counters.get("poses.received") == 2, "two poses")
    counters = until(
        lambda: (c := client.stats().counters).get("poses.rejected.bad_message") and c, "both refusals"
    )
    assert counters["poses.rejected.bad_pose"] == 1
    assert "poses.accepted" not in counters


# --- control ------------------------------------------------------------------------------------------------


def test_clear_comes_after_the_clouds_before_it_and_forgets_the_stamps(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    for seq in (1, 2):
        client.put_cloud(make_cloud(seq=seq))
    until(lambda: client.stats().queues["clouds.depth"] == 1, "one in work, one waiting")
    cleared = in_background(lambda: client.control("clear"))
    until(lambda: rig.server._nodes["default"].intake._epochs[0].barrier, "the barrier")
    client.put_cloud(make_cloud(seq=1))  # an old stamp, but the map will be empty by then
    until(lambda: client.stats().queues["clouds.depth"] == 2, "both waiting")
    rig.mapper.mapping.release()
    reply = cleared()
    assert (reply.verb, reply.map_revision) == ("clear", 3)
    assert [(r.seq, r.status, r.map_revision) for r in drain(receipts, 3)] == [
        (1, ReceiptStatus.ACCEPTED, 1),
        (2, ReceiptStatus.ACCEPTED, 2),
        (1, ReceiptStatus.ACCEPTED, 4),
    ]
    assert client.one("info").n_scans == 1


def test_clear_tells_the_planners_which_tiles_are_gone(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    ticks = client.listen(client.keys.revision)
    client.one("integrate", make_cloud(robot="r1"))
    hinges = rig.mapper.snapshot.kernels.hinge_mean
    former = {tuple(tile) for tile in np.floor(hinges / rig.mapper.settings.tile_size_m).astype(int).tolist()}
    client.control("clear")
    _, tick = drain(ticks, 2)
    assert (tick.map_revision, tick.n_kernels, tick.tile_size_m) == (2, 0, 10.0)
    assert {tuple(tile) for tile in tick.changed_tiles} == former
    assert len(tick.changed_tiles) == len(former) > 1


def test_a_control_request_may_give_up_waiting(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud())
    rig.mapper.mapping.wait_entered()
    cleared = in_background(lambda: client.control("clear", messages.ControlRequest(timeout_s=1e-6)))
    until(lambda: rig.server._nodes["default"].intake._epochs[0].barrier, "the barrier")
    rig.mapper.mapping.release()
    assert cleared().code is ErrorCode.DEADLINE
    assert client.one("info").n_scans == 1, "nothing was cleared"


def test_drain_maps_what_waits_and_takes_no_more(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    for seq in (1, 2):
        client.put_cloud(make_cloud(seq=seq))
    until(lambda: client.stats().queues["clouds.depth"] == 1, "one in work, one waiting")
    drained = in_background(lambda: client.control("drain"))
    until(lambda: client.stats().state == "draining", "the state")
    until(lambda: client.alive(client.keys.server_token("potserver")) == [], "the token to go")
    client.put_cloud(make_cloud(seq=3))
    late = receipts.get(timeout=DEADLINE_S)
    assert (late.seq, late.status, late.reason) == (3, ReceiptStatus.DROPPED, "shutting_down")
    assert client.error("integrate", make_cloud(seq=4, robot="r1")).code is ErrorCode.SHUTTING_DOWN
    rig.mapper.mapping.release()
    reply = drained()
    assert reply.map_revision == 2
    assert "restart" in reply.message
    assert [r.seq for r in drain(receipts, 2)] == [1, 2]
    assert client.one("points", HERE).map_revision == 2, "questions are still answered"


def test_a_drain_that_could_not_be_queued_has_not_drained(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud())
    rig.mapper.mapping.wait_entered()
    intake = rig.server._nodes["default"].intake
    for _ in range(16):
        intake.admit_barrier(Barrier(lambda: None, lambda _: None))
    assert client.control("drain").code is ErrorCode.OVERLOADED
    rig.mapper.mapping.release()
    assert client.one("integrate", make_cloud(seq=1, robot="r1")).map_revision == 2
    assert client.alive(client.keys.server_token("potserver"))


# --- presence and counters ----------------------------------------------------------------------------------


def test_the_token_comes_only_after_the_warm_up(make_rig: MakeRig) -> None:
    rig = make_rig(start=False)
    rig.mapper.warming.hold()
    started = in_background(rig.server.start)
    rig.mapper.warming.wait_entered()
    client = rig.client()
    token = client.keys.server_token("potserver")
    assert client.alive(token) == []
    assert client.get(client.keys.query("info")) == [], "no half-ready answers either"
    rig.mapper.warming.release()
    started()
    assert client.alive(f"@{ROOT}/srv/*/default") == [token]
    assert client.one("info").map == "default"


def test_robots_with_a_token_are_counted(make_rig: MakeRig) -> None:
    rig = make_rig()
    client, robot = rig.client(), rig.client()
    tokens = [robot.session.liveliness().declare_token(robot.keys.robot_token(r)) for r in ("r1", "r2")]
    until(lambda: client.stats().counters["robots.alive"] == 2, "two robots")
    tokens.pop().undeclare()
    until(lambda: client.stats().counters["robots.alive"] == 1, "one robot")
    robot.session.close()
    until(lambda: client.stats().counters["robots.alive"] == 0, "no robot")


def test_stats_come_by_themselves_and_when_asked(make_rig: MakeRig) -> None:
    client = make_rig(stats_period_s=0.05, server_id="s-1").client()
    inbox: queue.Queue[messages.Stats] = queue.Queue()
    key = stats_key(ROOT, "s-1")
    client.session.declare_subscriber(
        key, lambda s: inbox.put(wire.decode(s.payload.to_bytes(), messages.Stats))
    )
    client.one("integrate", make_cloud(robot="r1"))
    client.one("points", HERE)
    first, *_, last = drain(inbox, 4)
    assert (first.server, first.state) == ("s-1", "serving")
    assert last.uptime_s > first.uptime_s
    assert last.counters["clouds.accepted"] == 1
    assert last.map_kernels == {"default": 120}
    assert last.rss_bytes > 2**20
    assert last.latencies["integrate"].count == 1
    assert last.latencies["points"].p50_ms <= last.latencies["points"].max_ms
    assert client.stats("s-1").counters.keys() >= last.counters.keys()


def test_stats_are_put_once_a_second_by_default() -> None:
    assert load_settings().stats_period_s == 1.0


# --- several maps -------------------------------------------------------------------------------------------


def test_two_maps_share_a_server_and_nothing_else(make_rig: MakeRig) -> None:
    rig = make_rig(maps=["ground", "roof"])
    ground, roof = rig.client(map_id="ground"), rig.client(map_id="roof")
    rig.mappers["ground"].mapping.hold()  # a slow scan on one map does not stop the other
    stuck = in_background(lambda: ground.one("integrate", make_cloud(robot="r1")))
    rig.mappers["ground"].mapping.wait_entered()
    assert roof.one("integrate", make_cloud(robot="r1")).map == "roof"
    rig.mappers["ground"].mapping.release()
    assert stuck().map_revision == 1
    roof.control("clear")
    assert (ground.one("info").n_kernels, roof.one("info").n_kernels) == (120, 0)
    assert ground.one("info").maps == ["ground", "roof"]
    assert set(ground.alive(f"@{ROOT}/srv/potserver/*")) == {
        c.keys.server_token("potserver") for c in (ground, roof)
    }
    assert ground.stats().map_kernels == {"ground": 120, "roof": 0}
    assert {i.map for i in ground.get(f"{ROOT}/*/q/info")} == {"ground", "roof"}


# --- life ---------------------------------------------------------------------------------------------------


def test_stop_maps_what_waits(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    for seq in range(3):
        client.put_cloud(make_cloud(seq=seq))
    until(lambda: client.stats().queues["clouds.depth"] == 2, "one in work, two waiting")
    stopped = in_background(lambda: rig.server.stop(DEADLINE_S))
    until(lambda: client.alive(client.keys.server_token("potserver")) == [], "the token to go")
    client.put_cloud(make_cloud(seq=9))
    assert receipts.get(timeout=DEADLINE_S).reason == "shutting_down"
    rig.mapper.mapping.release()
    assert stopped() is True
    assert [(r.seq, r.status) for r in drain(receipts, 3)] == [
        (seq, ReceiptStatus.ACCEPTED) for seq in range(3)
    ]
    assert rig.server.stop() is True, "twice does no harm"
    assert client.get(client.keys.query("info")) == []


def test_a_drain_past_its_deadline_answers_everybody_who_is_left(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    for seq in range(3):
        client.put_cloud(make_cloud(seq=seq))
    until(lambda: client.stats().queues["clouds.depth"] == 2, "one in work, two waiting")
    asked = in_background(lambda: client.error("integrate", make_cloud(seq=5, robot="r1")))
    until(lambda: client.stats().queues["clouds.depth"] == 3, "the query waiting")
    cleared = in_background(lambda: client.control("clear"))
    until(lambda: rig.server._nodes["default"].intake._epochs[0].barrier, "the barrier")
    stopped = in_background(lambda: rig.server.stop(0.01))
    assert {(r.seq, r.reason) for r in drain(receipts, 2)} == {(1, "shutting_down"), (2, "shutting_down")}
    assert asked().code is ErrorCode.SHUTTING_DOWN
    assert cleared().code is ErrorCode.SHUTTING_DOWN
    rig.mapper.mapping.release()
    assert receipts.get(timeout=DEADLINE_S).seq == 0, "what was in work is finished"
    assert stopped() is False


def test_closing_ends_every_thread(make_rig: MakeRig) -> None:
    before = set(threading.enumerate())
    rig = make_rig()
    rig.client().one("integrate", make_cloud(robot="r1"))
    assert rig.server.stop() is True
    ours = [t for t in threading.enumerate() if t not in before and "pyo3" not in t.name]
    assert ours == []


def test_a_client_killed_in_the_middle_of_a_query_does_no_harm(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1)
    client = rig.client()
    rig.mapper.queries.hold()
    script = (
        "import json, sys, zenoh\n"
        "c = zenoh.Config()\n"
        "for k, v in json.loads(sys.argv[1]).items(): c.insert_json5(k, json.dumps(v))\n"
        "s = zenoh.open(c)\n"
        "list(s.get(sys.argv[2], payload=bytes.fromhex(sys.argv[3]), timeout=60))\n"
    )
    config = {
        "mode": "client",
        "connect/endpoints": [rig.server.endpoint],
        "scouting/multicast/enabled": False,
    }
    query = messages.GridQuery(lower=[0.0] * 3, upper=[4.0] * 3, resolution=0.1)
    victim = subprocess.Popen(
        [
            sys.executable,
            "-c",
            script,
            json.dumps(config),
            client.keys.query("grid"),
            wire.encode(query).hex(),
        ]
    )
    try:
        rig.mapper.queries.wait_entered()
    finally:
        victim.kill()
        victim.wait(DEADLINE_S)
    rig.mapper.queries.release()
    assert client.one("points", HERE).map_revision == 0
    assert client.one("integrate", make_cloud(robot="r1")).map_revision == 1
    assert rig.server.stop() is True


def test_a_frozen_subscriber_stops_neither_the_mapper_nor_the_receipts_of_others(make_rig: MakeRig) -> None:
    rig = make_rig(zenoh__shared_memory=False)
    client = rig.client()
    script = (
        "import json, sys, threading, zenoh\n"
        "c = zenoh.Config()\n"
        "for k, v in json.loads(sys.argv[1]).items(): c.insert_json5(k, json.dumps(v))\n"
        "s = zenoh.open(c)\n"
        "s.declare_subscriber(sys.argv[2], lambda _: None)\n"
        "list(s.get(sys.argv[3], timeout=30))\n"
        "print('up', flush=True)\n"
        "threading.Event().wait(100)\n"
    )
    config = {
        "mode": "client",
        "connect/endpoints": [rig.server.endpoint],
        "scouting/multicast/enabled": False,
    }
    arguments = [json.dumps(config), client.keys.params("*"), client.keys.query("info")]
    frozen = subprocess.Popen([sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE)
    try:
        assert frozen.stdout is not None
        frozen.stdout.readline()
        frozen.send_signal(signal.SIGSTOP)
        receipts = client.receipts("r1")
        points = wire.encode_array(np.random.default_rng(0).normal(size=(50_000, 3)).astype(np.float32))
        for seq in range(60):  # 24 MB of parameters: more than the sockets between us can hold
            client.put_cloud(make_cloud(seq=seq, points=points))
            assert receipts.get(timeout=4.0).seq == seq, "sooner than Zenoh gives the frozen one up"
        assert rig.mapper.n_scans == 60
    finally:
        frozen.kill()
        frozen.wait(DEADLINE_S)
        frozen.stdout.close()  # type: ignore[union-attr]


def test_a_full_outbox_does_not_stop_the_mapper(make_rig: MakeRig) -> None:
    """Parameters that find it full are dropped and counted; the writer goes on."""
    rig = make_rig()
    client = rig.client()
    node = rig.server._nodes["default"]
    gate = threading.Event()
    node.prompt.post(lambda: gate.wait(DEADLINE_S) and None)
    node.bulk.post(lambda: gate.wait(DEADLINE_S) and None)
    for seq in range(80):
        client.put_cloud(make_cloud(seq=seq))
        until(lambda seq=seq: rig.mapper.n_scans == seq + 1, "the scan in the map")
    dropped = client.stats().counters["params.dropped"]
    assert dropped == 80 - 64
    gate.set()
    until(lambda: client.stats().counters.get("params.sent") == 64, "the rest")


def test_a_taken_port_is_one_clear_line(make_rig: MakeRig) -> None:
    endpoint = make_rig().server.endpoint
    with (
        pytest.raises(SettingsError, match=f"{endpoint}: the port is taken.*Hint: ") as caught,
        MapServer(
            make_map=lambda _: (_fake_mapper(), None),  # type: ignore[arg-type, return-value]
            listen=endpoint,
        ),
    ):
        pass
    assert "\n" not in str(caught.value)
    client = Client(endpoint)
    assert client.one("info").n_kernels == 0, "the first one serves on"
    client.close()


def _fake_mapper() -> Any:
    from .conftest import FakeMapper

    return FakeMapper()


def test_a_failing_start_leaves_nothing_behind(make_rig: MakeRig) -> None:
    rig = make_rig(start=False)

    def fail() -> None:
        raise OSError("no numerics")

    rig.mapper.warm_up = fail
    with pytest.raises(OSError, match="no numerics"):
        rig.server.start()
    with pytest.raises(zenoh.ZError):
        rig.client()


def test_a_server_can_join_a_router(make_rig: MakeRig) -> None:
    hub = make_rig(maps=["hub"], server_id="hub", zenoh__mode="router")
    spoke = make_rig(server_id="spoke", zenoh__connect=[hub.server.endpoint])
    client = Client(hub.server.endpoint)
    until(lambda: client.alive(f"@{ROOT}/srv/*/default"), "the spoke's token through the router")
    assert client.one("integrate", make_cloud(robot="r1")).map_revision == 1
    client.close()
    assert spoke.mapper.n_scans == 1
