"""From the first connection of a `MapClient` to its end: who serves, lanes, restarts of the server, closing."""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import pytest
import zenoh

from potclient.client import MapClient
from potclient.errors import ClosedError, NoServerError, PotclientError, UsageError
from potclient.link import Link
from potclient.results import Receipt
from potclient.session import SessionOptions, open_session
from potschemas import messages
from potschemas.keys import MapKeys
from potserver.config import load_settings
from potserver.server import MapServer

from .conftest import DEADLINE_S, in_background, until
from .rooms import pose, room
from .scripted import HOLD, ScriptedServer, free_port

# --- who serves ----------------------------------------------------------------------------------------------------


def test_sessions_that_cannot_open_say_why() -> None:
    with pytest.raises(NoServerError, match="nobody listens"):
        open_session(SessionOptions(connect=(f"tcp/127.0.0.1:{free_port()}",)))
    with pytest.raises(NoServerError, match="potserver serve"):
        MapClient(f"tcp/127.0.0.1:{free_port()}")


def test_waiting_for_somebody_to_listen_ends() -> None:
    options = SessionOptions(connect=(f"tcp/127.0.0.1:{free_port()}",), connect_timeout_s=0.2)
    with pytest.raises(NoServerError, match=r"within 0\.2 s"):
        MapClient(options=options)


def test_a_client_may_come_before_its_server() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    server = MapServer(load_settings(), listen=endpoint)
    late = threading.Timer(0.2, server.start)
    late.start()
    options = SessionOptions(connect=(endpoint,), connect_timeout_s=DEADLINE_S)
    try:
        with MapClient(options=options) as client:
            assert client.wait_ready(DEADLINE_S) == "potserver"
            assert client.servers == ("potserver",)
            assert client.info().n_scans == 0
    finally:
        late.join()
        server.stop()


def test_another_map_than_the_served_one(map_server: MapServer) -> None:
    with MapClient(map_server.endpoint, map="other") as client:
        with pytest.raises(NoServerError, match="maps served here: default"):
            client.info()
        with pytest.raises(NoServerError, match="maps served here: default"):
            client.wait_ready(0.01)


def test_a_server_that_goes_away_and_comes_back() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with MapServer(load_settings(), listen=endpoint):
        client = MapClient(endpoint, timeout_s=DEADLINE_S)
        client.wait_ready(DEADLINE_S)
        client.publish(room(), pose(), wait=True)
        assert client.flush(DEADLINE_S)
    try:
        with pytest.raises(NoServerError):
            client.info()
        before = client.counts()
        client.publish(room(), pose())
        with MapServer(load_settings(), listen=endpoint):
            client.wait_ready(DEADLINE_S)
            assert client.flush(DEADLINE_S), "a cloud that waited for a server reaches the next one"
            assert client.counts().accepted == before.accepted + 1
            assert client.info().n_scans == 1
    finally:
        client.close()


def test_a_server_that_warms_up_is_said_to_do_so(make_rig: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("potclient.link._DIAGNOSIS_TIMEOUT_S", 0.05)
    rig = make_rig(start=False)
    rig.mapper.warming.hold()
    started = in_background(rig.server.start)
    rig.mapper.warming.wait_entered()
    with MapClient(rig.server.endpoint) as client:
        with pytest.raises(NoServerError, match="warming up"):
            client.info()
        with pytest.raises(NoServerError, match="warming up"):
            client.integrate(room(), pose())
        with pytest.raises(NoServerError, match="warming up"):
            client.wait_ready(0.01)
        rig.mapper.warming.release()
        started()
        client.wait_ready(DEADLINE_S)
        assert client.info().server == "potserver"


def test_a_question_at_the_end_of_the_warm_up_is_not_laid_on_access_control(
    make_rig: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("potclient.link._DIAGNOSIS_TIMEOUT_S", DEADLINE_S)
    rig = make_rig(start=False)
    rig.mapper.warming.hold()
    started = in_background(rig.server.start)
    rig.mapper.warming.wait_entered()
    silent, diagnose = threading.Event(), Link._silence

    def diagnosed(*arguments: Any) -> Any:
        silent.set()
        return diagnose(*arguments)

    monkeypatch.setattr(Link, "_silence", diagnosed)
    with MapClient(rig.server.endpoint) as client:
        asked = in_background(client.info)
        assert silent.wait(DEADLINE_S)
        rig.mapper.warming.release()
        started()
        with pytest.raises(NoServerError, match="it was warming up, ask again") as caught:
            asked()
        assert caught.value.retryable


# --- lanes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("op", "request_", "priority", "is_express"),
    [
        ("info", messages.InfoQuery(), zenoh.Priority.INTERACTIVE_HIGH, True),
        (
            "grid",
            messages.GridQuery(lower=[0.0, 0.0, 0.0], upper=[1.0, 1.0, 1.0], resolution=0.5),
            zenoh.Priority.DATA,
            False,
        ),
        ("params", messages.ParamsQuery(), zenoh.Priority.DATA, False),
        ("tiles", messages.TilesQuery(), zenoh.Priority.DATA, False),
    ],
)
@pytest.mark.parametrize("timeout_s", [None, 20.0])
def test_bulk_answers_do_not_take_the_lane_of_short_ones(
    map_server: MapServer,
    op: str,
    request_: messages.Message,
    priority: zenoh.Priority,
    is_express: bool,
    timeout_s: float | None,
) -> None:
    keys = MapKeys("pot/v1", "default")
    link = Link(keys, SessionOptions(connect=(map_server.endpoint,)), DEADLINE_S)
    try:
        link.wait_ready(None)
        replies = list(link.samples(keys.query(op), request_, timeout_s))
    finally:
        link.close()
    assert replies
    assert all((reply.priority, reply.express) == (priority, is_express) for reply in replies)


# --- the end -------------------------------------------------------------------------------------------------------


def test_a_closed_client_says_so(map_server: MapServer) -> None:
    client = MapClient(map_server.endpoint)
    client.publish(room(), pose(), wait=True)
    client.close()
    client.close()
    for call in (
        client.info,
        client.wait_ready,
        lambda: client.publish(room(), pose()),
        lambda: client.pose(pose()),
        lambda: client.watch_revisions(print),
    ):
        with pytest.raises(ClosedError):
            call()
    assert client.counts().accounted
    assert client.flush(0.0)
    assert "closed" in repr(client)


def test_closing_from_a_callback_ends(map_server: MapServer) -> None:
    closed = threading.Event()
    client = MapClient(map_server.endpoint)

    def on_receipt(_: Receipt) -> None:
        client.close()
        closed.set()

    client.on_receipt = on_receipt
    client.publish(room(), pose())
    assert closed.wait(DEADLINE_S)


def test_a_question_whose_client_is_closed_meanwhile_says_so(
    map_server: MapServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    with MapClient(map_server.endpoint, map="nobody.serves.this", timeout_s=0.5) as client:

        def close_and_ask(querier: zenoh.Querier) -> bool:
            client.close()
            return bool(querier.matching_status)

        monkeypatch.setattr("potclient.link.is_matching", close_and_ask)
        with pytest.raises(ClosedError):
            client.info()


def test_time_outs_must_be_positive(map_server: MapServer) -> None:
    with pytest.raises(UsageError, match="timeout_s"):
        MapClient(map_server.endpoint, timeout_s=0)


@pytest.mark.parametrize(
    ("ending", "status"), [("pass", 0), ("raise SystemExit(3)", 3), ("raise RuntimeError('x')", 1)]
)
def test_a_process_that_forgets_to_close_ends(map_server: MapServer, ending: str, status: int) -> None:
    program = f"""
import numpy as np
from potclient import FeedOptions, MapClient
client = MapClient({map_server.endpoint!r}, feed=FeedOptions(on_receipt=print))
client.watch_revisions(print)
client.publish(np.ones((5, 3)), np.eye(4), wait=True)
client.info()
{ending}
"""
    done = subprocess.run(
        [sys.executable, "-c", program], timeout=2 * DEADLINE_S, capture_output=True, text=True, check=False
    )
    assert done.returncode == status, done.stderr


def test_a_client_that_nobody_holds_any_more_is_closed_at_the_end(map_server: MapServer) -> None:
    """Its threads went on inside Zenoh while the interpreter ended: one process in three was aborted."""
    program = f"""
import atexit, gc, threading
atexit.register(lambda: print([t.name for t in threading.enumerate() if t.name.startswith("potclient-")]))
from potclient import MapClient
client = MapClient({map_server.endpoint!r})
client.info()
del client
gc.collect()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], timeout=2 * DEADLINE_S, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


class InUse:
    """A declaration that another thread is using: the library refuses to undeclare it."""

    def undeclare(self) -> None:
        raise RuntimeError("Already borrowed")


def test_a_close_goes_on_where_another_thread_is_asking() -> None:
    """Broken off half way it left threads inside Zenoh, and such a thread aborts the process when it ends."""
    with ScriptedServer() as server:
        server.on("points", HOLD)
        client = MapClient(server.endpoint, timeout_s=DEADLINE_S)
        client.wait_ready()
        link = client._link
        link._declared.insert(0, InUse())
        # a question whose limits are known: it goes out at once
        asked = in_background(
            lambda: list(link.samples(client.keys.query("points"), messages.InfoQuery(), None))
        )
        until(lambda: server.count("points") == 1, "the question")
        before = [thread for thread in threading.enumerate() if thread.name.startswith("potclient-")]
        assert before
        client.close()
        assert link.n_calls == 0, "nobody is inside Zenoh any more"
        assert not [thread for thread in before if thread.is_alive()]
        with pytest.raises(PotclientError):
            asked()


def test_a_close_waits_for_whoever_is_inside_zenoh(map_server: MapServer) -> None:
    entered, waited_for = threading.Event(), threading.Event()

    class Told(threading.Condition):
        def wait_for(self, predicate: Any, timeout: float | None = None) -> bool:
            waited_for.set()
            return super().wait_for(predicate, timeout)

    def inside() -> None:
        entered.set()
        assert waited_for.wait(DEADLINE_S)

    with MapClient(map_server.endpoint) as client:
        link = client._link
        link._calls_changed = Told()
        called = in_background(lambda: link._call(inside))
        assert entered.wait(DEADLINE_S)
        client.close()
        n_inside = link.n_calls
        waited_for.set()
        called()
        assert n_inside == 0
