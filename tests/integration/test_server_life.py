"""A server from its start to its stop: presence, counters, several maps; the mapper is one that tests can hold."""

from __future__ import annotations

import dataclasses
import math
import queue
import threading

import numpy as np
import pytest
import zenoh

from potschemas import messages, wire
from potschemas.keys import MapKeys, stats_key
from potschemas.messages import ErrorCode, ReceiptStatus
from potserver.adapters.stats import PERIOD_S
from potserver.domain.running_scores import RunningScores
from potserver.errors import SettingsError
from potserver.server import MapServer

from .conftest import (
    DEADLINE_S,
    HERE,
    ROOT,
    Client,
    FakeMapper,
    FakeSnapshot,
    MakeRig,
    drain,
    in_background,
    make_cloud,
    until,
)


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


def test_a_token_without_a_legal_robot_is_counted(make_rig: MakeRig) -> None:
    client = make_rig().client()
    token = client.session.liveliness().declare_token(client.keys.robot_token("Robot!"))
    until(lambda: client.stats().counters.get("presence.rejected.bad_key") == 1, "the refusal")
    assert client.stats().counters["robots.alive"] == 0
    token.undeclare()


def test_stats_come_by_themselves_and_when_asked(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("potserver.adapters.stats.PERIOD_S", 0.05)
    client = make_rig(server_id="s-1").client()
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
    assert PERIOD_S == 1.0


def test_stats_publish_how_well_each_map_answers(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    before = (client.stats().map_scores or {})["default"]
    assert before.n_points == 0
    assert math.isnan(before.nll)
    asked = np.full(50, 2.0, np.float32)
    scores = RunningScores().with_points(asked, np.zeros(50, np.float32), np.ones(50, bool), 1.0)
    rig.mapper.state = dataclasses.replace(rig.mapper.state, scores=scores)
    after = (client.stats().map_scores or {})["default"]
    p = 1.0 / (1.0 + math.exp(-2.0))
    assert after.n_points == 50
    assert after.nll == pytest.approx(-math.log(p))
    assert after.brier == pytest.approx((1 - p) ** 2)
    assert after.ece == pytest.approx(1 - p)
    assert after.mean_moderation == FakeSnapshot.rule.mean_moderation


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
    until(lambda: rig.server.nodes["default"].intake.n_barriers, "the barrier")
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


def test_a_taken_port_is_one_clear_line(make_rig: MakeRig) -> None:
    endpoint = make_rig().server.endpoint
    with (
        pytest.raises(SettingsError, match=f"{endpoint}: the port is taken.*Hint: ") as caught,
        MapServer(
            make_map=FakeMapper,  # type: ignore[arg-type]
            listen=endpoint,
        ),
    ):
        pass
    assert "\n" not in str(caught.value)
    client = Client(endpoint)
    assert client.one("info").n_kernels == 0, "the first one serves on"
    client.close()


def test_a_second_server_of_a_map_is_refused(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("potserver.adapters.presence.GONE_S", 0.5)
    first = make_rig(server_id="first")
    joins = [first.server.endpoint]
    second = make_rig(start=False, server_id="second", maps=["default", "roof"], zenoh__connect=joins)
    with pytest.raises(SettingsError, match=r"'default'.*'pot/v1'.*by first.*--map.*--root.*stop") as caught:
        second.server.start()
    assert "\n" not in str(caught.value)
    client = Client(joins[0])
    assert client.alive(f"@{ROOT}/srv/*/*") == [client.keys.server_token("first")]
    assert client.one("integrate", make_cloud(robot="r1")).map_revision == 1
    assert first.mapper.n_scans == 1
    client.close()


@pytest.mark.parametrize("changes", [{"maps": ["roof"]}, {"root": "pot/other"}])
def test_servers_of_other_maps_or_roots_share_a_network(
    make_rig: MakeRig, changes: dict[str, object]
) -> None:
    first = make_rig()
    make_rig(zenoh__connect=[first.server.endpoint], **changes)
    client = Client(first.server.endpoint)
    until(lambda: len(client.alive("@pot/**")) == 2, "both tokens")
    client.close()


def test_a_server_waits_for_the_token_of_one_that_has_just_ended(
    make_rig: MakeRig, caplog: pytest.LogCaptureFixture
) -> None:
    hub = make_rig(maps=["hub"], zenoh__mode="router")
    joins = [hub.server.endpoint]
    dying = Client(joins[0])
    token = dying.session.liveliness().declare_token(dying.keys.server_token("potserver"))
    next_one = make_rig(start=False, zenoh__connect=joins)
    started = in_background(next_one.server.start)
    until(lambda: "map_served_already" in caplog.text, "the server to say so")
    token.undeclare()
    started()
    assert next_one.server.state == "serving"
    assert caplog.text.count("map_served_already") == 1
    dying.close()


def test_a_server_that_came_up_during_the_warm_up_is_seen(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potserver.adapters.presence.GONE_S", 0.2)
    hub = make_rig(maps=["hub"], zenoh__mode="router")
    joins = [hub.server.endpoint]
    slow = make_rig(start=False, server_id="slow", zenoh__connect=joins)
    slow.mapper.warming.hold()
    started = in_background(slow.server.start)
    slow.mapper.warming.wait_entered()
    make_rig(server_id="quick", zenoh__connect=joins)
    session, token = slow.server._session, MapKeys(ROOT, "default").server_token("quick")
    assert session is not None
    until(
        lambda: [r for r in session.liveliness().get(token, timeout=DEADLINE_S) if r.ok], "its token at slow"
    )
    slow.mapper.warming.release()
    with pytest.raises(SettingsError, match="by quick"):
        started()


def test_a_failing_start_leaves_nothing_behind(make_rig: MakeRig) -> None:
    rig = make_rig(start=False)

    def fail(**_: bool) -> None:
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
