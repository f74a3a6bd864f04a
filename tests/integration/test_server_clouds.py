"""Clouds over real sessions: what each sets off, who may send, load, stamps, poses. Tests can hold the mapper."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from potschemas import messages, wire
from potschemas.messages import ErrorCode, ReceiptStatus
from potserver.domain.types import ParamsKind
from potserver.errors import EmptyError

from .conftest import (
    DEADLINE_S,
    ROOT,
    MakeRig,
    balance,
    drain,
    in_background,
    make_cloud,
    pose_message,
    until,
)


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


def test_parameters_that_nobody_reads_are_not_computed(make_rig: MakeRig) -> None:
    """Those of a published cloud count as read while anybody listens to the robot's."""
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")

    def put(seq: int) -> ParamsKind:
        client.put_cloud(make_cloud(seq=seq))
        assert receipts.get(timeout=DEADLINE_S).n_kernels == (
            0 if rig.mapper.params[-1] is ParamsKind.NONE else 120
        )
        return rig.mapper.params[-1]

    others = client.listen(client.keys.params("r2"))
    assert put(1) is ParamsKind.NONE
    params = client.listen(client.keys.params("r1"))
    assert put(2) is ParamsKind.FITTED
    assert params.get(timeout=DEADLINE_S).seq == 2
    client.put_cloud(make_cloud(seq=9), robot="r2")
    assert others.get(timeout=DEADLINE_S).seq == 9


def test_a_cloud_says_what_it_wants_back(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    params = client.listen(client.keys.params("*"))
    for seq, kind in enumerate(messages.ParamsKind):
        receipt = client.one("integrate", make_cloud(seq=seq, robot="r1", params=kind))
        assert rig.mapper.params[-1].value == kind.value
        assert (receipt.kernels is None) == (kind is messages.ParamsKind.NONE)
    client.put_cloud(make_cloud(seq=3, params=messages.ParamsKind.TRANSPORTED))
    # who listens gets those of acknowledged clouds too
    assert [params.get(timeout=DEADLINE_S).seq for _ in range(3)] == [0, 1, 3]
    assert rig.mapper.params[-1] is ParamsKind.TRANSPORTED


def test_published_parameters_that_were_asked_for_need_no_listener(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    client.put_cloud(make_cloud(params=messages.ParamsKind.FITTED))
    until(lambda: client.stats().counters.get("params.sent") == 1, "the parameters")
    client.one("integrate", make_cloud(seq=1, robot="r1"))
    assert client.stats().counters["params.sent"] == 1, "the reply has them"


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
    rig = make_rig(limits__max_cloud_bytes=size + 100)  # eight of these may wait
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud(seq=0))
    rig.mapper.mapping.wait_entered()
    for seq in range(1, 11):
        client.put_cloud(make_cloud(seq=seq))
    assert [r.seq for r in drain(receipts, 2)] == [9, 10]
    assert 0 < client.stats().queues["clouds.bytes"] <= 8 * (size + 100)


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
    outbox = rig.server.nodes["default"].prompt
    gate = threading.Event()
    outbox.post_now(lambda: gate.wait(DEADLINE_S) and None, 2**40)  # full for all who wait
    refused = [in_background(lambda: client.error("integrate", make_cloud(robot="r1"))) for _ in range(3)]
    until(lambda: outbox.depth == 3, "three refusals behind the gate")
    assert outbox.n_bytes == 2**40
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
    cloud, pose = make_cloud(), pose_message(1, 0.0)
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


def test_a_stamp_from_the_future_is_refused_and_not_remembered(make_rig: MakeRig) -> None:
    client = make_rig().client()
    wild = make_cloud(robot="r1", stamp_ns=time.time_ns() + 3600 * 10**9)
    error = client.error("integrate", wild)
    assert error.code is ErrorCode.OLD_STAMP
    assert "ahead of the server's clock" in error.message
    assert client.one("integrate", make_cloud(seq=1, robot="r1")).map_revision == 1
    pose = pose_message(2**62, 1.0)
    client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.rejected.old_stamp") == 1, "the refusal")


def test_a_clock_that_goes_back_shuts_no_robot_out(make_rig: MakeRig) -> None:
    client = make_rig().client()
    now_ns = time.time_ns()
    client.one("integrate", make_cloud(seq=1, robot="r1", session="boot1", stamp_ns=now_ns))
    for seq in (2, 3):
        late = make_cloud(seq=seq, robot="r1", session="boot1", stamp_ns=now_ns - 3600 * 10**9)
        assert client.one("integrate", late).status is ReceiptStatus.ACCEPTED
    again = make_cloud(seq=0, robot="r1", session="boot2", stamp_ns=5)  # rebooted, without a clock
    assert client.one("integrate", again).map_revision == 4


def test_a_forged_cloud_ahead_shuts_nobody_out_and_old_ones_stay_old(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")
    now_ns = time.time_ns()
    client.one("integrate", make_cloud(seq=7, robot="r1", session="mine", stamp_ns=now_ns))
    forged = make_cloud(seq=2**62, robot="r1", session="other", stamp_ns=now_ns + int(4.9e9))
    client.one("integrate", forged)
    client.put_cloud(make_cloud(seq=8, session="mine", stamp_ns=now_ns + 1))
    client.put_cloud(make_cloud(seq=7, session="mine", stamp_ns=now_ns + 2))
    taken, refused = drain(receipts, 2)
    assert (taken.seq, taken.status) == (8, ReceiptStatus.ACCEPTED)
    assert (refused.seq, refused.reason, refused.next_seq) == (7, "old_seq", 9)
    assert "9 or more would be taken" in refused.message
    assert client.error("integrate", forged).code is ErrorCode.OLD_SEQ


def test_a_pose_stream_is_followed_when_the_clock_goes_back(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    hour = 3600 * 10**9
    stamps = (hour, hour + 10**8, 10**9, 10**9 + 10**8)  # an hour back in between
    for n, stamp_ns in enumerate(stamps, start=1):
        pose = pose_message(stamp_ns, float(n))
        client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
        until(lambda n=n: client.stats().counters.get("poses.accepted") == n, "a pose")  # type: ignore[misc]
        if n == 2:
            client.one(
                "integrate", make_cloud(seq=1, robot="r1", T_map_sensor=None, stamp_ns=hour + 5 * 10**7)
            )
    client.one("integrate", make_cloud(seq=2, robot="r1", T_map_sensor=None, stamp_ns=10**9 + 5 * 10**7))
    np.testing.assert_allclose([scan.T_map_sensor[0, 3] for scan in rig.mapper.scans], [1.5, 3.5], atol=1e-9)


def test_repeats_may_be_allowed(make_rig: MakeRig) -> None:
    client = make_rig(intake__allow_repeats=True).client()
    client.one("integrate", make_cloud(seq=5, robot="r1"))
    assert client.one("integrate", make_cloud(seq=4, robot="r1")).map_revision == 2


def test_a_cloud_without_a_pose_takes_the_one_at_its_stamp(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    for stamp_ns, x_m in ((1_000_000_000, 10.0), (1_200_000_000, 12.0)):
        pose = pose_message(stamp_ns, x_m)
        client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.accepted") == 2, "two poses")
    client.one("integrate", make_cloud(robot="r1", T_map_sensor=None, stamp_ns=1_050_000_000))
    np.testing.assert_allclose(rig.mapper.scans[0].T_map_sensor[:3, 3], (10.5, 0, 0), atol=1e-12)
    for stamp_ns in (900_000_000, 1_300_000_000):  # before and after the stream
        error = client.error("integrate", make_cloud(robot="r2", T_map_sensor=None, stamp_ns=stamp_ns))
        assert error.code is ErrorCode.NO_POSE


def test_a_cloud_waits_a_moment_for_the_pose_after_it(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potserver.adapters.writer.WAIT_S", DEADLINE_S)
    rig = make_rig()
    client = rig.client()
    pose = pose_message(1_000_000_000, 1.0)
    client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.accepted") == 1, "a pose")
    waiting = in_background(
        lambda: client.one("integrate", make_cloud(robot="r1", T_map_sensor=None, stamp_ns=1_100_000_000))
    )
    pose = pose_message(1_200_000_000, 3.0)
    client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    assert waiting().status is ReceiptStatus.ACCEPTED
    np.testing.assert_allclose(rig.mapper.scans[0].T_map_sensor[0, 3], 2.0)


def test_clouds_that_wait_for_their_pose_hold_up_no_other_robot(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potserver.adapters.writer.WAIT_S", DEADLINE_S)
    rig = make_rig()
    client = rig.client()
    pose = pose_message(1_000_000_000, 1.0)
    for i in range(8):
        client.put(client.keys.pose(f"late{i}"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.accepted") == 8, "the poses")
    ahead = make_cloud(T_map_sensor=None, stamp_ns=1_100_000_000)
    waiting = [
        in_background(lambda i=i: client.get(client.keys.integrate(f"late{i}"), ahead)) for i in range(8)
    ]
    until(lambda: client.stats().queues["clouds.depth"] == 8, "eight clouds waiting")
    for seq in range(3):
        assert client.one("integrate", make_cloud(seq=seq, robot="swift")).status is ReceiptStatus.ACCEPTED
    assert client.stats().queues["clouds.depth"] == 8
    pose = pose_message(1_200_000_000, 3.0)
    for i in range(8):
        client.put(client.keys.pose(f"late{i}"), wire.encode(pose), wire.encoding_of(pose))
    for result in waiting:
        (receipt,) = result()
        assert receipt.status is ReceiptStatus.ACCEPTED
        assert receipt.wait_ms > 0


def test_a_pose_that_does_not_come_is_named(make_rig: MakeRig) -> None:
    client = make_rig().client()
    pose = pose_message(1_000_000_000, 1.0)
    client.put(client.keys.pose("r1"), wire.encode(pose), wire.encoding_of(pose))
    until(lambda: client.stats().counters.get("poses.accepted") == 1, "a pose")
    error = client.error("integrate", make_cloud(T_map_sensor=None, stamp_ns=1_100_000_000))
    assert error.code is ErrorCode.NO_POSE
    assert "ends 100.0 ms before it" in error.message


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
    node = rig.server.nodes["default"]
    gate = threading.Event()
    node.prompt.post(lambda: gate.wait(DEADLINE_S) and None)
    node.bulk.post(lambda: gate.wait(DEADLINE_S) and None)
    for seq in range(80):
        client.put_cloud(make_cloud(seq=seq, params=messages.ParamsKind.FITTED))
        until(lambda seq=seq: rig.mapper.n_scans == seq + 1, "the scan in the map")
    dropped = client.stats().counters["params.dropped"]
    assert dropped == 80 - 64
    gate.set()
    until(lambda: client.stats().counters.get("params.sent") == 64, "the rest")
