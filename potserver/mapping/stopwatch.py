"""Wall time of each step of a pipeline."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """`with clock("match"): ...` notes how long that took. Steps may run at the same time in different threads."""

    def __init__(self) -> None:
        self.timings_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, step: str) -> Iterator[None]:
        start_s = time.perf_counter()
        yield
        self.timings_ms[step] = (time.perf_counter() - start_s) * 1e3
