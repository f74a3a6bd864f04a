"""Work spread over threads: same results, same order, errors passed on."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from potserver.numerics.threads import default_threads, parallel_map, spans


@given(n=st.integers(0, 300), parts=st.integers(-2, 40))
def test_spans_cover_the_range_once_in_nearly_equal_runs(n: int, parts: int) -> None:
    cut = spans(n, parts)
    assert [i for low, high in cut for i in range(low, high)] == list(range(n))
    sizes = [high - low for low, high in cut]
    assert not sizes or (min(sizes) > 0 and max(sizes) - min(sizes) <= 1)
    assert len(cut) <= max(parts, 1)


@pytest.mark.parametrize("threads", [0, 1, 2, 7])
def test_results_come_in_the_order_of_the_items(threads: int) -> None:
    assert parallel_map(lambda i: i * i, range(50), threads) == [i * i for i in range(50)]
    assert parallel_map(lambda i: i, [], threads) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_an_error_of_an_item_is_raised(threads: int) -> None:
    def fail(i: int) -> int:
        if i == 3:
            raise KeyError(i)
        return i

    with pytest.raises(KeyError):
        parallel_map(fail, range(6), threads)


def test_items_run_at_the_same_time() -> None:
    meeting = threading.Barrier(2, timeout=30)
    parallel_map(lambda _: meeting.wait(), range(2), 2)


def test_there_is_at_least_one_thread() -> None:
    assert default_threads() >= 1


ONE_THREAD = """
import numpy as np
from threadpoolctl import threadpool_info
from potserver.numerics.threads import use_one_blas_thread
use_one_blas_thread()
np.ones((300, 300)) @ np.ones((300, 300))
print(*(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"))
"""


def test_linear_algebra_of_a_program_stays_on_one_thread() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ONE_THREAD], capture_output=True, text=True, timeout=120, check=True
    )
    assert set(done.stdout.split()) == {"1"}
