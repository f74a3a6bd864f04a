"""A raw Zenoh client that never waits without a deadline, servers on free ports, and a mapper that tests can hold still."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import json
import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh

from potclient import MapClient
from potclient.cli import main
from potschemas import messages, wire
from potschemas.answers import AnswerRule
from potschemas.keys import MapKeys, stats_key
from potserver.config import Settings, load_settings
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.types import KernelSet, MapUpdate, Occupancy, OwnMap, ParamsKind, Scan, TileChange
from potserver.mapping.pipeline import ScanMap
from potserver.mapping.settings import MappingSettings
from potserver.server import MapServer

from .rooms import pose, room

DEADLINE_S = 30.0
ROOT = "pot/v1"
Run = Callable[..., tuple[int, str, str]]  # the fixtures `run` and `run_at`
MakeRig = Callable[..., "Rig"]  # the fixture `make_rig`
_BY_SCHEMA = {kind.schema: kind for kind in messages.ALL_MESSAGES}


def until(condition: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S) -> Any:
    """Wait for a condition that nothing signals; its value."""
    end = time.monotonic() + deadline_s
    while not (value := condition()):
        assert time.monotonic() < end, f"not within {deadline_s} s: {what}"
        threading.Event().wait(0.005)
    return value


def decode_any(payload: zenoh.ZBytes, encoding: zenoh.Encoding) -> messages.Message:
    """A message by the schema that its encoding names."""
    mime, _, schema = str(encoding).partition(";")
    assert mime == wire.MIME, encoding
    return wire.decode(payload.to_bytes(), _BY_SCHEMA[schema])


class Client:
    """One Zenoh session in client mode, asking about one map."""

    def __init__(self, endpoint: str, *, map_id: str = "default", root: str = ROOT) -> None:
        config = zenoh.Config()
        for key, value in {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "scouting/multicast/enabled": False,
            # as the server does: replies over shared memory are not safe
            "transport/shared_memory/transport_optimization/messages": ["put"],
        }.items():
            config.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(config)
        self.keys = MapKeys(root, map_id)
        self._publishers: dict[str, zenoh.Publisher] = {}

    def close(self) -> None:
        self.session.close()

    def get(
        self, key: str, payload: Any = None, *, encoding: str | None = None, timeout_s: float = DEADLINE_S
    ) -> list[messages.Message]:
        """All replies to a query, errors among them; an empty list means that nobody answered."""
        if isinstance(payload, messages.Message):
            encoding = encoding or wire.encoding_of(payload)
            payload = wire.encode(payload)
        replies = self.session.get(
            key,
            payload=payload,
            encoding=encoding,
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        answers = []
        for reply in replies:
            answer = reply.ok or reply.err
            assert answer is not None
            assert answer.payload.to_bytes() != b"Timeout", f"{key}: timed out"
            answers.append(decode_any(answer.payload, answer.encoding))
        return answers

    def ask(self, op: str, payload: Any = None, **options: Any) -> list[messages.Message]:
        """All replies to `q/<op>`, or to the `integrate` of the robot that a cloud names; at least one."""
        robot = getattr(payload, "robot", None) or "r1"
        key = self.keys.integrate(robot) if op == "integrate" else self.keys.query(op)
        answers = self.get(key, payload, **options)
        assert answers, f"nobody answered {op}"
        return answers

    def one(self, op: str, payload: Any = None, **options: Any) -> Any:
        """The only reply to `q/<op>`, which is not an error."""
        (answer,) = self.ask(op, payload, **options)
        assert not isinstance(answer, messages.ErrorReply), answer
        return answer

    def error(self, op: str, payload: Any = None, **options: Any) -> messages.ErrorReply:
        """The error that `q/<op>` ends in."""
        (answer,) = self.ask(op, payload, **options)
        assert isinstance(answer, messages.ErrorReply), answer
        return answer

    def control(self, verb: str, payload: Any = None) -> Any:
        """The only reply to `ctl/<verb>`."""
        (answer,) = self.get(self.keys.control(verb), payload)
        return answer

    def stats(self, server_id: str = "potserver") -> messages.Stats:
        """The server's counters now."""
        (answer,) = self.get(stats_key(self.keys.root, server_id))
        assert isinstance(answer, messages.Stats)
        return answer

    def listen(self, key: str) -> queue.Queue[Any]:
        """Messages on a key from now on."""
        inbox: queue.Queue[Any] = queue.Queue()
        self.session.declare_subscriber(key, lambda s: inbox.put(decode_any(s.payload, s.encoding)))
        self.ask("info")  # a round trip: the server has seen the declaration
        return inbox

    def receipts(self, robot: str = "*") -> queue.Queue[messages.Receipt]:
        """Receipts of a robot from now on."""
        return self.listen(self.keys.receipt(robot))

    def put(self, key: str, payload: bytes, encoding: str | None = None) -> None:
        """Publish, once somebody listens."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self.session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.BLOCK, priority=zenoh.Priority.DATA_LOW
            )
        until(lambda: publisher.matching_status.matching, f"a subscriber of {key}")
        publisher.put(payload, encoding=encoding)

    def put_cloud(self, cloud: messages.Cloud, robot: str = "r1") -> None:
        """Publish a cloud."""
        self.put(self.keys.cloud(robot), wire.encode(cloud), wire.encoding_of(cloud))

    def alive(self, key: str) -> list[str]:
        """Liveliness tokens now."""
        return [str(r.ok.key_expr) for r in self.session.liveliness().get(key, timeout=DEADLINE_S) if r.ok]


def make_cloud(seq: int = 0, **changes: Any) -> messages.Cloud:
    """A small room seen from its middle, one metre above the floor."""
    rng = np.random.default_rng(5)
    angle = rng.uniform(-np.pi, np.pi, 600)
    walls = np.stack([6 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-1, 2, 600)], axis=1)
    fields: dict[str, Any] = {
        "seq": seq,
        "stamp_ns": 1_000_000_000 + seq * 100_000_000,
        "points": wire.encode_array(walls.astype(np.float32)),
        "T_map_sensor": wire.encode_array(np.eye(4)),
    }
    return messages.Cloud(**fields | changes)


def points_query(points: Any, **changes: Any) -> messages.PointsQuery:
    """Ask at these points."""
    return messages.PointsQuery(points=wire.encode_array(np.asarray(points, np.float64)), **changes)


HERE = points_query([[0.0, 0, 0]])


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


def pose_message(stamp_ns: int, x_m: float) -> messages.Pose:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return messages.Pose(stamp_ns=stamp_ns, T_map_sensor=wire.encode_array(pose))


# --- a mapper without mathematics, that can be held ---------------------------------------------------------


class FakeSnapshot:
    rule = AnswerRule(observed_activation=0.05, prior_var=50.0, residual_var=50.0)
    lean = None

    def __init__(self, owner: FakeMapper, kernels: KernelSet, map_revision: int) -> None:
        self._owner, self.kernels, self.map_revision = owner, kernels, map_revision
        real = KernelMap(kernels, threads=1)
        self.parts, self.box = real.parts, real.box

    def __len__(self) -> int:
        return len(self.kernels)

    def occupancy(self, points: Any, **_: Any) -> Occupancy:
        self._owner.queries.pass_through()
        n = len(points)
        return Occupancy(
            mean=np.full(n, 0.5),
            var=np.full(n, 0.1),
            latent_mean=np.zeros(n, np.float32),
            latent_var=np.full(n, 50.0, np.float32),
            observed=np.zeros(n, bool),
            borrowed=np.zeros(n, np.float32),
            map_revision=self.map_revision,
        )

    def occupancy_of_cells(self, _cells: Any, first: int, last: int, **_: Any) -> Occupancy:
        return self.occupancy(np.zeros((last - first, 3)))


class Gate:
    """Where a test can hold the threads of a server."""

    def __init__(self) -> None:
        self._open = threading.Event()
        self._open.set()
        self.entered: queue.Queue[int] = queue.Queue()

    def hold(self) -> None:
        self._open.clear()

    def release(self) -> None:
        self._open.set()

    def wait_entered(self) -> None:
        self.entered.get(timeout=DEADLINE_S)

    def pass_through(self) -> None:
        self.entered.put(1)
        assert self._open.wait(DEADLINE_S), "the test never released the gate"


class FakeMapper:
    """Takes every fifth point as a kernel."""

    def __init__(self, map_id: str = "default") -> None:
        self.map_id = map_id
        self.settings = MappingSettings()
        self.dictionary = AtomDictionary(())
        self.atom_usage: collections.Counter[str] = collections.Counter()
        self.state = MapState(snapshot=FakeSnapshot(self, KernelSet.empty(), 0))  # type: ignore[arg-type]
        self.scans: list[Scan] = []
        self.params: list[ParamsKind] = []
        self.failure: Exception | None = None
        self.mapping, self.queries, self.warming = Gate(), Gate(), Gate()

    @property
    def snapshot(self) -> Any:
        return self.state.snapshot

    @property
    def n_scans(self) -> int:
        return self.state.n_scans

    def _become(self, kernels: KernelSet, n_scans: int) -> None:
        snapshot: Any = FakeSnapshot(self, kernels, self.state.map_revision + 1)
        self.state = dataclasses.replace(self.state, snapshot=snapshot, n_scans=n_scans)

    def integrate(
        self, scan: Scan, *, params: ParamsKind, commit: Callable[[], None] | None = None
    ) -> MapUpdate:
        self.params.append(params)
        self.mapping.pass_through()
        if self.failure is not None:
            raise self.failure
        if commit is not None:
            commit()
        self.scans.append(scan)
        points = (scan.points @ scan.T_map_sensor[:3, :3].T + scan.T_map_sensor[:3, 3])[::5]
        k = len(points)
        one = np.ones(k, np.float32)
        kernels = KernelSet(
            hinge_mean=points.astype(np.float64),
            hinge_var=np.ones((k, 3), np.float32),
            gamma_shape=one,
            gamma_rate=one,
            weight_mean=one,
            weight_var=one,
        )
        whole = KernelSet.concatenate([self.snapshot.kernels, kernels])
        self._become(whole, self.n_scans + 1)
        return MapUpdate(
            map_revision=self.snapshot.map_revision,
            own=OwnMap.nothing() if params is ParamsKind.NONE else ScanMap([], kernels, kernels, True).told,
            n_points=len(scan.points),
            n_kernels_added=k,
            n_kernels_transported=0,
            converged=True,
            rule=FakeSnapshot.rule,
            map_kernels=len(whole),
            changed=TileChange(10.0, [(0, 0, 0)]),
            timings_ms={},
        )

    def use_dictionary(self, dictionary: AtomDictionary) -> None:
        self.dictionary = dictionary

    def clear(self, *, commit: Any = None) -> TileChange:
        tiles = np.unique(np.floor(self.snapshot.kernels.hinge_mean / 10.0).astype(int), axis=0)
        self._become(KernelSet.empty(), 0)
        return TileChange(10.0, [(int(x), int(y), int(z)) for x, y, z in tiles])

    def warm_up(self, *, transported: bool = True) -> None:
        self.warming.pass_through()


class Rig:
    """A server with fake mappers, and clients of it."""

    def __init__(self, settings: Settings) -> None:
        self.mappers = {map_id: FakeMapper(map_id) for map_id in settings.maps}
        self.server = MapServer(settings, listen="tcp/127.0.0.1:0", make_map=self._mapper_of)
        self._clients: list[Client] = []

    @property
    def mapper(self) -> FakeMapper:
        return self.mappers["default"]

    def client(self, **options: Any) -> Client:
        client = Client(self.server.endpoint, **options)
        self._clients.append(client)
        return client

    def close(self) -> None:
        for mapper in self.mappers.values():
            for gate in (mapper.mapping, mapper.queries, mapper.warming):
                gate.release()
        for client in self._clients:
            client.close()
        self.server.stop()

    def _mapper_of(self, map_id: str) -> Any:
        return self.mappers[map_id]


@pytest.fixture
def make_rig() -> Iterator[MakeRig]:
    """Makes servers with fake mappers; keyword arguments are dotted settings with `__` for the dot."""
    with contextlib.ExitStack() as stack:

        def make(*, start: bool = True, **changes: Any) -> Rig:
            overrides = {key.replace("__", "."): value for key, value in changes.items()}
            rig = Rig(load_settings(overrides=overrides))
            stack.callback(rig.close)
            if start:
                rig.server.start()
            return rig

        yield make


@pytest.fixture(scope="session")
def real_server() -> Iterator[MapServer]:
    """One server with the real mapper, for tests that leave its map as it was."""
    settings = load_settings(
        overrides={
            "mapping.max_range_m": 15.0,
            "mapping.beams_per_scan": 1000,
            "limits.max_cloud_bytes": 200_000,
            "limits.max_cloud_points": 5000,
            "limits.max_query_bytes": 100_000,
            "limits.max_query_points": 2000,
            "limits.max_grid_cells": 100_000,
            "limits.max_coordinate_m": 1e6,
        }
    )
    with MapServer(settings, listen="tcp/127.0.0.1:0") as server:
        yield server


@pytest.fixture
def real_client(real_server: MapServer) -> Iterator[Client]:
    """A client of `real_server`, whose map holds at least one scan."""
    client = Client(real_server.endpoint)
    if client.one("info").n_scans == 0:
        client.one("integrate", make_cloud(robot="base"))
    yield client
    client.close()


# --- a map behind a `MapClient` ------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def map_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MapServer]:
    """A server with the real mapper and a store, for tests that may change its map."""
    settings = load_settings(
        overrides={
            "mapping.max_range_m": 12.0,
            "mapping.beams_per_scan": 600,
            "limits.max_query_points": 5000,
            "store.directory": str(tmp_path_factory.mktemp("store")),
            "store.fsync": False,
            "atoms.writable": True,
        }
    )
    with MapServer(settings, listen="tcp/127.0.0.1:0") as server:
        yield server


@pytest.fixture
def map_client(map_server: MapServer) -> Iterator[MapClient]:
    """A client of `map_server`, whose map is empty."""
    with MapClient(map_server.endpoint, timeout_s=DEADLINE_S) as client:
        client.wait_ready()
        client.control("clear")
        yield client


@pytest.fixture
def run_at(capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs one command line in this process, against the server at an endpoint: status, stdout, stderr."""

    def command(endpoint: str, *words: str) -> tuple[int, str, str]:
        status = main([*words, "-e", endpoint])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return command


@pytest.fixture
def run(run_at: Run, map_server: MapServer, map_client: MapClient) -> Run:
    """Runs one command line against a server whose map has seen a room."""
    map_client.integrate(room(), pose())
    return lambda *words: run_at(map_server.endpoint, *words)
