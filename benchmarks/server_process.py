"""`potserver` as a process of its own, whose JSON log is read as it comes; for benchmarks and tests."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from typing import Any

START_S = 240.0  # the first start on a machine compiles
_COMMAND = ("-m", "potserver")


class ServerProcess:
    """A running `potserver` command.

    Args:
        arguments: After `potserver`.
        python: What the interpreter runs in place of `-m potserver`.
    """

    def __init__(self, *arguments: str, python: tuple[str, ...] = _COMMAND) -> None:
        environ = {k: v for k, v in os.environ.items() if not k.startswith(("POTSERVER_", "ZENOH_"))}
        self.popen = subprocess.Popen(
            [sys.executable, *python, *arguments],
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
            env=environ,
        )
        self.lines: list[str] = []
        self.events: list[dict[str, Any]] = []
        self._coming: queue.Queue[dict[str, Any]] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.popen.stderr is not None
        for line in self.popen.stderr:
            self.lines.append(line)
            with contextlib.suppress(ValueError):  # a killed process cuts its last line off
                event = json.loads(line)
                self.events.append(event)
                self._coming.put(event)

    def event(self, name: str, timeout_s: float = START_S) -> dict[str, Any]:
        """Wait for the next event of a name."""
        while True:
            try:
                event = self._coming.get(timeout=timeout_s)
            except queue.Empty:
                raise AssertionError(f"no event {name}:\n" + "".join(self.lines)) from None
            if event["event"] == name:
                return event

    def of(self, name: str) -> list[dict[str, Any]]:
        """All events of a name so far."""
        return [event for event in self.events if event["event"] == name]

    def wait(self, timeout_s: float = START_S) -> int:
        """The exit code, once the log is read to its end."""
        code = self.popen.wait(timeout_s)
        self._reader.join(timeout_s)
        return code

    def end(self, number: signal.Signals) -> int:
        """Send a signal; the exit code."""
        self.popen.send_signal(number)
        code = self.wait()
        self.close()
        return code

    def close(self) -> None:
        """Kill it if it still runs."""
        if self.popen.poll() is None:
            self.popen.kill()
        self.wait()
        assert self.popen.stderr is not None
        self.popen.stderr.close()


@contextlib.contextmanager
def serving(*flags: str) -> Iterator[str]:
    """The endpoint of a server with these flags, which ends with the block."""
    server = ServerProcess("serve", "--listen", "tcp/127.0.0.1:0", "--log-format", "json", *flags)
    try:
        yield str(server.event("server_started")["endpoints"][0])
    finally:
        server.end(signal.SIGTERM)
