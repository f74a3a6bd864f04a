"""Memory goes back to the system."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

from potserver.allocator import give_back

PROGRAM = """
import numpy as np
from potserver.allocator import give_back, use_one_heap
from potserver.health import rss_bytes
use_one_heap()
arrays = [np.ones(8_000) for _ in range(3_000)]  # 190 MB in pieces that no page has to itself
del arrays[:-1]  # the last one holds the end of the heap
before = rss_bytes()
give_back()
print((before - rss_bytes()) // 2**20)
"""


AGAIN = """
import resource
import numpy as np
from potserver.allocator import use_one_heap
use_one_heap()

def work():
    for _ in range(3):
        np.ones(1_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

print(-work() + work())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc alone")
def test_holes_in_the_heap_go_back_to_the_system() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=120, check=True
    )
    assert int(done.stdout) > 100


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of glibc alone")
def test_what_a_scan_works_in_is_there_for_the_next_one() -> None:
    done = subprocess.run(
        [sys.executable, "-c", AGAIN], capture_output=True, text=True, timeout=120, check=True
    )
    assert int(done.stdout) < 100  # of 5,900 pages


def test_it_may_be_called_at_any_time() -> None:
    give_back()
    give_back()
