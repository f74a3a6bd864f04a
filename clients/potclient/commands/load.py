"""`potclient load`: a load test."""

from __future__ import annotations

import argparse
from typing import Any

from potclient.commands.shared import (
    EXIT_FAILED,
    EXIT_INTERRUPTED,
    EXIT_OK,
    add_command,
    add_json_argument,
    complain,
    positive,
    say,
    table,
    write_json,
)
from potclient.datasets import open_dataset
from potclient.loadtest import LoadReport, LoadSettings, run_load
from potclient.session import options_from_arguments


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "load",
        run,
        help="load test: robots that publish, planners that ask",
        description="""Put load on a server and account for every cloud: offered = dropped by the client + accepted + dropped
and rejected by the server with a reason + unknown. Robots drop what the server cannot take in time, as in the field. The
exit status is 1 if a cloud has no known fate, or a question failed for another reason than overload.""",
        epilog="""examples:
  potclient load --robots 4 --hz 5 --planners 2 --seconds 10
  potclient load --robots 8 --dataset town:downtown:dynamic
  potclient load --robots 32 --hz 10 --points 20000 --dataset kitti/00 --json load.json""",
    )
    parser.add_argument("--robots", type=int, default=4, help="default 4")
    parser.add_argument("--hz", type=positive, default=5.0, help="clouds a second a robot (default 5)")
    parser.add_argument("--planners", type=int, default=2, help="default 2")
    parser.add_argument(
        "--planner-hz", type=positive, default=10.0, help="questions a second a planner (default 10)"
    )
    parser.add_argument("--seconds", type=positive, default=10.0, help="default 10")
    parser.add_argument("--points", type=int, default=5000, help="points a cloud (default 5000)")
    parser.add_argument("--query-points", type=int, default=1000, help="points a question (default 1000)")
    parser.add_argument(
        "--dataset", default="generated", help="recording to send, e.g. town:suburb (default: generated)"
    )
    parser.add_argument(
        "--receipt-timeout", type=positive, default=30.0, metavar="SECONDS", help="default 30"
    )
    parser.add_argument(
        "--robot-prefix", default="load", help="robots are PREFIX-0, PREFIX-1, ... (default load)"
    )
    parser.add_argument("--seed", type=int, default=0)
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    settings = LoadSettings(
        robots=arguments.robots,
        rate_hz=arguments.hz,
        planners=arguments.planners,
        planner_hz=arguments.planner_hz,
        duration_s=arguments.seconds,
        n_points=arguments.points,
        query_points=arguments.query_points,
        receipt_timeout_s=arguments.receipt_timeout,
        query_timeout_s=arguments.timeout,
        robot_prefix=arguments.robot_prefix,
        seed=arguments.seed,
    )
    recording = open_dataset(arguments.dataset)
    options = options_from_arguments(arguments)
    report = run_load(settings, recording, options=options, map_id=arguments.map, root=arguments.root)
    write_json(arguments.json, report.to_json())
    if arguments.json != "-":
        _say_load(report)
    if report.interrupted:
        return complain("interrupted", EXIT_INTERRUPTED)
    return EXIT_OK if report.nothing_lost else EXIT_FAILED


def _say_load(report: LoadReport) -> None:
    c = report.clouds
    rows = [
        ["offered", str(c.offered)],
        ["dropped by client", str(c.dropped_by_client)],
        ["accepted", str(c.accepted)],
        ["dropped by server", str(c.dropped)],
        ["rejected by server", str(c.rejected)],
        ["unknown", str(c.unknown)],
    ]
    rows += [[f"  {reason}", str(n)] for reason, n in report.reasons.items()]
    say(table(["clouds", "count"], rows))
    rows = [
        ["questions asked", str(report.asked)],
        ["answered", str(report.answered)],
        ["overloaded", str(report.overloaded)],
        *[[f"failed: {name}", str(n)] for name, n in report.failed.items()],
    ]
    say("\n" + table(["planners", "count"], rows))
    rows = [
        [name, str(p.n), *(f"{v:.1f}" for v in p[1:])]
        for name, p in (
            ("receipt", report.receipts),
            ("integrate", report.integrate),
            ("question", report.queries),
        )
    ]
    say("\n" + table(["latency, ms", "n", "p50", "p95", "p99", "max"], rows))
    for kind, text in report.examples.items():
        say(f"{kind}: {text}")
    rate, answers = c.accepted / report.elapsed_s, report.answered / report.elapsed_s
    verdict = "every cloud is accounted for" if report.nothing_lost else "SOMETHING WAS LOST"
    say(f"\n{report.elapsed_s:.1f} s, {rate:.1f} clouds/s integrated, {answers:.1f} answers/s: {verdict}")
