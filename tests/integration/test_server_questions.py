"""Questions under load and past their deadlines, over real sessions; the mapper is one that tests can hold."""

from __future__ import annotations

import collections
import json
import subprocess
import sys
import time
import types
from typing import Any

import msgspec
import numpy as np
import pytest

from potclient import MapClient, TooManyError
from potschemas import messages, wire
from potschemas.messages import ErrorCode
from potserver.domain.types import KernelSet

from .conftest import (
    DEADLINE_S,
    HERE,
    ROOT,
    FakeMapper,
    FakeSnapshot,
    MakeRig,
    in_background,
    make_cloud,
    points_query,
    until,
)


def test_a_bug_in_a_query_is_internal_and_the_worker_lives(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1)
    client = rig.client()
    rig.mapper.snapshot.occupancy = None  # type: ignore[assignment]
    error = client.error("points", HERE)
    assert error.code is ErrorCode.INTERNAL
    assert client.one("info").n_kernels == 0
    assert client.stats().counters["queries.points.internal"] == 1


def test_queries_never_wait_for_a_scan(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    rig.mapper.mapping.hold()
    client.put_cloud(make_cloud())
    rig.mapper.mapping.wait_entered()
    assert client.one("points", HERE).map_revision == 0
    assert client.one("info").map_revision == 0


MANY = points_query(np.zeros((4000, 3)))  # 96 kB: no short question


def test_a_full_query_queue_answers_at_once_and_loses_nobody(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1, queries__max_queued=4)
    client = rig.client()
    rig.mapper.queries.hold()
    held = in_background(lambda: client.one("points", MANY))
    rig.mapper.queries.wait_entered()
    asked = [in_background(lambda: client.ask("points", MANY)) for _ in range(30)]
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


def test_who_asks_too_often_is_refused_and_nobody_else(make_rig: MakeRig) -> None:
    rig = make_rig(queries__max_rate_hz=0.01)  # one now and then
    hasty = MapClient(rig.server.endpoint)
    others = rig.client()
    with hasty:
        hasty.info()
        with pytest.raises(TooManyError) as refused:
            hasty.occupancy([[0.0, 0.0, 0.0]])
        assert refused.value.retry_after_s is not None
        assert refused.value.retry_after_s > 1.0
    assert others.one("points", HERE).map_revision == 0
    assert rig.server.health.counter("queries.points.too_many") == 1
    assert rig.server.health.counter("queries.points.ok") == 1


def test_work_past_its_deadline_is_not_started(make_rig: MakeRig) -> None:
    rig = make_rig(queries__threads=1)
    client = rig.client()
    rig.mapper.queries.hold()
    held = in_background(lambda: client.one("points", MANY))
    rig.mapper.queries.wait_entered()
    hurried = msgspec.structs.replace(MANY, deadline_ms=1.0)
    late = [in_background(lambda: client.error("points", hurried)) for _ in range(2)]
    patient = in_background(lambda: client.one("points", msgspec.structs.replace(MANY, deadline_ms=1e6)))
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
    """262,144 cells in four parts."""
    return messages.GridQuery(lower=[0.0] * 3, upper=[32.0] * 3, resolution=0.5, **changes)


def test_a_grid_stops_between_its_parts_at_the_deadline(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = make_rig()
    client = rig.client()
    late_s = 0.0
    clock = types.SimpleNamespace(monotonic=lambda: time.monotonic() + late_s)
    monkeypatch.setattr("potserver.adapters.answers.time", clock)
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
    rig = make_rig()
    client = rig.client()
    rig.mapper.queries.hold()
    asked = in_background(lambda: client.ask("grid", _grid_of_parts()))
    rig.mapper.queries.wait_entered()
    stopped = in_background(rig.server.stop)
    until(lambda: rig.server.pool.is_closing, "the pool to close")
    rig.mapper.queries.release()
    part, error = asked()
    assert (part.n_parts, error.code) == (4, ErrorCode.SHUTTING_DOWN)
    assert stopped() is True
    assert rig.server.health.counters()["queries.grid.shutting_down"] == 1


def test_a_query_that_holds_its_worker_is_cut_off_with_an_answer_and_the_stop_is_not_clean(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potserver.server.FLUSH_S", 0.05)
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
        assert len(grid()) == 4


def test_a_query_over_the_byte_limit_of_zenoh_itself_is_no_answer_at_all(make_rig: MakeRig) -> None:
    """The hard guard, far above our own limits, drops without a word: an empty reply is an error for every client."""
    settings = {"limits__max_query_bytes": 5000, "limits__max_cloud_bytes": 10_000}
    client = make_rig(**settings).client()
    assert client.error("points", b"x" * 5001).code is ErrorCode.TOO_LARGE
    assert client.error("points", b"x" * 39_000).code is ErrorCode.TOO_LARGE
    assert client.get(client.keys.query("points"), b"x" * 41_000) == []
    assert client.one("info").n_kernels == 0


def test_what_changes_a_map_must_name_it(make_rig: MakeRig) -> None:
    rig = make_rig()
    client = rig.client()
    for key in (f"{ROOT}/*/in/r1/integrate", f"{ROOT}/default/in/*/integrate"):
        (answer,) = client.get(key, make_cloud())
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


def test_points_do_not_wait_behind_grids(make_rig: MakeRig) -> None:
    """The mapper holds every grid; the points of another client, and of the same one, are answered meanwhile."""
    rig = make_rig(queries__threads=1)
    client = rig.client()
    free = rig.mapper.snapshot.occupancy
    rig.mapper.snapshot.occupancy = lambda points, **_: free(points) if len(points) > 1 else _answer_of(rig)
    rig.mapper.queries.hold()
    grids = [in_background(lambda: client.ask("grid", _grid_of_parts())) for _ in range(3)]
    rig.mapper.queries.wait_entered()
    for asker in (client, rig.client()):
        assert asker.one("points", HERE).map_revision == 0
    rig.mapper.queries.release()
    assert [len(grid()) for grid in grids] == [4, 4, 4]


def _answer_of(rig: Any) -> Any:
    return FakeSnapshot(FakeMapper(), KernelSet.empty(), 0).occupancy(np.zeros((1, 3)))


def test_a_question_without_a_deadline_has_the_default_one(
    make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potserver.adapters.answers.DEADLINE_S", 1e-9)
    rig = make_rig()
    client = rig.client()
    error = client.error("points", HERE)
    assert (error.code, error.retryable) == (ErrorCode.DEADLINE, True)
    assert client.one("points", points_query([[0.0, 0, 0]], deadline_ms=1e6)).map_revision == 0


def test_a_client_that_is_killed_leaves_no_work_behind(make_rig: MakeRig) -> None:
    """Its grids are given up when its connection ends, those that wait and the one in work."""
    rig = make_rig(queries__threads=1)
    rig.mapper.queries.hold()
    script = (
        "import sys, threading\n"
        "from potclient import MapClient\n"
        "client = MapClient(sys.argv[1], timeout_s=600)\n"
        "client.wait_ready(30)\n"
        "for _ in range(5): threading.Thread(target=client.grid, args=((0, 0, 0), (32, 32, 32), 0.5)).start()\n"
    )
    victim = subprocess.Popen([sys.executable, "-c", script, rig.server.endpoint])
    try:
        rig.mapper.queries.wait_entered()
        until(lambda: rig.server.pool.depth == 4, "four grids waiting")
    finally:
        victim.kill()
        victim.wait(DEADLINE_S)
    counters = rig.server.health.counters
    until(lambda: counters().get("queries.grid.asker_gone") == 4, "those that wait to be given up")
    rig.mapper.queries.release()
    until(lambda: counters().get("queries.grid.asker_gone") == 5, "the one in work to be given up")
    assert rig.mapper.queries.entered.qsize() == 0, "no further part was computed"
    assert rig.client().one("points", HERE).map_revision == 0
