"""What comes over a link becomes messages, on whatever thread."""

from __future__ import annotations

import subprocess
import sys

import pytest

from potclient import MapClient
from potclient.errors import UsageError


def test_first_messages_may_come_on_many_threads_at_once() -> None:
    program = """
import sys, threading
from potclient.link import decoded
from potschemas import messages
from potschemas.wire import encode
import zenoh
sys.setswitchinterval(1e-6)
payload = zenoh.ZBytes(encode(messages.Receipt(map="m", robot="r", seq=1, status=messages.ReceiptStatus.ACCEPTED)))
start = threading.Barrier(24)
def first():
    start.wait()
    decoded(payload, messages.Receipt)
threads = [threading.Thread(target=first) for _ in range(24)]
for t in threads: t.start()
for t in threads: t.join()
"""
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", program], timeout=60, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert not done.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"root": "pot/**"}, "chunks"),
        ({"root": "/pot"}, "chunks"),
        ({"root": ""}, "chunks"),
        ({"map": "srv"}, "cannot be called 'srv'"),
        ({"map": "A b"}, "is not an id"),
    ],
)
def test_a_client_names_maps_and_roots_by_the_servers_rule(options: dict[str, str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        MapClient("tcp/127.0.0.1:1", **options)
