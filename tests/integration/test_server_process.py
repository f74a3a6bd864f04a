"""`potserver serve` as a process of its own: ready line, clean drain on SIGTERM, and errors of one line."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.server_process import ServerProcess
from potschemas import wire
from potschemas.messages import ReceiptStatus

from .conftest import DEADLINE_S, Client, make_cloud, until

START_S = 120.0  # the first start on a machine compiles


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Any]:
    """Starts `potserver serve` and waits until it is ready."""
    with contextlib.ExitStack() as stack:

        def start(*arguments: str, ready: bool = True) -> tuple[ServerProcess, str]:
            file = tmp_path / "settings.toml"
            file.write_text("[mapping]\nmax_range_m = 15.0\nbeams_per_scan = 500\n")
            process = ServerProcess(
                "serve",
                "--in-memory",
                "--settings",
                str(file),
                "--log-format",
                "json",
                "--listen",
                "tcp/127.0.0.1:0",
                *arguments,
            )
            stack.callback(process.close)
            endpoint = process.event("server_started", START_S)["endpoints"][0] if ready else ""
            return process, endpoint

        yield start


def test_sigterm_maps_what_waits_answers_everybody_and_exits_with_zero(serve: Any) -> None:
    process, endpoint = serve()
    client = Client(endpoint)
    receipts = client.receipts("r1")
    n = 8
    for seq in range(n):
        client.put_cloud(make_cloud(seq=seq))
    until(lambda: client.stats().counters.get("clouds.received") == n, "all clouds received")
    process.popen.send_signal(signal.SIGTERM)
    assert process.wait() == 0, "".join(process.lines)
    got = [receipts.get(timeout=DEADLINE_S) for _ in range(n)]
    assert [(r.seq, r.status) for r in got] == [(seq, ReceiptStatus.ACCEPTED) for seq in range(n)]
    assert client.get(client.keys.query("info")) == []
    client.close()
    stopped = process.event("server_stopped")
    assert stopped["clean"] is True
    assert stopped["counters"]["clouds.accepted"] == n
    assert "Traceback" not in "".join(process.lines)


def test_sigint_on_an_idle_server_exits_with_zero(serve: Any) -> None:
    process, _ = serve("--map", "a", "--map", "b")
    process.popen.send_signal(signal.SIGINT)
    assert process.wait() == 0
    assert process.event("stop_requested")["signal"] == "SIGINT"


def test_a_second_signal_ends_it_at_once(serve: Any) -> None:
    process, endpoint = serve("--drain-timeout", "600", "--set", "intake.max_queued=400")
    client = Client(endpoint)
    payload, encoding = wire.encode(make_cloud()), wire.encoding_of(make_cloud())
    # clouds without an accepted stamp cannot overtake each other: enough work for several drains
    for seq in range(200):
        client.put(client.keys.cloud(f"r{seq}"), payload, encoding)
    until(lambda: client.stats().counters.get("clouds.received") == 200, "all clouds received")
    process.popen.send_signal(signal.SIGTERM)
    process.event("server_draining")
    process.popen.send_signal(signal.SIGTERM)
    assert process.wait() == 130
    assert "second signal" in process.lines[-1]
    client.close()


def test_a_program_that_forgets_to_stop_still_ends() -> None:
    code = 'from potserver.server import MapServer; MapServer(listen="tcp/127.0.0.1:0").start(); print("started")'
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=START_S)
    assert (run.returncode, run.stdout, run.stderr) == (0, "started\n", "")


def test_a_taken_port_is_one_line_and_exit_code_two(serve: Any) -> None:
    process, endpoint = serve()
    other = ServerProcess("serve", "--in-memory", "--listen", endpoint, "--log-level", "error")
    assert other.wait() == 2
    other.close()
    (line,) = other.lines
    assert "the port is taken" in line
    assert "Hint" in line
    process.popen.send_signal(signal.SIGTERM)
    assert process.wait() == 0


def test_a_second_server_of_a_map_is_one_line_and_exit_code_two(serve: Any) -> None:
    _, endpoint = serve()
    other = ServerProcess(
        "serve", "--in-memory", "--connect", endpoint, "--listen", "tcp/127.0.0.1:0", "--server-id", "other",
        "--log-level", "error",
    )  # fmt: skip
    assert other.wait() == 2
    other.close()
    (line,) = other.lines
    assert "is served already, by potserver" in line


def test_a_server_that_was_killed_starts_again_at_once(serve: Any) -> None:
    _, hub = serve("--map", "hub", "--mode", "router")
    for _ in range(2):
        process, _ = serve("--connect", hub)
        process.popen.kill()
        process.wait()
