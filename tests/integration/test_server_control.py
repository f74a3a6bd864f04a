"""Control verbs over real sessions: in order with the clouds; the mapper is one that tests can hold."""

from __future__ import annotations

import numpy as np
import pytest
import zenoh

from potschemas import messages
from potschemas.messages import ErrorCode, ReceiptStatus
from potserver.adapters.intake import Barrier

from .conftest import (
    DEADLINE_S,
    HERE,
    MakeRig,
    drain,
    in_background,
    make_cloud,
    until,
)


def test_clear_comes_after_the_clouds_before_it_and_forgets_the_numbers(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    receipts = client.receipts("r1")
    rig.mapper.mapping.hold()
    for seq in (1, 2):
        client.put_cloud(make_cloud(seq=seq))
    until(lambda: client.stats().queues["clouds.depth"] == 1, "one in work, one waiting")
    cleared = in_background(lambda: client.control("clear"))
    until(lambda: rig.server.nodes["default"].intake.n_barriers, "the barrier")
    client.put_cloud(make_cloud(seq=1))  # an old number, but the map will be empty by then
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
    until(lambda: rig.server.nodes["default"].intake.n_barriers, "the barrier")
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
    intake = rig.server.nodes["default"].intake
    for _ in range(16):
        intake.admit_barrier(Barrier(lambda: None, lambda _: None))
    assert client.control("drain").code is ErrorCode.OVERLOADED
    rig.mapper.mapping.release()
    assert client.one("integrate", make_cloud(seq=1, robot="r1")).map_revision == 2
    assert client.alive(client.keys.server_token("potserver"))


def test_changes_and_refusals_are_audit_lines_with_who_and_what(
    make_rig: MakeRig, caplog: pytest.LogCaptureFixture
) -> None:
    client = make_rig(intake__robots="r1").client()
    with caplog.at_level("INFO", logger="potserver.audit"):
        source = zenoh.SourceInfo(client.session.declare_querier(client.keys.control("clear")).id, 1)
        list(client.session.get(client.keys.control("clear"), source_info=source))
        client.control("load")
        client.error("integrate", make_cloud(seq=1, robot="r2"))
        client.error("points", b"no message")
    told = [record.msg for record in caplog.records if record.name == "potserver.audit"]
    assert [(line["event"], line["what"], line.get("reason")) for line in told] == [
        ("change_made", "control.clear", None),
        ("refused", "control.load", "bad_message"),
        ("refused", "queries.integrate", "unknown_robot"),
        ("refused", "queries.points", "bad_message"),
    ]
    assert told[0]["who"] == str(client.session.zid())
    assert all(line["map_id"] == "default" and line["timestamp"] for line in told)
