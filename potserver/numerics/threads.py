"""Run a numba function that releases the GIL on a few threads.

numba's own `parallel=True` is not used: its default threading layer may not be entered from two Python threads at once, and a
map server always has a writer and readers inside the numerics at the same time.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from typing import TypeVar

from threadpoolctl import threadpool_limits

from potserver.thread_names import show_name

T = TypeVar("T")
R = TypeVar("R")


def default_threads() -> int:
    """The processors that this process may use."""
    return max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def use_one_blas_thread() -> None:
    """Let numpy's linear algebra stay on the thread that asks for it, in all of this process; for programs only.

    Its products are too small here to be shared out, and its threads wait for the next one by spinning: a tenth of what a
    server needed. Sums would also depend on the number of processors.
    """
    threadpool_limits(1, user_api="blas")


@cache
def _pool(threads: int, lane: str) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix=f"numerics-{lane}", initializer=show_name)


def parallel_map(function: Callable[[T], R], items: Iterable[T], threads: int, lane: str = "map") -> list[R]:
    """`[function(i) for i in items]`, in order, on `threads` threads; an error of any item is raised.

    Work of one lane never waits behind work of another: each has threads of its own.
    """
    work = list(items)
    if threads <= 1 or len(work) <= 1:
        return [function(item) for item in work]
    return list(_pool(threads, lane).map(function, work))


def parallel_pair(first: Callable[[], T], second: Callable[[], R], threads: int) -> tuple[T, R]:
    """Both results; at the same time if there are two threads or more. An error of either is raised, the first's before."""
    if threads <= 1:
        return first(), second()
    # a lane of its own: both may use `parallel_map` inside
    other = _pool(threads, "pair").submit(second)
    try:
        mine = first()
    finally:
        wait([other])  # nothing goes on behind the caller's back
    return mine, other.result()


def spans(n: int, parts: int) -> list[tuple[int, int]]:
    """`range(n)` cut into at most `parts` runs of nearly equal length, none empty."""
    parts = max(1, min(parts, n))
    return [(i * n // parts, (i + 1) * n // parts) for i in range(parts)] if n else []
