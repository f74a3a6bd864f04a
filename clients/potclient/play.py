"""Play a recording into a map: every scan gets its receipt, and held-out beams judge the result."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from potclient.arrays import Float64
from potclient.client import MapClient
from potclient.datasets.scans import RecordedScan, Recording
from potclient.errors import MapServerError, PotclientError
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import Metrics, score
from potclient.results import Receipt

_RECORDED = "recorded"  # the session of clouds that are numbered by their stamps
_ROUNDING = 1.001  # beams that were cut at the server's range end there, and not beyond


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ScanOutcome:
    """What became of one scan."""

    index: int  # in the recording, as it was opened
    name: str
    seq: int
    n_points: int  # beams sent
    status: str  # accepted | dropped | rejected | unknown | dropped_by_client
    reason: str | None = None
    message: str | None = None
    map_revision: int = 0
    n_kernels: int = 0  # of the instantaneous map; 0 where nobody listens to parameters
    n_kernels_added: int = 0
    map_kernels: int = 0
    queue_depth: int = 0
    wait_ms: float = 0.0
    integrate_ms: float = 0.0
    round_trip_ms: float | None = None


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class PlayReport:
    """What became of a recording."""

    scans: list[ScanOutcome]
    elapsed_s: float
    held_out: Metrics | None = None
    beyond_range: float = 0.0  # share of the held-out beams that end beyond the server's range
    range_m: float | None = None  # of the server, where a score was asked for
    n_held_out: int = 0  # labelled points; the score may be of a fixed-seed sample of them
    failure: PotclientError | KeyboardInterrupt | None = None  # what ended it early

    @property
    def all_accepted(self) -> bool:
        """Every scan has a receipt that says accepted."""
        return self.failure is None and all(scan.status == "accepted" for scan in self.scans)

    def count(self, status: str) -> int:
        """How many scans ended so."""
        return sum(scan.status == status for scan in self.scans)

    def to_json(self) -> dict[str, Any]:
        """Plain types, for a file."""
        statuses = ("accepted", "dropped", "rejected", "unknown", "dropped_by_client")
        return {
            "n_scans": len(self.scans),
            "failure": None if self.failure is None else str(self.failure) or "interrupted",
            "counts": {status: self.count(status) for status in statuses},
            "elapsed_s": self.elapsed_s,
            "held_out": None if self.held_out is None else self.held_out._asdict(),
            "n_held_out": self.n_held_out,
            "beyond_range": self.beyond_range,
            "range_m": self.range_m,
            "scans": [dataclasses.asdict(scan) for scan in self.scans],
        }


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Sending:
    """How the scans of a recording are sent."""

    robot: str = "r1"
    rate_hz: float | None = None  # scans a second at most; None goes as fast as the receipts come
    lossless: bool = True  # wait for credit; false drops the older cloud as a live robot does
    acknowledged: bool = False  # send by `integrate` instead, one after the other
    # Send the recorded stamps, and number the scans by them: a server then refuses a second round of the same recording.
    keep_stamps: bool = False


def play(
    client: MapClient,
    recording: Recording,
    sending: Sending | None = None,
    *,
    hold_out: HoldOut | None = None,
    max_test_points: int = 200_000,
    on_outcome: Callable[[ScanOutcome], None] | None = None,
) -> PlayReport:
    """Send all scans of a recording and wait for what becomes of them.

    Args:
        sending: For which robot, how fast, and in which way; by default published, as fast as the receipts come.
        hold_out: Keep these beams back and score the map on them at the end.
        max_test_points: Score a fixed-seed sample when there are more.
        on_outcome: Called with every outcome as it is known, on a thread of the client's.
    Raises:
        PotclientError, KeyboardInterrupt: before the first scan was sent; later the report has them as `failure`.
    """
    sending = sending or Sending()
    started = time.monotonic()
    book = _Book(client, sending, on_outcome)
    labelled: list[LabelledPoints] = []
    held_ranges_m: list[Float64] = []
    failure: PotclientError | KeyboardInterrupt | None = None
    previous, client.on_receipt = client.on_receipt, book.on_receipt
    session = client.session
    if sending.keep_stamps:
        client.session = _RECORDED
    try:
        for index, recorded in enumerate(recording):
            scan = recorded
            if hold_out is not None:
                scan, labels = hold_out.split(recorded, index)
                labelled.append(labels)
                held = recorded.points[hold_out.beams(len(recorded), index)]
                held_ranges_m.append(np.linalg.norm(held.astype(np.float64), axis=1))
            if sending.rate_hz is not None:
                time.sleep(max(0.0, started + index / sending.rate_hz - time.monotonic()))
            book.send(index, scan)
        client.flush()  # ends: a credit without a receipt runs out
    except (PotclientError, KeyboardInterrupt) as error:
        if book.is_empty:
            raise
        failure = error
    finally:
        client.on_receipt, client.session = previous, session
    report = PlayReport(scans=book.finish(), elapsed_s=time.monotonic() - started, failure=failure)
    if hold_out is None or failure is not None:
        return report
    labels = LabelledPoints.concatenate(labelled)
    report = dataclasses.replace(report, n_held_out=len(labels))
    try:
        range_m = client.info().limits.max_range_m  # first: with the limits, the client splits its question
        report = dataclasses.replace(report, held_out=score_map(client, labels, max_test_points))
        beyond = np.concatenate([np.zeros(0), *held_ranges_m]) > range_m * _ROUNDING
        share = float(beyond.mean()) if len(beyond) else 0.0
        return dataclasses.replace(report, range_m=range_m, beyond_range=share)
    except (PotclientError, KeyboardInterrupt) as error:  # the receipts are known all the same
        return dataclasses.replace(report, failure=error)


def score_map(
    client: MapClient, labels: LabelledPoints, max_points: int = 200_000, seed: int = 0
) -> Metrics | None:
    """Score the map on labelled points, or on a fixed-seed sample of them; None if there are none."""
    if len(labels) == 0:
        return None
    points, occupied = labels.points, labels.occupied
    if len(labels) > max_points:
        chosen = np.sort(np.random.default_rng(seed).choice(len(labels), max_points, replace=False))
        points, occupied = points[chosen], occupied[chosen]
    answer = client.occupancy(points)
    return score(answer.mean, occupied, answer.observed)


class _Book:
    """Which scan has which number, and what its receipt said; receipts may come before `publish` returns."""

    def __init__(
        self, client: MapClient, sending: Sending, on_outcome: Callable[[ScanOutcome], None] | None
    ) -> None:
        self._client, self._sending, self._on_outcome = client, sending, on_outcome
        self._lock = threading.Lock()
        self._sent: dict[int, tuple[int, RecordedScan]] = {}
        self._early: dict[int, Receipt] = {}
        self._outcomes: dict[int, ScanOutcome] = {}

    def send(self, index: int, scan: RecordedScan) -> None:
        """Publish or integrate a scan."""
        cloud: dict[str, Any] = {
            "points": scan.to_send,
            "T_map_sensor": scan.T_map_sensor,
            "is_return": scan.is_return,
            "robot": self._sending.robot,
            "stamp_ns": scan.stamp_ns if self._sending.keep_stamps else None,
            "seq": scan.stamp_ns if self._sending.keep_stamps else None,
        }
        if self._sending.acknowledged:
            self._integrate(index, scan, cloud)
            return
        seq = self._client.publish(**cloud, wait=self._sending.lossless)
        with self._lock:
            self._sent[seq] = (index, scan)
            receipt = self._early.pop(seq, None)
        if receipt is not None:
            self.on_receipt(receipt)

    def _integrate(self, index: int, scan: RecordedScan, cloud: dict[str, Any]) -> None:
        try:
            receipt = self._client.integrate(**cloud)
        except MapServerError as error:
            if error.receipt is None:
                status = "dropped" if error.retryable else "rejected"
                self._book(_unsettled(index, scan, status, reason=error.code, message=str(error)))
                return
            receipt = Receipt(error.receipt)
        self._book(_outcome(index, scan, receipt))

    def on_receipt(self, receipt: Receipt) -> None:
        with self._lock:
            if receipt.seq not in self._sent:
                self._early[receipt.seq] = receipt
                return
            index, scan = self._sent[receipt.seq]
        self._book(_outcome(index, scan, receipt))

    def _book(self, outcome: ScanOutcome) -> None:
        with self._lock:
            self._outcomes[outcome.index] = outcome
        if self._on_outcome is not None:
            self._on_outcome(outcome)

    @property
    def is_empty(self) -> bool:
        """Nothing was sent."""
        with self._lock:
            return not self._sent and not self._outcomes

    def finish(self) -> list[ScanOutcome]:
        """All outcomes in order; a scan without a receipt is unknown, or was dropped by the client where it may do so."""
        status = "unknown" if self._sending.lossless else "dropped_by_client"
        for seq, (index, scan) in self._sent.items():
            if index not in self._outcomes:
                self._book(_unsettled(index, scan, status, seq=seq))
        return [self._outcomes[i] for i in sorted(self._outcomes)]


def _unsettled(index: int, scan: RecordedScan, status: str, **more: Any) -> ScanOutcome:
    """The outcome of a scan without a receipt."""
    fields = {"seq": 0} | more
    return ScanOutcome(index=index, name=scan.name, n_points=len(scan), status=status, **fields)


def _outcome(index: int, scan: RecordedScan, receipt: Receipt) -> ScanOutcome:
    m = receipt.message
    return ScanOutcome(
        index=index,
        name=scan.name,
        seq=m.seq,
        n_points=len(scan),
        status=m.status.value,
        reason=m.reason,
        message=m.message,
        map_revision=m.map_revision,
        n_kernels=m.n_kernels,
        n_kernels_added=m.n_kernels_added,
        map_kernels=m.map_kernels,
        queue_depth=m.queue_depth,
        wait_ms=m.wait_ms,
        integrate_ms=m.integrate_ms,
        round_trip_ms=None if receipt.round_trip_s is None else receipt.round_trip_s * 1e3,
    )
