"""Kills a server at random moments, under load, and looks for what it had acknowledged.

    python benchmarks/kill.py --kills 100

Two robots publish and one asks (`in/<robot>/integrate`) while `potserver serve` runs as a process of its own on one store.
It gets SIGKILL after a random time, at times while it starts, and is started again. What the journal and the log say then is
the order in which scans entered the map: every acknowledged scan must be among them, each once. At the end the map on the disk
is compared, tile by tile, with one that was fed the same scans in that order and never killed.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.server_process import START_S, ServerProcess
from potclient import MapClient, PotclientError
from potserver.codec.clouds import read_cloud
from potserver.domain.map_state import MapState
from potserver.domain.types import KernelSet, Scan, yaw_pose
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.storage.agreement import JOURNAL, TILES
from potserver.storage.journal import Journal
from potserver.storage.map_file import read_map

_BASE_NS = 1_700_000_000_000_000_000
_MAPPING = {"max_range_m": 15.0, "beams_per_scan": 400}
_PUBLISHERS, _ASKER = ("r1", "r2"), "r3"


class ScanId(NamedTuple):
    """One scan of one robot."""

    robot: str
    seq: int


@dataclasses.dataclass
class Report:
    """What a run found."""

    kills: int = 0
    kills_while_starting: int = 0
    integrated: int = 0  # scans in the map
    acknowledged: int = 0
    lost: list[ScanId] = dataclasses.field(default_factory=list)
    unacknowledged: int = 0  # in the map although the kill came before their receipt
    snapshots: int = 0
    restarts_s: list[float] = dataclasses.field(default_factory=list)  # from the start to `server_started`
    replays_ms: list[float] = dataclasses.field(default_factory=list)
    n_replayed: list[int] = dataclasses.field(default_factory=list)
    journal_ms: dict[str, float] = dataclasses.field(default_factory=dict)
    tiles_compared: int = 0
    tiles_different: int = 0


def make_scan(scan_id: ScanId) -> Scan:
    """The scan that a name stands for: a room of 12 by 10 m, seen from somewhere in it."""
    rng = np.random.default_rng((sum(scan_id.robot.encode()), scan_id.seq))
    angle = rng.uniform(-np.pi, np.pi, 400)
    walls = np.stack([6 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-1, 2, 400)], axis=1)
    x, y = rng.uniform(-12, 12, 2)
    return Scan(
        points=walls.astype(np.float32),
        T_map_sensor=yaw_pose(x, y, rng.uniform(-3, 3)),
        robot_id=scan_id.robot,
        seq=scan_id.seq,
        stamp_ns=_BASE_NS + scan_id.seq * 100_000_000,
    )


def start(store: Path, *, snapshot_scans: int) -> ServerProcess:
    """`potserver serve` on a store, with snapshots after so many scans, which no setting says."""
    sets = [f"--set=mapping.{key}={value}" for key, value in _MAPPING.items()]
    code = (
        "import functools, sys\n"
        "from potserver import cli, server\n"
        f"server.MapStore = functools.partial(server.MapStore, snapshot_scans={snapshot_scans})\n"
        "sys.exit(cli.main())"
    )
    return ServerProcess(
        "serve", "--store", str(store), "--listen", "tcp/127.0.0.1:0", "--log-format", "json", "--threads", "1", *sets,
        python=("-c", code),
    )  # fmt: skip


class Load:
    """Robots that send until they are told to stop, or nobody is there any more."""

    def __init__(self, endpoint: str, next_seq: dict[str, int]) -> None:
        self.acknowledged: set[ScanId] = set()
        self._next_seq = next_seq
        self._stop, self._begun = threading.Event(), threading.Event()
        self._client = MapClient(endpoint, timeout_s=20.0)
        self._watch = self._client.watch_receipts(self._note)
        work = [(robot, self._publish) for robot in _PUBLISHERS] + [(_ASKER, self._ask)]
        self._threads = [threading.Thread(target=run, args=(robot,), daemon=True) for robot, run in work]
        for thread in self._threads:
            thread.start()

    def wait_for_the_first(self) -> None:
        """Return once a scan is acknowledged."""
        assert self._begun.wait(START_S), "no scan was acknowledged"

    def close(self) -> None:
        """End; the server may be gone."""
        self._stop.set()
        self._client.close()
        for thread in self._threads:
            thread.join(START_S)
            assert not thread.is_alive(), "a robot hangs"

    def _note(self, receipt: Any) -> None:
        if receipt.status.value == "accepted":
            self._acknowledge(ScanId(receipt.robot, receipt.seq))

    def _acknowledge(self, scan_id: ScanId) -> None:
        self.acknowledged.add(scan_id)
        self._begun.set()

    def _next(self, robot: str) -> Scan:
        seq = self._next_seq[robot]
        self._next_seq[robot] = seq + 1
        return make_scan(ScanId(robot, seq))

    def _publish(self, robot: str) -> None:
        with contextlib.suppress(PotclientError):
            while not self._stop.is_set():
                scan = self._next(robot)
                self._client.publish(
                    scan.points,
                    scan.T_map_sensor,
                    robot=robot,
                    seq=scan.seq,
                    stamp_ns=scan.stamp_ns,
                    wait=True,
                )

    def _ask(self, robot: str) -> None:
        with contextlib.suppress(PotclientError):
            while not self._stop.is_set():
                scan = self._next(robot)
                self._client.integrate(
                    scan.points, scan.T_map_sensor, robot=robot, seq=scan.seq, stamp_ns=scan.stamp_ns
                )
                self._acknowledge(ScanId(robot, scan.seq))


def run(
    store: Path,
    kills: int,
    *,
    seed: int = 0,
    longest_s: float = 3.0,
    snapshot_scans: int = 7,
    show: bool = False,
) -> Report:
    """Start, load and kill a server `kills` times, and judge what is left.

    Args:
        store: An empty folder.
        kills: How often.
        seed: Of the moments.
        longest_s: Of the time under load before a kill.
        snapshot_scans: Scans after which the server writes a snapshot: few, so that kills meet snapshots.
        show: Print progress.
    """
    rng = np.random.default_rng(seed)
    report = Report()
    next_seq = dict.fromkeys((*_PUBLISHERS, _ASKER), 1)
    order: list[ScanId] = []
    acknowledged: set[ScanId] = set()
    while report.kills < kills:
        begun_s = time.monotonic()
        server = start(store, snapshot_scans=snapshot_scans)
        if report.kills and rng.random() < 0.2:  # on its way up, in the middle of a replay perhaps
            time.sleep(rng.uniform(0.0, 1.2 * float(np.median(report.restarts_s))))
            report.kills_while_starting += not server.of("server_started")
        else:
            load = Load(_ready(server, begun_s, report), next_seq)
            if rng.random() < 0.75:
                load.wait_for_the_first()
            time.sleep(rng.uniform(0.0, longest_s))
            server.end(signal.SIGKILL)
            load.close()
            acknowledged |= load.acknowledged
        if server.popen.poll() is None:
            server.end(signal.SIGKILL)
        report.kills += 1
        _follow(server, store, order, report)
        if show:
            print(
                f"\rkill {report.kills} of {kills}: {len(order)} scans in the map, {len(acknowledged)} acknowledged,"
                f" {len(acknowledged - set(order))} lost",
                end="" if report.kills < kills else "\n",
                flush=True,
            )
    begun_s = time.monotonic()
    server = start(store, snapshot_scans=snapshot_scans)
    endpoint = _ready(server, begun_s, report)
    with MapClient(endpoint, timeout_s=20.0) as client:
        n_scans = client.info().n_scans
        load = Load(endpoint, next_seq)  # it goes on as before
        time.sleep(longest_s)
        latency = client.stats().latencies["journal"]
        report.journal_ms = {"p50": latency.p50_ms, "p95": latency.p95_ms, "max": latency.max_ms}
        load.close()
    acknowledged |= load.acknowledged
    assert n_scans == len(order), f"{n_scans} scans in the map, {len(order)} in the journals"
    assert server.end(signal.SIGTERM) == 0, "".join(server.lines)
    order.extend(_integrated(server))
    report.integrated, report.acknowledged = len(order), len(acknowledged)
    assert len(set(order)) == len(order), "a scan is in the map twice"
    report.lost = sorted(acknowledged - set(order))
    report.unacknowledged = len(set(order) - acknowledged)
    saved = read_map(store / "default" / TILES)
    assert saved.record.n_scans == len(order)
    report.tiles_compared, report.tiles_different = _compare(saved.state(), _feed(order, show))
    return report


def _ready(server: ServerProcess, begun_s: float, report: Report) -> str:
    """Wait until it listens; returns where, and notes how long that took."""
    endpoint: str = server.event("server_started")["endpoints"][0]
    report.restarts_s.append(time.monotonic() - begun_s)
    (restored,) = server.of("map_restored")
    report.replays_ms.append(restored["elapsed_ms"])
    report.n_replayed.append(restored["n_replayed"])
    return endpoint


def _integrated(server: ServerProcess) -> list[ScanId]:
    return [ScanId(e["robot_id"], e["seq"]) for e in server.of("scan_integrated")]


def _follow(server: ServerProcess, store: Path, order: list[ScanId], report: Report) -> None:
    """Add what one life of the server has integrated: what it logged, and a scan that it had no time to log."""
    report.snapshots += len(server.of("snapshot_written"))
    order.extend(_integrated(server))
    if not (store / "default" / JOURNAL).exists():
        return
    journal = Journal(store / "default" / JOURNAL)
    try:
        kept = [(number, read_cloud(payload)) for number, payload in journal.scans(journal.pruned)]
        assert len(order) <= journal.last <= len(order) + 1, (
            f"{len(order)} logged, {journal.last} in the journal"
        )
    finally:
        journal.close()
    for number, scan in kept:
        scan_id = ScanId(scan.robot_id, scan.seq)
        if number > len(order):
            order.append(scan_id)
        assert order[number - 1] == scan_id, (
            f"scan {number} of the journal is {scan_id}, logged {order[number - 1]}"
        )


def _feed(order: list[ScanId], show: bool) -> MapState:
    """The map that a service makes of the same scans, without a server."""
    service = MappingService(settings=MappingSettings(**_MAPPING), threads=1)  # type: ignore[arg-type]
    for i, scan_id in enumerate(order, 1):
        service.integrate(make_scan(scan_id))
        if show and (i % 50 == 0 or i == len(order)):
            print(
                f"\rmap without kills: {i} of {len(order)} scans",
                end="" if i < len(order) else "\n",
                flush=True,
            )
    return service.state


def _compare(found: MapState, wanted: MapState) -> tuple[int, int]:
    """Tiles of both maps, and how many are not the same bit for bit."""
    assert found.tiled is not None
    assert wanted.tiled is not None
    assert found.tiled.robots == wanted.tiled.robots
    assert found.map_revision == wanted.map_revision
    indices = found.tiled.tiles.keys() | wanted.tiled.tiles.keys()
    different = 0
    for index in indices:
        a, b = found.tiled.tiles.get(index), wanted.tiled.tiles.get(index)
        different += (
            a is None
            or b is None
            or (a.revision, a.stamp_ns) != (b.revision, b.stamp_ns)
            or not all(np.array_equal(x, y) for x, y in zip(a.rows, b.rows, strict=True))
            or not _same_kernels(a.kernels.kernels, b.kernels.kernels)
        )
    return len(indices), different


def _same_kernels(a: KernelSet, b: KernelSet) -> bool:
    return all(np.array_equal(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(KernelSet))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=100, help="how often [100]")
    parser.add_argument("--seed", type=int, default=0, help="of the moments [0]")
    parser.add_argument(
        "--longest", type=float, default=3.0, metavar="S", help="under load before a kill [3]"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report = run(Path(folder), options.kills, seed=options.seed, longest_s=options.longest, show=True)
    restart, replay = np.array(report.restarts_s), np.array(report.replays_ms)
    journal = ", ".join(f"{name} {ms:.2f}" for name, ms in report.journal_ms.items())
    print(
        f"{report.kills} kills ({report.kills_while_starting} while starting), {report.snapshots} snapshots\n"
        f"{report.acknowledged} scans acknowledged, {len(report.lost)} lost; {report.unacknowledged} more in the map\n"
        f"restart s: median {np.median(restart):.2f} [{restart.min():.2f}-{restart.max():.2f}]; of it reading and replaying,"
        f" ms: median {np.median(replay):.0f} [{replay.min():.0f}-{replay.max():.0f}], up to {max(report.n_replayed)} scans\n"
        f"journal, ms a scan: {journal}\n"
        f"{report.tiles_compared} tiles, {report.tiles_different} differ from those of a map that was never killed"
    )
    return 0 if not report.lost and not report.tiles_different else 1


if __name__ == "__main__":
    sys.exit(main())
