"""`MapClient` against a real Zenoh server on loopback: answers, receipts, and every way in which a network is silent."""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh

from potclient import feed
from potclient.atoms import Atom
from potclient.client import MapClient
from potclient.datasets import open_dataset
from potclient.errors import (
    AtomRefusedError,
    BadReplyError,
    ClosedError,
    IncompleteReplyError,
    InternalError,
    LostReplyError,
    NoServerError,
    OverloadedError,
    PotclientError,
    QueryTimeoutError,
    ReadOnlyError,
    UnknownMapError,
    UsageError,
    error_from_reply,
)
from potclient.feed import FeedOptions
from potclient.holdout import HoldOut
from potclient.kernels import KernelSet
from potclient.link import _query_qos
from potclient.loadtest import LoadSettings, run_load
from potclient.play import Sending, play
from potclient.questions.control import CONTROL_TIMEOUT_S
from potclient.results import Receipt
from potclient.session import SessionOptions
from potschemas import messages
from potschemas.messages import ErrorCode, ReceiptStatus
from potschemas.wire import decode, encode, encode_array
from tests.integration.fake_server import FakeServer, free_port, kernels_of

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 30.0  # of a wait that must succeed; no test measures it


@pytest.fixture
def server() -> Iterator[FakeServer]:
    with FakeServer() as server:
        yield server


@pytest.fixture(autouse=True)
def numbers_from_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clouds that tests can name."""
    monkeypatch.setattr(feed, "first_number", lambda: 1)


@pytest.fixture
def client(server: FakeServer) -> Iterator[MapClient]:
    with MapClient(server.endpoint, timeout_s=LIMIT_S) as client:
        client.wait_ready(LIMIT_S)
        yield client


def cloud(n: int = 60, seed: int = 0) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.random.default_rng(seed).uniform(-3, 3, (n, 3)).astype(np.float32)


def pose(x: float = 0.0) -> np.ndarray[Any, np.dtype[np.float64]]:
    T = np.eye(4)
    T[0, 3] = x
    return T


# --- clouds in -----------------------------------------------------------------------------------------------------


def test_integrate_returns_the_receipt_with_its_kernels(server: FakeServer, client: MapClient) -> None:
    receipt = client.integrate(cloud(), pose(5.0), robot="r7", is_return=np.ones(60, bool))
    assert receipt.accepted
    assert (receipt.robot, receipt.seq, receipt.map_revision) == ("r7", 1, 1)
    assert isinstance(receipt.kernels, KernelSet)
    assert receipt.kernels.occupancy(cloud()[:1] + np.array([5, 0, 0])).mean[0] > 0.5
    sent = server.clouds[0]
    assert sent.robot == "r7"
    assert sent.is_return is not None
    assert client.integrate(cloud(), pose(), robot="r7").seq == 2


def test_integrate_without_a_pose_sends_none(server: FakeServer, client: MapClient) -> None:
    client.integrate(cloud()[:, :2], None, stamp_ns=123)
    assert server.clouds[0].T_map_sensor is None
    assert server.clouds[0].points.shape == [60, 2]
    assert server.clouds[0].stamp_ns == 123


def test_a_cloud_that_is_not_accepted_raises_with_its_receipt(server: FakeServer, client: MapClient) -> None:
    server.script.receipts = lambda cloud: ReceiptStatus.DROPPED
    with pytest.raises(OverloadedError) as caught:
        client.integrate(cloud(), pose())
    assert caught.value.receipt is not None
    assert caught.value.receipt.status is ReceiptStatus.DROPPED
    assert caught.value.retryable


@pytest.mark.parametrize("code", list(ErrorCode))
def test_every_error_code_has_its_exception(server: FakeServer, client: MapClient, code: ErrorCode) -> None:
    server.script.fail["integrate"] = code
    with pytest.raises(PotclientError) as caught:
        client.integrate(cloud(), pose())
    assert getattr(caught.value, "code", None) == code.value
    assert type(caught.value).__name__ != "MapServerError"
    assert (caught.value.retry_after_s == 0.01) == (code is ErrorCode.OVERLOADED)


def test_published_clouds_all_get_receipts_when_nothing_may_be_dropped(
    server: FakeServer, client: MapClient
) -> None:
    seen: list[Receipt] = []
    client.on_receipt = seen.append
    numbers = [client.publish(cloud(), pose(), robot="a", wait=True) for _ in range(10)]
    assert client.flush(LIMIT_S)
    assert [r.seq for r in client.receipts("a", LIMIT_S)] == numbers
    assert all(r.round_trip_s is not None for r in seen)
    counts = client.counts("a")
    assert (counts.offered, counts.accepted, counts.dropped_by_client) == (10, 10, 0)
    assert [c.seq for c in server.clouds] == numbers


def test_publishing_never_blocks_and_the_newest_cloud_wins(server: FakeServer, client: MapClient) -> None:
    server.script.receipt_gate.clear()
    for _ in range(20):
        last = client.publish(cloud(), pose(), robot="a")
    counts = client.counts("a")
    assert counts.offered == 20
    assert counts.in_flight <= 2
    assert counts.accounted
    server.script.receipt_gate.set()
    assert client.flush(LIMIT_S)
    counts = client.counts("a")
    assert counts.accepted == counts.sent < 20
    assert counts.accepted + counts.dropped_by_client == 20
    assert server.clouds[-1].seq == last


def test_a_lost_receipt_does_not_stall_the_feed(server: FakeServer) -> None:
    server.script.receipts = lambda cloud: None if cloud.seq <= 2 else ReceiptStatus.ACCEPTED
    with MapClient(server.endpoint, feed=FeedOptions(receipt_timeout_s=0.05)) as client:
        for _ in range(4):
            client.publish(cloud(), pose(), wait=True, timeout_s=LIMIT_S)
        assert client.flush(LIMIT_S)
        counts = client.counts()
    assert (counts.unknown, counts.accepted, counts.dropped_by_client) == (2, 2, 0)
    assert counts.accounted


def test_rejections_are_counted_with_their_reason(server: FakeServer, client: MapClient) -> None:
    server.script.receipts = lambda cloud: ReceiptStatus.REJECTED
    client.publish(cloud(), pose(), wait=True)
    receipts = list(client.receipts(timeout_s=LIMIT_S))
    assert [(r.status, r.reason) for r in receipts] == [(ReceiptStatus.REJECTED, "overloaded")]
    assert client.counts().rejected == 1


def test_two_processes_with_one_robot_id_keep_their_own_receipts(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.undo()  # numbers as they are
    with MapClient(server.endpoint) as one, MapClient(server.endpoint) as other:
        for client in (one, other):
            client.publish(cloud(), pose(), robot="a", wait=True)
            assert client.flush(LIMIT_S)
        for _ in range(3):
            other.publish(cloud(), pose(), robot="a", wait=True)
        assert other.flush(LIMIT_S)
        one.publish(cloud(), pose(), robot="a", wait=True)  # its receipt comes after those of the other's
        assert one.flush(LIMIT_S)
        assert (one.counts().accepted, other.counts().accepted) == (2, 4)
    warnings = [record for record in caplog.records if "another process" in record.getMessage()]
    assert 1 <= len(warnings) <= 2, "once a client"


def test_a_closed_subscription_is_forgotten(server: FakeServer, client: MapClient) -> None:
    before = list(client._link._subscriptions)
    for watch in (client.watch_revisions, client.watch_receipts, client.watch_stats, client.watch_params):
        with watch(lambda _: None) as subscription:  # type: ignore[operator]
            assert subscription in client._link._subscriptions
        subscription.close()
    assert client._link._subscriptions == before


@pytest.mark.parametrize(
    ("op", "priority", "is_express"),
    [
        ("points", zenoh.Priority.INTERACTIVE_HIGH, True),
        ("info", zenoh.Priority.INTERACTIVE_HIGH, True),
        ("grid", zenoh.Priority.DATA, False),
        ("params", zenoh.Priority.DATA, False),
        ("integrate", zenoh.Priority.DATA_LOW, False),
    ],
)
def test_bulk_answers_do_not_take_the_lane_of_short_ones(
    client: MapClient, op: str, priority: zenoh.Priority, is_express: bool
) -> None:
    lane = _query_qos(client.keys.query(op))
    assert (lane["priority"], lane["express"]) == (priority, is_express)


def test_a_message_of_another_kind_is_one_warning_line(
    server: FakeServer, client: MapClient, caplog: pytest.LogCaptureFixture
) -> None:
    ticks: queue.Queue[Any] = queue.Queue()
    with client.watch_revisions(ticks.put):
        client.info()  # a round trip: the server knows of the subscription
        server.session.put(client.keys.revision, b"\x93\x01\x02\x03")
        client.publish(cloud(), pose(), wait=True)
        ticks.get(timeout=LIMIT_S)
    (record,) = [r for r in caplog.records if client.keys.revision in r.getMessage()]
    assert (record.levelname, record.exc_info) == ("WARNING", None)


def test_transported_parameters_arrive(server: FakeServer) -> None:
    got: queue.Queue[Any] = queue.Queue()
    with MapClient(server.endpoint, feed=FeedOptions(on_params=got.put)) as client:
        client.publish(cloud(), pose(), robot="a", wait=True)
        params = got.get(timeout=LIMIT_S)
    assert (params.robot, params.seq, len(params.kernels)) == ("a", 1, 1)


def test_poses_arrive(server: FakeServer, client: MapClient) -> None:
    with pytest.raises(UsageError, match="T_map_sensor"):
        client.pose(np.eye(3), robot="a")
    while server.poses.empty():  # the pose stream may lose poses until both sides know of each other
        client.pose(pose(2.0), stamp_ns=5, robot="a")
    assert server.poses.get().stamp_ns == 5


def test_a_robot_that_publishes_is_alive_until_it_leaves(server: FakeServer) -> None:
    events: queue.Queue[Any] = queue.Queue()
    key = server.keys.robot_token("a")
    watch = server.session.liveliness().declare_subscriber(key, events.put)
    client = MapClient(server.endpoint)
    client.publish(cloud(), pose(), robot="a", wait=True)
    first = events.get(timeout=LIMIT_S)
    client.close()
    second = events.get(timeout=LIMIT_S)
    watch.undeclare()
    assert [str(e.kind).rsplit(".", 1)[-1] for e in (first, second)] == ["PUT", "DELETE"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((3, 4)), np.eye(4)), "shape"),
        ((np.zeros((3, 3)), np.eye(3)), "T_map_sensor"),
        (("abc", np.eye(4)), "numbers"),
    ],
)
def test_arguments_of_the_wrong_shape_are_refused_before_anything_is_sent(
    server: FakeServer, client: MapClient, arguments: tuple[Any, Any], message: str
) -> None:
    for send in (client.publish, client.integrate):
        with pytest.raises(UsageError, match=message):
            send(*arguments)
        with pytest.raises(UsageError, match="is_return"):
            send(cloud(), pose(), is_return=[True])
        with pytest.raises(UsageError, match="robot"):
            send(cloud(), pose(), robot="Not/An/Id")
    assert not server.clouds


# --- questions -----------------------------------------------------------------------------------------------------


def test_occupancy_is_what_the_kernels_say(client: MapClient) -> None:
    client.integrate(cloud(), pose())
    queries = cloud(500, seed=1)
    online, offline = client.occupancy(queries), client.params().occupancy(queries)
    for name in ("mean", "var", "latent_mean", "latent_var", "observed"):
        np.testing.assert_allclose(getattr(online, name), getattr(offline, name), atol=1e-5)
    assert online.revision == offline.revision == 1
    assert len(client.occupancy(np.zeros((0, 3)))) == 0
    assert client.occupancy([1.0, 2.0, 3.0]).mean.shape == (1,)


def test_requests_beyond_the_limit_are_split_and_stay_in_order(server: FakeServer, client: MapClient) -> None:
    client.integrate(cloud(20), pose())
    queries = np.random.default_rng(1).uniform(-4, 4, (22_001, 3))
    server.script.fail_once["points"] = [ErrorCode.OVERLOADED]
    answer = client.occupancy(queries)
    np.testing.assert_allclose(answer.mean, client.params().occupancy(queries).mean, atol=1e-6)
    assert server.queries.count("points") == 6, "five parts, one of them asked again"


def test_a_single_question_to_an_overloaded_server_fails_at_once(
    server: FakeServer, client: MapClient
) -> None:
    server.script.fail["points"] = ErrorCode.OVERLOADED
    with pytest.raises(OverloadedError) as caught:
        client.occupancy(cloud())
    assert caught.value.retry_after_s == 0.01
    assert server.queries.count("points") == 1


def test_a_grid_is_assembled_from_parts_in_any_order(client: MapClient) -> None:
    client.integrate(cloud(), pose())
    progress: list[tuple[int, int]] = []
    grid = client.grid([-2, -2, -2], [2, 1, 0.5], 0.5, progress=lambda *p: progress.append(p))
    assert grid.shape == (8, 6, 5)
    expected = client.occupancy(grid.centers().reshape(-1, 3))
    np.testing.assert_allclose(grid.mean.ravel(), expected.mean, atol=1e-6)
    np.testing.assert_array_equal(grid.observed.ravel(), expected.observed)
    assert progress == [(i + 1, 4) for i in range(4)]
    np.testing.assert_allclose(grid.centers()[0, 0, 0], [-1.75, -1.75, -1.75])


def test_a_grid_with_missing_parts_is_an_error(server: FakeServer, client: MapClient) -> None:
    server.script.skip_parts = {1}
    with pytest.raises(IncompleteReplyError, match="3 of 4 parts"):
        client.grid([-2, -2, -2], [2, 1, 0.5], 0.5)


def test_a_grid_of_two_revisions_is_an_error(server: FakeServer, client: MapClient) -> None:
    server.script.mixed_revisions = True
    with pytest.raises(IncompleteReplyError, match="map_revision 0 and 1"):
        client.grid([-2, -2, -2], [2, 1, 0.5], 0.5)


@pytest.mark.parametrize(
    ("lower", "upper", "resolution"),
    [
        ([0, 0, 0], [0, 1, 1], 0.5),
        ([0, 0, 0], [1, 1, 1], 0.0),
        ([0, 0], [1, 1], 1.0),
        ([0, 0, np.nan], [1, 1, 1], 1.0),
    ],
)
def test_boxes_that_are_none_are_refused(
    client: MapClient, lower: Any, upper: Any, resolution: float
) -> None:
    with pytest.raises(UsageError):
        client.grid(lower, upper, resolution)


def test_params_of_a_box(client: MapClient) -> None:
    client.integrate(cloud(), pose())
    assert len(client.params()) == 60
    inside = client.params([0, 0, 0], [3, 3, 3])
    assert 0 < len(inside) < 60
    assert (inside.hinge_mean >= 0).all()


def test_atoms_info_stats_and_control(client: MapClient) -> None:
    client.integrate(cloud(), pose())
    assert [a.atom_id for a in client.atoms()] == ["wall.1"]
    atom = client.atom("wall.1")
    assert (atom.hit_points.shape, len(atom.kernels)) == ((4, 3), 2)
    assert client.info().n_kernels == 60
    assert client.stats().server == client.stats("fake").server == "fake"
    assert client.control("clear").map_revision == 2
    assert client.info().n_kernels == 0


def test_a_map_is_saved_and_loaded_by_name(client: MapClient) -> None:
    client.integrate(cloud(), pose())
    assert client.save().message == "saved"
    assert client.save("before-the-rain").message == "saved as before-the-rain"
    client.control("clear")
    reply = client.load("before-the-rain")
    assert (reply.verb, reply.map_revision, client.info().n_kernels) == ("load", 3, 60)
    with pytest.raises(UnknownMapError, match="no map other"):
        client.load("other")
    with pytest.raises(UsageError, match="is not an id"):
        client.save("../elsewhere")


def test_an_atom_travels_both_ways_unchanged(client: MapClient, server: FakeServer, tmp_path: Path) -> None:
    fetched = client.atom("wall.1")
    fetched.save(tmp_path / "wall.atom")
    made = Atom.create(
        "wall.2", fetched.hit_points.tolist(), fetched.free_points, Atom.load(tmp_path / "wall.atom").kernels,
        dims=3, radius_m=10, azimuth_width_rad=1.2, provenance={"source": "fake"},
    )  # fmt: skip
    changed = client.add_atom(made)
    assert (changed.atom_id, changed.n_atoms, changed.persisted) == ("wall.2", 2, True)
    sent = server.atoms[-1]
    assert sent.info == msgspec.structs.replace(fetched.info, atom_id="wall.2", times_used=0)
    assert sent.hit_points == encode_array(fetched.hit_points)
    assert sent.kernels == fetched.kernels.to_message()
    assert not client.remove_atom("wall.2").persisted


def test_a_refused_atom_is_a_typed_error_with_its_reason(client: MapClient, server: FakeServer) -> None:
    atom = client.atom("wall.1")
    server.script.fail_once["atoms"] = [ErrorCode.ATOM_REFUSED, ErrorCode.READ_ONLY]
    with pytest.raises(AtomRefusedError):
        client.add_atom(atom)
    with pytest.raises(ReadOnlyError) as read_only:
        client.remove_atom("wall.1")
    assert read_only.value.reason is None
    reply = messages.ErrorReply(code=ErrorCode.ATOM_REFUSED, message="a twin", reason="duplicate")
    assert error_from_reply(decode(encode(reply), messages.ErrorReply)).reason == "duplicate"


def test_arrays_that_are_no_atom(tmp_path: Path) -> None:
    kernels = KernelSet.from_message(kernels_of(np.zeros((1, 3)), 0).to_message())
    sector = {"dims": 3, "radius_m": 1.0, "azimuth_width_rad": 1.0}
    for hits in (np.zeros((3, 2)), "no numbers", np.zeros(3)):
        with pytest.raises(UsageError, match="hit_points"):
            Atom.create("a", hits, np.zeros((1, 3)), kernels, **sector)
    with pytest.raises(UsageError, match="dimensions"):
        Atom.create("a", np.zeros((1, 3)), np.zeros((1, 3)), kernels, **sector | {"dims": 4})
    with pytest.raises(UsageError, match="No such file"):
        Atom.load(tmp_path / "none.atom")
    (tmp_path / "x.atom").write_bytes(b"PK nonsense")
    with pytest.raises(UsageError, match="potserver atoms export"):
        Atom.load(tmp_path / "x.atom")


def test_an_unknown_verb_is_not_a_missing_server(client: MapClient) -> None:
    with pytest.raises(LostReplyError, match="does not offer"):
        client.control("fly")


def test_many_threads_share_a_client(client: MapClient) -> None:
    client.integrate(cloud(), pose())
    queries = [cloud(50, seed=i) for i in range(8)]
    expected = [client.params().occupancy(q).mean for q in queries]
    results: dict[int, Any] = {}

    def ask(i: int) -> None:
        results[i] = [client.occupancy(queries[i]).mean for _ in range(5)]

    threads = [threading.Thread(target=ask, args=(i,)) for i in range(8)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    for i, answers in results.items():
        for answer in answers:
            np.testing.assert_allclose(answer, expected[i], atol=1e-5)
    assert len(results) == 8


# --- streams -------------------------------------------------------------------------------------------------------


def test_revisions_receipts_and_stats_can_be_watched(server: FakeServer, client: MapClient) -> None:
    events: queue.Queue[Any] = queue.Queue()

    def broken(_: messages.Revision) -> None:
        raise RuntimeError("a callback of the user's")

    client.watch_revisions(broken)
    subscription = client.watch_revisions(events.put)
    client.watch_receipts(events.put)
    client.watch_params(events.put)
    client.watch_stats(events.put)
    kinds: set[str] = set()
    while len(kinds) < 4:  # until both sides know of each other, what is published has no listener
        client.publish(cloud(), pose(), robot="a", wait=True)
        server.publish_stats()
        kinds.add(type(events.get(timeout=LIMIT_S)).__name__)
        while not events.empty():
            kinds.add(type(events.get()).__name__)
    assert kinds == {"Revision", "Receipt", "TransportedParams", "Stats"}
    subscription.close()


# --- silence -------------------------------------------------------------------------------------------------------


def test_nobody_listens() -> None:
    with pytest.raises(NoServerError, match="potserver serve"):
        MapClient(f"tcp/127.0.0.1:{free_port()}")


def test_waiting_for_somebody_to_listen_ends() -> None:
    options = SessionOptions(connect=(f"tcp/127.0.0.1:{free_port()}",), connect_timeout_s=0.2)
    with pytest.raises(NoServerError, match=r"within 0\.2 s"):
        MapClient(options=options)


def test_a_client_may_come_before_its_server() -> None:
    port = free_port()
    servers: list[FakeServer] = []
    late = threading.Timer(0.2, lambda: servers.append(FakeServer(port=port)))
    late.start()
    options = SessionOptions(connect=(f"tcp/127.0.0.1:{port}",), connect_timeout_s=LIMIT_S)
    try:
        with MapClient(options=options) as client:
            assert client.wait_ready(LIMIT_S) == "fake"
    finally:
        late.join()
        servers[0].close()


def test_another_map_than_the_served_one(server: FakeServer) -> None:
    with MapClient(server.endpoint, map="other") as client:
        with pytest.raises(NoServerError, match="maps served here: default"):
            client.info()
        with pytest.raises(NoServerError, match="maps served here: default"):
            client.wait_ready(0.01)


def test_a_server_that_is_not_warm_yet() -> None:
    with FakeServer(ready=False) as server, MapClient(server.endpoint) as client:
        server.script.silent = {"info"}
        client.wait_for_match("info", LIMIT_S)
        with pytest.raises(NoServerError, match="not ready"):
            client.info()
        server.declare_ready()
        assert client.wait_ready(LIMIT_S) == "fake"


def test_a_question_that_the_server_drops(server: FakeServer, client: MapClient) -> None:
    server.script.silent = {"points"}
    client.wait_for_match("points", LIMIT_S)
    with pytest.raises(LostReplyError, match="access control"):
        client.occupancy(cloud())


def test_a_server_that_thinks_for_ever(server: FakeServer, client: MapClient) -> None:
    server.script.hold = {"points", "info"}
    with pytest.raises(QueryTimeoutError, match=r"within 0\.1 s") as caught:
        client.occupancy(cloud(), timeout_s=0.1)
    assert isinstance(caught.value, TimeoutError)
    with pytest.raises(QueryTimeoutError):
        client.info(timeout_s=0.1)


def test_who_gave_up_on_a_change_of_the_map_is_told_that_it_may_come(
    server: FakeServer, client: MapClient
) -> None:
    server.script.hold = {"ctl-merge"}
    with pytest.raises(QueryTimeoutError, match="look at the map's revision before you ask again"):
        client.merge("north", timeout_s=0.1)


def test_changes_of_the_map_are_waited_for_longer_than_answers(server: FakeServer, client: MapClient) -> None:
    """A merge that was given up on and asked for again would count twice."""
    with MapClient(server.endpoint, timeout_s=0.5) as hasty:
        hasty.control("clear")
    assert server.clears[-1].timeout_s == CONTROL_TIMEOUT_S > 60.0
    client.control("clear", timeout_s=2.0)
    assert server.clears[-1].timeout_s == 2.0


def test_a_server_that_is_killed_with_the_question_in_flight() -> None:
    program = """
import sys
from tests.integration.fake_server import FakeServer
server = FakeServer()
server.script.hold = {"points"}
print(server.endpoint, flush=True)
while "points" not in server.queries:
    pass
print("asked", flush=True)
sys.stdin.read()
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdin is not None
    assert process.stdout is not None
    with process, MapClient(process.stdout.readline().strip(), timeout_s=LIMIT_S) as client:
        client.wait_ready(LIMIT_S)
        errors: list[PotclientError] = []

        def ask() -> None:
            try:
                client.occupancy(cloud())
            except PotclientError as error:
                errors.append(error)

        asking = threading.Thread(target=ask, daemon=True)
        asking.start()
        assert process.stdout.readline() == "asked\n"
        process.kill()
        asking.join(LIMIT_S)
    assert [type(e) for e in errors] in ([NoServerError], [LostReplyError])
    assert errors[0].retryable


def test_an_answer_that_is_no_message(server: FakeServer, client: MapClient) -> None:
    server.script.garbage = {"points", "grid"}
    with pytest.raises(BadReplyError):
        client.occupancy(cloud())
    with pytest.raises(BadReplyError):
        client.grid([0, 0, 0], [1, 1, 1], 0.5)


def test_a_server_bug_is_an_internal_error(server: FakeServer, client: MapClient) -> None:
    server.script.fail["grid"] = ErrorCode.INTERNAL
    with pytest.raises(InternalError):
        client.grid([0, 0, 0], [1, 1, 1], 0.5)


def test_a_server_that_goes_away_and_comes_back() -> None:
    port = free_port()
    with FakeServer(port=port) as first:
        client = MapClient(first.endpoint, timeout_s=LIMIT_S)
        client.wait_ready(LIMIT_S)
        client.publish(cloud(), pose(), wait=True)
        assert client.flush(LIMIT_S)
    try:
        with pytest.raises(NoServerError):
            client.info()
        before = client.counts()
        client.publish(cloud(), pose())
        with FakeServer(port=port) as second:
            client.wait_ready(LIMIT_S)
            assert client.flush(LIMIT_S), "a cloud that waited for a server reaches the next one"
            assert client.counts().accepted == before.accepted + 1
            assert len(second.clouds) == 1
            assert client.info().server == "fake"
    finally:
        client.close()


# --- the end -------------------------------------------------------------------------------------------------------


def test_a_closed_client_says_so(server: FakeServer) -> None:
    client = MapClient(server.endpoint)
    client.publish(cloud(), pose(), wait=True)
    client.close()
    client.close()
    for call in (
        client.info,
        client.wait_ready,
        lambda: client.publish(cloud(), pose()),
        lambda: client.pose(pose()),
    ):
        with pytest.raises(ClosedError):
            call()
    assert client.counts().accounted
    assert client.flush(0.0)


def test_closing_from_a_callback_ends(server: FakeServer) -> None:
    closed = threading.Event()
    client = MapClient(server.endpoint)

    def on_receipt(_: Receipt) -> None:
        client.close()
        closed.set()

    client.on_receipt = on_receipt
    client.publish(cloud(), pose())
    assert closed.wait(LIMIT_S)


@pytest.mark.parametrize(
    ("ending", "status"), [("pass", 0), ("raise SystemExit(3)", 3), ("raise RuntimeError('x')", 1)]
)
def test_a_process_that_forgets_to_close_ends(server: FakeServer, ending: str, status: int) -> None:
    program = f"""
import numpy as np
from potclient import FeedOptions, MapClient
client = MapClient({server.endpoint!r}, feed=FeedOptions(on_receipt=print))
client.watch_revisions(print)
client.publish(np.ones((5, 3)), np.eye(4), wait=True)
client.info()
{ending}
"""
    done = subprocess.run(
        [sys.executable, "-c", program], timeout=LIMIT_S * 2, capture_output=True, text=True, check=False
    )
    assert done.returncode == status, done.stderr


def test_first_messages_may_come_on_many_threads_at_once() -> None:
    program = """
import sys, threading
from potclient.link import decoded as _decode
from potschemas import messages
from potschemas.wire import encode
import zenoh
sys.setswitchinterval(1e-6)
payload = zenoh.ZBytes(encode(messages.Receipt(map="m", robot="r", seq=1, status=messages.ReceiptStatus.ACCEPTED)))
start = threading.Barrier(24)
def first():
    start.wait()
    _decode(payload, messages.Receipt)
threads = [threading.Thread(target=first) for _ in range(24)]
for t in threads: t.start()
for t in threads: t.join()
"""
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", program], timeout=LIMIT_S * 2, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert not done.stderr


def test_the_client_imports_nothing_heavy() -> None:
    program = """
import sys, potclient, potclient.cli, potclient.loadtest, potclient.play
heavy = {"torch", "open3d", "numba", "potserver", "matplotlib", "rich", "pypcd4", "plyfile", "scipy"} & set(sys.modules)
sys.exit(f"imported {sorted(heavy)}" if heavy else 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], timeout=LIMIT_S * 2, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


# --- the programs built on it --------------------------------------------------------------------------------------


@pytest.mark.parametrize("acknowledged", [False, True])
def test_playing_a_recording_accounts_for_every_scan(
    server: FakeServer, client: MapClient, acknowledged: bool
) -> None:
    recording = open_dataset("generated:2d", n_generated=5)
    seen: list[int] = []
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
    assert {c.points.shape[1] for c in server.clouds} == {2}, "that is how a server knows planar scans"
    sent = [c.points.shape[0] for c in server.clouds]
    assert sent == [s.n_points for s in report.scans]
    assert all(n < len(scan) for n, scan in zip(sent, recording, strict=True)), (
        "held-out beams are never sent"
    )
    stamps = [c.stamp_ns for c in server.clouds]
    assert stamps == sorted(set(stamps))


def test_a_scan_that_is_not_accepted_shows_in_the_report(server: FakeServer, client: MapClient) -> None:
    server.script.receipts = lambda c: ReceiptStatus.REJECTED if c.seq == 2 else ReceiptStatus.ACCEPTED
    report = play(client, open_dataset("generated:2d", n_generated=3))
    assert not report.all_accepted
    assert [s.status for s in report.scans] == ["accepted", "rejected", "accepted"]
    assert report.to_json()["counts"]["rejected"] == 1
    assert client.on_receipt is None


def test_a_recording_that_fails_midway_reports_what_was_sent(server: FakeServer, client: MapClient) -> None:
    server.script.fail["integrate"] = ErrorCode.INTERNAL  # booked as rejected: the server answered
    sent = 0

    def close_after_two(_: Any) -> None:
        nonlocal sent
        sent += 1
        if sent == 2:
            client.close()

    report = play(
        client,
        open_dataset("generated:2d", n_generated=4),
        Sending(acknowledged=True),
        on_outcome=close_after_two,
    )
    assert isinstance(report.failure, ClosedError)
    assert report.to_json()["failure"] == "the client is closed"
    assert [s.status for s in report.scans] == ["rejected", "rejected"]
    assert not report.all_accepted


def test_a_load_test_accounts_for_every_cloud(server: FakeServer) -> None:
    settings = LoadSettings(
        robots=2, rate_hz=40, planners=1, planner_hz=40, duration_s=0.5, n_points=50, query_points=20
    )
    server.script.receipts = lambda c: ReceiptStatus.REJECTED if c.seq % 3 == 0 else ReceiptStatus.ACCEPTED
    report = run_load(
        settings,
        open_dataset("generated:2d", n_generated=3),
        options=SessionOptions(connect=(server.endpoint,)),
    )
    c = report.clouds
    assert report.nothing_lost
    assert c.offered == c.dropped_by_client + c.accepted + c.dropped + c.rejected + c.unknown > 0
    assert sum(report.reasons.values()) == c.rejected > 0
    assert report.receipts.n == c.accepted + c.rejected
    assert report.asked == report.answered == report.queries.n > 0
    assert report.server_stats is not None
    assert report.to_json()["nothing_lost"] is True


def test_a_load_test_that_loses_receipts_says_so(server: FakeServer) -> None:
    server.script.receipts = lambda c: None
    server.script.fail["points"] = ErrorCode.INTERNAL
    settings = LoadSettings(
        robots=1, rate_hz=20, planners=1, duration_s=0.2, n_points=50, query_points=20, receipt_timeout_s=0.1
    )
    report = run_load(
        settings, open_dataset("generated:2d"), options=SessionOptions(connect=(server.endpoint,))
    )
    assert not report.nothing_lost
    assert report.clouds.unknown > 0
    assert report.clouds.accounted
    assert report.failed == {"InternalError": report.asked}


def test_a_question_whose_client_is_closed_meanwhile_says_so(
    server: FakeServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    with MapClient(server.endpoint, map="nobody.serves.this", timeout_s=0.5) as client:

        def close_and_ask(querier: zenoh.Querier) -> bool:
            client.close()
            return bool(querier.matching_status)

        monkeypatch.setattr("potclient.link.is_matching", close_and_ask)
        with pytest.raises(ClosedError):
            client.info()
