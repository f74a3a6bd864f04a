"""Tortures a server and its store, and prints what became of it: nothing acknowledged may be lost, and nothing may go unsaid.

    make torture                                                  minutes
    make torture ARGS='--night'                                   a night: every call, every 64 bytes, a million messages,
                                                                  100 kills, 500 sessions, an hour of a fleet
    make torture ARGS='--parts files kills'                       these only

1. Calls: the process of a store is killed before, or in the middle of, every write, fsync, truncate, rename and unlink, or
   the disk refuses that call, or it and all that follow, or the power fails. A C compiler is needed: the calls are caught by
   a preloaded library.
2. Files: in every run of bytes of every file that a server reads a bit flips, a sector is cleared, or the file ends; in the
   pages of a map that is served too. And a running store is copied, file by file.
3. Messages: hostile ones, over Zenoh.
4. Kills: SIGKILL of a server under load (`kill.py`).
5. Sessions that come and go (`sessions.py`), and 50 robots with 200 planners (`fleet.py`).
6. A short question beside eight askers of grids, while most of that goes on (`fairness.py`).
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from benchmarks import fairness, fleet, kill
from benchmarks import sessions as sessions_benchmark
from benchmarks.torture_damage import torture_copies, torture_files, torture_pages
from benchmarks.torture_messages import torture_messages
from benchmarks.torture_store import Outcomes, build_shim

_GROWTH_MB = 64  # of a server's memory that is no leak: compiled code, queues


def run_calls(every: int) -> list[Outcomes]:
    """Part 1, in a process with the library that catches calls."""
    with tempfile.TemporaryDirectory() as folder:
        environ = os.environ | {
            "LD_PRELOAD": str(build_shim(Path(folder))),
            "OMP_NUM_THREADS": "1",  # children are forked
            "OPENBLAS_NUM_THREADS": "1",
        }
        command = [sys.executable, "-m", "benchmarks.torture_store", str(every)]
        told = subprocess.run(
            command, env=environ, cwd=Path(__file__).parents[1], stdout=subprocess.PIPE, text=True, check=True
        )
    found = json.loads(told.stdout.splitlines()[-1])
    return [Outcomes(o["name"], Counter(o["counts"]), o["wrong"]) for o in found]


def run_kills(kills: int, seed: int) -> Outcomes:
    """Part 4."""
    with tempfile.TemporaryDirectory() as folder:
        report = kill.run(Path(folder), kills, seed=seed, longest_s=1.0, snapshot_scans=2)
    wrong = [f"lost: {scan}" for scan in report.lost]
    if report.tiles_different:
        wrong.append(f"{report.tiles_different} of {report.tiles_compared} tiles differ")
    return Outcomes(
        f"kill -9 of a server, {kills} times",
        Counter({"acknowledged scans, all in the map": report.acknowledged}),
        wrong,
    )


def run_sessions(sessions: int) -> Outcomes:
    """Part 5, sessions: every process must end by itself, and the server's memory must not grow with them."""
    found = sessions_benchmark.measure(sessions, 2)
    codes, rss_mb = found["exit codes"], found["server's memory after so many sessions, MiB"]
    wrong = [f"{n} ended with {code}" for code, n in codes.items() if code != "0"]
    first, *_, last = (*rss_mb.values(), *rss_mb.values())
    if last > first + _GROWTH_MB:
        wrong.append(f"the server's memory grew from {first} to {last} MiB")
    return Outcomes(f"sessions that came and went, memory {rss_mb}", Counter(codes), wrong)


def run_fleet(seconds: float) -> Outcomes:
    """Part 5, a fleet."""
    found = fleet.measure(50, 200, seconds)
    rest = {name: value for name, value in found.items() if not isinstance(value, dict)}
    counts = Counter(found["what became of clouds and questions"])
    return Outcomes(f"50 robots, 200 planners, {seconds:g} s, {rest}", counts, list(found["wrong"]))


def run_short_questions(seconds: float) -> Outcomes:
    """Part 6: none may fail; how long they take depends on what else the machine does, so that is printed only."""
    found = fairness.measure(8, seconds, scans=8, faults=fairness.FAULTS)
    points = found["points of 100"]
    name = f"100 points beside 8 askers of grids and all faults, ms p50 p95 p99 longest {points['ms p50 p95 p99 max']}"
    return Outcomes(name, Counter({"answered": points["answered"]}), points["failed"])


def told(title: str, outcomes: list[Outcomes], begun_s: float) -> int:
    """Print a table; returns how many went wrong."""
    print(f"\n{title} ({time.monotonic() - begun_s:.0f} s)")
    for outcome in outcomes:
        words = ", ".join(f"{word} {n:,}" for word, n in outcome.counts.most_common())
        print(f"  {outcome.name}: {outcome.n:,}, wrong {len(outcome.wrong)} ({words})")
        for line in outcome.wrong[:10]:
            print(f"    {line}")
    return sum(len(outcome.wrong) for outcome in outcomes)


def main() -> int:
    """The command; exit code 1 if anything went wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--every", type=int, default=2, metavar="N", help="part 1: every Nth call [2]")
    parser.add_argument(
        "--run-bytes", type=int, default=2048, metavar="N", help="part 2: of each file [2048]"
    )
    parser.add_argument("--messages", type=int, default=20_000, help="part 3 [20000]")
    parser.add_argument("--kills", type=int, default=5, help="part 4 [5]")
    parser.add_argument("--sessions", type=int, default=10, help="part 5 [10]")
    parser.add_argument("--fleet-s", type=float, default=20.0, help="part 5 and 6, seconds [20]")
    parser.add_argument("--seed", type=int, default=0, help="of parts 2 to 4 [0]")
    parser.add_argument("--parts", nargs="+", choices=_PARTS, default=list(_PARTS), help="only these")
    parser.add_argument("--night", action="store_true", help="the length of a night, whatever else is said")
    options = parser.parse_args()
    if options.night:
        night = {
            "every": 1,
            "run_bytes": 64,
            "messages": 1_000_000,
            "kills": 100,
            "sessions": 500,
            "fleet_s": 3600.0,
        }
        vars(options).update(night)
    logging.disable(logging.CRITICAL)  # refusals are what is wanted here
    wrong = 0
    for name in options.parts:
        begun_s = time.monotonic()
        wrong += told(name, _PARTS[name](options), begun_s)
    print(f"\n{wrong} wrong")
    return 1 if wrong else 0


def _show(line: str) -> None:
    print(f"\r{line:<100}", end="", file=sys.stderr, flush=True)


_PARTS: dict[str, Callable[[argparse.Namespace], list[Outcomes]]] = {
    "calls": lambda o: run_calls(o.every),
    "files": lambda o: torture_files(o.run_bytes, o.seed, _show),
    "pages": lambda o: [torture_pages(o.run_bytes, o.seed, _show), torture_copies(_show)],
    "messages": lambda o: torture_messages(o.messages, o.seed, _show),
    "kills": lambda o: [run_kills(o.kills, o.seed)],
    "sessions": lambda o: [run_sessions(o.sessions), run_fleet(o.fleet_s)],
    "questions": lambda o: [run_short_questions(o.fleet_s)],
}


if __name__ == "__main__":
    sys.exit(main())
