"""Many robots and planners at once: is every cloud told of, is what was accepted in the map, does memory stay.

    python benchmarks/fleet.py --robots 50 --planners 200 --seconds 60

`potserver serve` runs as a process of its own, with a store. Robots and planners are sessions of their own, spread over some
processes. Each robot sends clouds of 60 kilobytes and waits for its receipt, each planner asks about 100 points once a
second. After ten questions a planner leaves, and another one comes.
"""

from __future__ import annotations

import argparse
import collections
import json
import random
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any

import numpy as np

from benchmarks.server_process import serving
from benchmarks.shared import keep, parser_of
from potclient import AccessError, MapClient, MapServerError, PotclientError

_SCENE_POINTS = 5_000  # on a sphere: the map is done after the first few
_CLOUD_EVERY_S = 5.0  # of one robot
_ASK_EVERY_S = 1.0  # of one planner
_QUESTIONS = 10  # of one session
_CROWD = 50  # sessions in one process


def main() -> int:
    """Run, and print what was measured; exit code 1 if anything was lost."""
    parser = parser_of(__doc__)
    parser.add_argument("--robots", type=int, default=50, help="how many (default 50)")
    parser.add_argument("--planners", type=int, default=200, help="how many at a time (default 200)")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long (default 60)")
    parser.add_argument("--crowd", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.crowd:
        endpoint, robots, planners = options.crowd
        print(json.dumps(_crowd(endpoint, robots.split(","), int(planners), options.seconds)))
        return 0
    found = measure(options.robots, options.planners, options.seconds)
    for name, value in found.items():
        print(f"{name}: {value}")
    keep(options, found)
    return 1 if found["wrong"] else 0


def measure(robots: int, planners: int, seconds: float) -> dict[str, Any]:
    """Let them live for a while beside a server."""
    crowds = max(1, -(-(robots + planners) // _CROWD))
    with (
        tempfile.TemporaryDirectory() as folder,
        serving("--store", folder) as endpoint,
        MapClient(endpoint, timeout_s=60.0) as client,
    ):
        client.wait_ready(60.0)
        running = [
            subprocess.Popen(
                [sys.executable, "-m", "benchmarks.fleet", "--seconds", str(seconds), "--crowd", endpoint,
                 ",".join(f"r{n}" for n in range(crowd, robots, crowds)), str(len(range(crowd, planners, crowds)))],
                stdout=subprocess.PIPE, text=True,
            )
            for crowd in range(crowds)
        ]  # fmt: skip
        rss_mb = []
        while any(process.poll() is None for process in running):
            time.sleep(max(1.0, seconds / 6))
            rss_mb.append(round(client.stats().rss_bytes / 2**20))
        told = [json.loads(process.communicate()[0]) for process in running]
        words = sum((collections.Counter(t["words"]) for t in told), collections.Counter())
        ms = np.concatenate([t["ms"] for t in told])
        info = client.info()
    wrong = []
    if info.n_scans != words["cloud accepted"]:
        wrong.append(f"{words['cloud accepted']} clouds were acknowledged, {info.n_scans} are in the map")
    if words["no answer"]:
        wrong.append(f"{words['no answer']} were not answered")
    return {
        "what became of clouds and questions": dict(words),
        "100 points, ms: p50, p95, p99, longest": [
            round(float(v), 1) for v in np.percentile(ms, [50, 95, 99, 100])
        ],
        "server's memory, MiB": rss_mb,
        "wrong": wrong,
    }


def _crowd(endpoint: str, robots: list[str], planners: int, seconds: float) -> dict[str, Any]:
    words: collections.Counter[str] = collections.Counter()
    ms: list[float] = []
    lock, until_s = threading.Lock(), time.monotonic() + seconds

    def note(word: str, elapsed_ms: float | None = None) -> None:
        with lock:
            words[word] += 1
            if elapsed_ms is not None:
                ms.append(elapsed_ms)

    threads = [
        threading.Thread(target=_robot, args=(endpoint, robot, until_s, note)) for robot in robots if robot
    ]
    threads += [threading.Thread(target=_planner, args=(endpoint, n, until_s, note)) for n in range(planners)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return {"words": words, "ms": ms}


def _open(endpoint: str, note: Any) -> MapClient:
    """A session; a server whose queue of newcomers is full lets it in a moment later, and that is counted."""
    while True:
        try:
            return MapClient(endpoint, timeout_s=60.0)
        except AccessError:
            note("session asked to come later")
            time.sleep(random.uniform(0.5, 1.5))


def _robot(endpoint: str, robot: str, until_s: float, note: Any) -> None:
    rng = np.random.default_rng(abs(hash(robot)))
    directions = rng.normal(size=(_SCENE_POINTS, 3))
    points = (5.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    with _open(endpoint, note) as client:
        while time.monotonic() < until_s:
            begun_s = time.monotonic()
            _told("cloud", lambda: client.integrate(points, np.eye(4), robot=robot).status.value, note)
            time.sleep(max(0.0, begun_s + _CLOUD_EVERY_S - time.monotonic()))


def _planner(endpoint: str, number: int, until_s: float, note: Any) -> None:
    points = np.random.default_rng(number).uniform(-5, 5, (100, 3))
    while time.monotonic() < until_s:
        with _open(endpoint, note) as client:
            for _ in range(_QUESTIONS):
                begun_s = time.monotonic()
                if begun_s >= until_s:
                    break

                def ask() -> str:
                    client.occupancy(points)
                    return "answered"

                if _told("question", ask, note) == "answered":
                    note("timed", (time.monotonic() - begun_s) * 1e3)
                time.sleep(max(0.0, begun_s + _ASK_EVERY_S - time.monotonic()))


def _told(what: str, work: Any, note: Any) -> str:
    try:
        word = str(work())
    except MapServerError as error:
        word = str(error.code)
    except PotclientError:
        note("no answer")
        return "no answer"
    note(f"{what} {word}")
    return word


if __name__ == "__main__":
    sys.exit(main())
