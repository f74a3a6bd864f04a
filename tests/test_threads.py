"""Threads of the server, as the system sees them."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import pytest

from potserver.numerics.threads import parallel_pair
from potserver.threads import spawn


@pytest.mark.skipif(sys.platform != "linux", reason="names are shown on Linux")
def test_the_system_knows_threads_by_their_names() -> None:
    def shown() -> str:
        return Path(f"/proc/self/task/{threading.get_native_id()}/comm").read_text().strip()

    names = []
    spawn("a-map-writer", lambda: names.append(shown())).join(60.0)
    names.append(parallel_pair(lambda: None, shown, 2)[1])
    assert names == ["a-map-writer", "numerics-pair_0"]
