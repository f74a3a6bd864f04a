"""A load test against any server: robots that publish, planners that ask, and a place for every cloud at the end."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np

from potclient.arrays import Float64
from potclient.client import MapClient
from potclient.datasets.scans import RecordedScan, Recording
from potclient.errors import OverloadedError, PotclientError, TooManyError, UsageError
from potclient.feed import FeedOptions
from potclient.results import FeedCounts, Receipt
from potclient.session import SessionOptions
from potschemas.keys import DEFAULT_ROOT

_MAX_SCANS = 20  # kept in memory and repeated


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class LoadSettings:
    """What to do to the server, and for how long."""

    robots: int = 4
    rate_hz: float = 5.0  # clouds a second a robot
    planners: int = 2
    planner_hz: float = 10.0  # questions a second a planner, at most
    duration_s: float = 10.0
    n_points: int = 5_000  # a cloud
    query_points: int = 1_000  # a question
    receipt_timeout_s: float = 30.0
    query_timeout_s: float = 10.0
    robot_prefix: str = "load"
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 <= self.robots <= 256 and 0 <= self.planners <= 256 and self.robots + self.planners > 0):
            raise UsageError("load: need 0 to 256 robots and planners, at least one of either")
        if not (0 < self.rate_hz <= 1000 and 0 < self.planner_hz <= 10_000 and 0 < self.duration_s <= 86_400):
            raise UsageError("load: rates must be positive and sane, the duration at most a day")
        if self.n_points < 1 or self.query_points < 1:
            raise UsageError("load: clouds and questions need at least one point")


class Percentiles(NamedTuple):
    """Of one kind of latency, ms; NaN when nothing was measured."""

    n: int
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float

    @classmethod
    def of(cls, values_s: list[float]) -> Percentiles:
        """Of latencies in seconds."""
        if not values_s:
            return cls(0, *[float("nan")] * 4)
        p50, p95, p99, top = np.percentile(np.asarray(values_s) * 1e3, (50, 95, 99, 100))
        return cls(len(values_s), float(p50), float(p95), float(p99), float(top))


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class LoadReport:
    """What came back."""

    settings: LoadSettings
    elapsed_s: float
    clouds: FeedCounts
    reasons: dict[str, int]  # of clouds that the server dropped or rejected, `status.reason`
    receipts: Percentiles  # put to receipt
    integrate: Percentiles  # the mapper's own time, from the receipts
    asked: int
    answered: int
    overloaded: int
    failed: dict[str, int]  # other failures of questions, by error class
    queries: Percentiles
    examples: dict[str, str]  # one message a kind of failure
    server_stats: dict[str, Any] | None = None
    interrupted: bool = False  # by ^C

    @property
    def nothing_lost(self) -> bool:
        """Every cloud has a known fate and no question failed for another reason than overload."""
        return (
            self.clouds.accounted
            and self.clouds.unknown == 0
            and not self.failed
            and not self.clouds.in_flight
        )

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        tree = dataclasses.asdict(self)
        for name in ("receipts", "integrate", "queries"):
            tree[name] = getattr(self, name)._asdict()
        tree["nothing_lost"] = self.nothing_lost
        return tree


class _Tally:
    """What all threads measured."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.receipt_s: list[float] = []
        self.integrate_s: list[float] = []
        self.reasons: Counter[str] = Counter()
        self.query_s: list[float] = []
        self.asked = self.overloaded = 0
        self.failed: Counter[str] = Counter()
        self.examples: dict[str, str] = {}
        self.counts = FeedCounts()

    def on_receipt(self, receipt: Receipt) -> None:
        with self.lock:
            if receipt.round_trip_s is not None:
                self.receipt_s.append(receipt.round_trip_s)
            if receipt.accepted:
                self.integrate_s.append(receipt.message.integrate_ms / 1e3)
                return
            reason = f"{receipt.status.value}.{receipt.reason or 'unnamed'}"
            self.reasons[reason] += 1
            self.examples.setdefault(reason, receipt.message.message or "")

    def fail(self, error: BaseException) -> None:
        with self.lock:
            self.failed[type(error).__name__] += 1
            self.examples.setdefault(type(error).__name__, str(error))

    def report(
        self, settings: LoadSettings, elapsed_s: float, stats: dict[str, Any] | None, *, interrupted: bool
    ) -> LoadReport:
        """All of it."""
        with self.lock:
            return LoadReport(
                settings=settings,
                elapsed_s=elapsed_s,
                clouds=self.counts,
                reasons=dict(sorted(self.reasons.items())),
                receipts=Percentiles.of(self.receipt_s),
                integrate=Percentiles.of(self.integrate_s),
                asked=self.asked,
                answered=len(self.query_s),
                overloaded=self.overloaded,
                failed=dict(sorted(self.failed.items())),
                queries=Percentiles.of(self.query_s),
                examples=self.examples,
                server_stats=stats,
                interrupted=interrupted,
            )


def run_load(
    settings: LoadSettings,
    recording: Recording,
    *,
    options: SessionOptions,
    map_id: str = "default",
    root: str = DEFAULT_ROOT,
    stop: threading.Event | None = None,
) -> LoadReport:
    """Run the test; returns after `duration_s` and the time that the last receipts take, or soon after `stop` is set.

    Robots and planners have a session each, as they would in the field. A robot offers its clouds on the beat and drops
    what the server cannot take in time; a planner asks about points in the box that the clouds span.

    Raises:
        PotclientError: no server that is ready; DatasetError: a scan cannot be read.
    """
    stop = stop or threading.Event()
    scans = _prepare(recording, settings)
    ends = np.concatenate([scan.in_map for scan in scans])
    box = np.percentile(ends, (1, 99), axis=0)
    tally = _Tally()

    def connect() -> MapClient:
        feed = FeedOptions(receipt_timeout_s=settings.receipt_timeout_s, on_receipt=tally.on_receipt)
        return MapClient(
            map=map_id, root=root, options=options, timeout_s=settings.query_timeout_s, feed=feed
        )

    with connect() as control:
        control.wait_ready(max(settings.query_timeout_s, options.connect_timeout_s))
        started = time.monotonic()
        crew = _Crew(settings, connect, tally, started + settings.duration_s, stop)
        crew.start(scans, box)
        interrupted = crew.join()
        elapsed_s = time.monotonic() - started
        stats: dict[str, Any] | None = None
        try:
            stats = msgspec.to_builtins(control.stats())
        except PotclientError as error:
            tally.examples["server_stats"] = str(error)
    return tally.report(settings, elapsed_s, stats, interrupted=interrupted)


class _Crew:
    """The robots and planners, a thread and a session each."""

    def __init__(
        self,
        settings: LoadSettings,
        connect: Callable[[], MapClient],
        tally: _Tally,
        until: float,
        stop: threading.Event,
    ) -> None:
        self._settings, self._connect, self._tally = settings, connect, tally
        self._until, self._stop = until, stop
        self._threads: list[threading.Thread] = []

    def start(self, scans: list[RecordedScan], box: Float64) -> None:
        """Let all of them work: robots send these scans, planners ask inside this box (2, 3) m."""
        s = self._settings
        work: list[tuple[Callable[[int, Any], None], int, Any]] = [
            (self._robot, i, scans) for i in range(s.robots)
        ]
        work += [(self._planner, i, box) for i in range(s.planners)]
        for run, i, what in work:
            thread = threading.Thread(target=run, args=(i, what), daemon=True)
            thread.start()
            self._threads.append(thread)

    def join(self) -> bool:
        """Wait until all have ended; whether it was interrupted."""
        try:
            for thread in self._threads:
                thread.join()
        except KeyboardInterrupt:  # what was sent so far still gets its place
            self._stop.set()
            for thread in self._threads:
                thread.join()
            return True
        return False

    def _robot(self, i: int, scans: list[RecordedScan]) -> None:
        s = self._settings
        robot = f"{s.robot_prefix}-{i}"
        client: MapClient | None = None
        try:
            with self._connect() as client:
                beat = time.monotonic() + i / max(1, s.robots) / s.rate_hz  # robots are not in step
                k = i * len(scans) // max(1, s.robots)
                while self._waits_for(beat):
                    scan = scans[k % len(scans)]
                    client.publish(scan.to_send, scan.T_map_sensor, is_return=scan.is_return, robot=robot)
                    k += 1
                    beat += 1.0 / s.rate_hz
                client.flush(2 * s.receipt_timeout_s + 6.0)  # both credits may run out one after the other
                client.flush(s.receipt_timeout_s, late=True)
        except PotclientError as error:
            self._tally.fail(error)
        finally:
            if client is not None:
                with self._tally.lock:
                    self._tally.counts += client.counts()

    def _planner(self, i: int, box: Float64) -> None:
        s = self._settings
        rng = np.random.default_rng((s.seed, i))
        try:
            with self._connect() as client:
                beat = time.monotonic()
                while self._waits_for(beat):
                    points = rng.uniform(box[0], box[1], (s.query_points, 3)).astype(np.float32)
                    _ask(client, points, self._tally)
                    beat = max(beat + 1.0 / s.planner_hz, time.monotonic())
        except PotclientError as error:
            self._tally.fail(error)

    def _waits_for(self, beat: float) -> bool:
        """Wait for the beat; false if the test ends before."""
        return beat < self._until and not self._stop.wait(max(0.0, beat - time.monotonic()))


def _ask(client: MapClient, points: Any, tally: _Tally) -> None:
    with tally.lock:
        tally.asked += 1
    asked = time.monotonic()
    try:
        client.occupancy(points)
    except (OverloadedError, TooManyError):
        with tally.lock:
            tally.overloaded += 1
    except PotclientError as error:
        tally.fail(error)
    else:
        with tally.lock:
            tally.query_s.append(time.monotonic() - asked)


def _prepare(recording: Recording, settings: LoadSettings) -> list[RecordedScan]:
    """Some scans of the recording, each thinned to `n_points` by a fixed seed."""
    if len(recording) == 0:
        raise UsageError("load: the recording has no scans")
    rng = np.random.default_rng(settings.seed)
    scans = []
    for scan in recording[:: max(1, len(recording) // _MAX_SCANS)][:_MAX_SCANS]:
        if len(scan) > settings.n_points:
            kept = np.sort(rng.choice(len(scan), settings.n_points, replace=False))
            scan = dataclasses.replace(scan, points=scan.points[kept], is_return=scan.is_return[kept])
        scans.append(scan)
    return scans
