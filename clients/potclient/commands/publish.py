"""`potclient publish`: play a recording into the map."""

from __future__ import annotations

import argparse
import collections
import contextlib
import dataclasses
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from potclient.client import MapClient
from potclient.commands.shared import (
    EXIT_FAILED,
    EXIT_OK,
    add_command,
    add_json_argument,
    add_recording_arguments,
    client_of,
    note,
    open_recording,
    positive,
    progress_bar,
    say,
    write_json,
)
from potclient.errors import NoServerError
from potclient.feed import FeedOptions
from potclient.holdout import HoldOut
from potclient.metrics import Metrics
from potclient.play import PlayReport, ScanOutcome, Sending, play

# For a server that went away in the middle: longer than its drain takes by default, and than a restart.
GONE_S = 20.0
_LOOK_S = 0.1


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "publish",
        run,
        help="play a recording into the map, one receipt a scan",
        description=f"""Play a recording into the map. Every scan is sent and its receipt shown; the exit status is 1 if any
scan has no receipt or was not accepted. A server that goes away meanwhile has {GONE_S:g} s to come back.

DATASET is found out by looking at it:
  a folder with velodyne/*.bin      KITTI odometry, with poses.txt and calib.txt
  a folder of clouds of one kind    .pcd .ply .bin .bin.gz .pcd.bin .npy .npz .las .laz .feather, with poses.txt (KITTI, TUM, or
                                    a graph's vertices) or a VIEWPOINT in each PCD header; or one such file alone
  a log of Argoverse 2              two scans a sweep, one of each lidar
  a DGP scene (DDAD)                scene_*.json and its clouds
  a .log or .clf file (.bz2, .gz)   a CARMEN log of a planar laser
  a .mcap, .db3 or .bag file        PointCloud2 or LaserScan with /tf, or --poses TOPIC; also a rosbag2 folder
  generated[:2d][:SEED]             a made-up yard
  town:STYLE[:2d][:dynamic][:SEED]  a drive through a made-up town, see `potclient town --help`""",
        epilog="""examples:
  potclient publish generated --limit 20
  potclient publish town:terraces:300m --every 5 --max-range 25 --hold-out 0.2
  potclient publish kitti/00 --poses poses_velo_icp.txt --max-range 25
  potclient publish kitti/00 --odometry kiss-icp             no poses: odometry places the scans; it closes no loops
  potclient publish sim_structured --max-range 8 --hold-out 0.2
  potclient publish aces.clf.bz2 --poses aces_poses_optimised.txt --every 10 --rate 20
  potclient publish drive.mcap --topic /points --tf
  potclient publish scans/ --robot r2 --rate 10 --drop     like a live robot: newest cloud wins""",
    )
    add_recording_arguments(parser, "DATASET")
    _add_sending(parser)
    parser.add_argument(
        "--hold-out",
        type=float,
        metavar="FRACTION",
        help="keep this share of each scan's beams back and score the map on them at the end: ACC AUC NLL Brier ECE",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the held-out beams (default 0)")
    parser.add_argument(
        "--max-test",
        type=int,
        default=200_000,
        metavar="N",
        help="score at most N held-out points (default 200000)",
    )
    parser.add_argument("--clear", action="store_true", help="clear the map first")
    parser.add_argument(
        "--receipt-timeout", type=positive, default=30.0, metavar="SECONDS", help="default 30"
    )
    parser.add_argument(
        "-q",
        "--quiet",
        action="store_true",
        help="no line a scan; reasons are summed up",
    )
    add_json_argument(parser)


def _add_sending(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="r1", help="id of the robot that sends (default r1)")
    pace = parser.add_mutually_exclusive_group()
    pace.add_argument("--rate", type=positive, metavar="HZ", help="scans a second, at most")
    pace.add_argument("--as-fast", action="store_true", help="as fast as receipts come back (default)")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--drop",
        action="store_true",
        help="do not wait for receipts: a newer cloud replaces one that still waits",
    )
    how.add_argument(
        "--acknowledged",
        action="store_true",
        help="send each scan as a query and wait until it is in the map",
    )
    parser.add_argument(
        "--keep-stamps", action="store_true",
        help="send the recorded stamps, not the current time; a second round of the recording is then refused",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    recording = open_recording(arguments)
    hold_out = None if arguments.hold_out is None else HoldOut(arguments.hold_out, arguments.seed)
    sending = Sending(
        robot=arguments.robot,
        rate_hz=arguments.rate,
        lossless=not arguments.drop,
        acknowledged=arguments.acknowledged,
        keep_stamps=arguments.keep_stamps,
    )
    feed = FeedOptions(receipt_timeout_s=arguments.receipt_timeout)
    with client_of(arguments, feed) as client:
        client.wait_ready()
        note(f"{recording.path}: {len(recording)} scans ({recording.format}); {'; '.join(recording.notes)}")
        if arguments.clear:
            note(client.control("clear").message)
        watch = _ServerWatch(client)
        with watch, _scan_progress(len(recording), quiet=arguments.quiet) as on_outcome:
            report = play(
                client,
                recording,
                sending,
                hold_out=hold_out,
                max_test_points=arguments.max_test,
                on_outcome=on_outcome,
            )
    if watch.has_given_up:
        sent = f"{len(report.scans)} of {len(recording)} scans had been sent"
        failure = NoServerError(f"the server was gone for {GONE_S:g} s; {sent}")
        report = dataclasses.replace(report, failure=failure)
    write_json(arguments.json, report.to_json())
    if arguments.json != "-":
        _say_play(report)
    _note_reasons(report)
    if report.beyond_range > 0 and report.range_m is not None:
        note(
            f"{report.beyond_range:.1%} of the held-out beams end beyond the server's range of {report.range_m:g} m, where it"
            f" maps nothing: cut them with --max-range {report.range_m:g}, or start the server with"
            " --set mapping.max_range_m=METRES"
        )
    if report.failure is not None:
        raise report.failure
    return EXIT_OK if report.all_accepted else EXIT_FAILED


class _ServerWatch:
    """Says when nobody serves the map any more, and closes the client when that lasts: its waits end then.

    Made when a server is ready.
    """

    def __init__(self, client: MapClient) -> None:
        self.has_given_up = False
        self._client = client
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="potclient-server-watch", daemon=True)

    def __enter__(self) -> _ServerWatch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        gone_since: float | None = None
        while not self._ended.wait(_LOOK_S):
            if self._client.servers:
                if gone_since is not None:
                    note("the server is back")
                gone_since = None
            elif gone_since is None:
                gone_since = time.monotonic()
                note(f"the server is gone; waiting for it for {GONE_S:g} s")
            elif time.monotonic() - gone_since > GONE_S:
                self.has_given_up = True
                self._client.close()
                return


def _say_play(report: PlayReport) -> None:
    parts = [f"{report.count('accepted')} of {len(report.scans)} scans accepted"]
    parts += [
        f"{report.count(status)} {status.replace('_', ' ')}"
        for status in ("dropped", "rejected", "unknown", "dropped_by_client")
        if report.count(status)
    ]
    accepted = [scan for scan in report.scans if scan.status == "accepted"]
    if accepted:
        median = float(np.median([scan.integrate_ms for scan in accepted]))
        parts.append(f"{median:.0f} ms a scan (median)")
        parts.append(f"{accepted[-1].map_kernels} kernels in the map, revision {accepted[-1].map_revision}")
    say(", ".join(parts) + f", {report.elapsed_s:.1f} s")
    if report.held_out is not None:
        say(f"held-out beams: {_metrics_line(report.held_out)} ({report.n_held_out} points held out)")


def _note_reasons(report: PlayReport) -> None:
    """Why scans were not accepted: how many for each reason, and what the server said of the first."""
    refused = [scan for scan in report.scans if scan.reason is not None]
    counts = collections.Counter(scan.reason for scan in refused)
    first = {scan.reason: scan.message for scan in reversed(refused)}
    if counts:
        note("not accepted: " + ", ".join(f"{n} {reason} ({first[reason]})" for reason, n in counts.items()))


def _metrics_line(m: Metrics) -> str:
    return (
        f"ACC {m.accuracy:.4f}  AUC {m.auc:.4f}  NLL {m.nll:.4f}  Brier {m.brier:.4f}  ECE {m.ece:.4f}"
        f"  unknown {m.share_unknown:.2%}  n {m.n}"
    )


@contextlib.contextmanager
def _scan_progress(total: int, *, quiet: bool) -> Iterator[Callable[[ScanOutcome], None]]:
    """A line a scan on stdout; a progress bar under it when stderr is a terminal."""

    def line(outcome: ScanOutcome) -> str:
        why = f" ({outcome.reason}: {outcome.message})" if outcome.reason else ""
        took = f"  {outcome.integrate_ms:6.0f} ms" if outcome.status == "accepted" else ""
        kernels = (
            f"  kernels {outcome.map_kernels} (+{outcome.n_kernels_added})  rev {outcome.map_revision}"
            if outcome.status == "accepted"
            else ""
        )
        return f"{outcome.index:6d}  {outcome.name}  {outcome.n_points} points  {outcome.status}{why}{took}{kernels}"

    progress = progress_bar(total) if sys.stderr.isatty() and not quiet else None
    if progress is None:
        yield (lambda outcome: None) if quiet else (lambda outcome: say(line(outcome)))
        return
    bar, task = progress
    with bar:

        def show(outcome: ScanOutcome) -> None:
            if sys.stdout.isatty():
                bar.console.print(line(outcome), highlight=False, markup=False, soft_wrap=True)
            else:
                say(line(outcome))
            bar.advance(task)

        yield show
