"""What a map takes of memory that grows for longer than memory would last, and what questions about its cold places cost.

    python benchmarks/paging.py --rooms 400 --resident-mb 100

A robot drives through rooms that all are new. Memory is what the system cannot take back: pages of the map that were read may
stay in memory as long as nobody needs it, and are counted apart.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.shared import keep, parser_of
from potserver.domain.map_size import MapSize
from potserver.domain.pages import Pages
from potserver.domain.types import Scan, yaw_pose
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings

_APART_M = 40.0
_ASKED = 1000  # points of a question
_QUESTIONS = 50


def main() -> int:
    """Run, and print what was measured."""
    parser = parser_of(__doc__)
    parser.add_argument("--rooms", type=int, default=400, help="how many (default 400)")
    parser.add_argument("--resident-mb", type=int, default=100, help="that may stay in memory (default 100)")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        pages = Pages(Path(folder), options.resident_mb * 2**20)
        found = _measure(pages, options.rooms)
        pages.close()
    for row in found["growth"]:
        print(", ".join(f"{name} {value}" for name, value in row.items()))
    print(found["questions"])
    keep(options, found)
    return 0


def _measure(pages: Pages, rooms: int) -> dict[str, Any]:
    mapper, size = MappingService(settings=MappingSettings(max_range_m=25.0)), MapSize()
    mapper.warm_up()
    growth, worst_ms = [], 0.0
    begun_mb = _memory_mb()["RssAnon"]
    for room in range(rooms):
        mapper.integrate(_scan(room))
        started_s = time.perf_counter()
        mapper.relieve(pages)
        worst_ms = max(worst_ms, (time.perf_counter() - started_s) * 1e3)
        if (room + 1) % (rooms // 8) == 0:
            memory = _memory_mb()
            growth.append(
                {
                    "rooms": room + 1,
                    "map, MB": size.of(mapper.state) >> 20,
                    "on pages, MB": pages.file.n_bytes >> 20,
                    "memory more than at the start, MB": memory["RssAnon"] - begun_mb,
                    "read pages in memory, MB": memory["RssFile"],
                    "longest move so far, ms": round(worst_ms),
                }
            )
    _leave_cache(pages)
    return {"growth": growth, "questions": _ask(mapper, rooms)}


def _ask(mapper: MappingService, rooms: int) -> dict[str, list[float]]:
    """Percentiles of questions about rooms that were left long ago, whose pages lie on the disk alone."""
    rng = np.random.default_rng(0)
    times: dict[str, list[float]] = {"first": [], "again": []}
    for room in rng.choice(rooms // 2, min(_QUESTIONS, rooms // 4), replace=False):
        points = rng.uniform([-8, -8, -1], [8, 8, 2], (_ASKED, 3))
        points[:, 0] += room * _APART_M
        for list_ms in times.values():
            started_s = time.perf_counter()
            mapper.snapshot.occupancy(points)
            list_ms.append((time.perf_counter() - started_s) * 1e3)
    return {
        f"{_ASKED} points, {kind}: p50, p95 and longest, ms": [
            round(float(v), 2) for v in np.percentile(list_ms, [50, 95, 100])
        ]
        for kind, list_ms in times.items()
    }


def _leave_cache(pages: Pages) -> None:
    """What was not read since it was written is on the disk alone then."""
    if pages.file.n_bytes:
        os.fsync(pages.file._fd)
        os.posix_fadvise(pages.file._fd, 0, 0, os.POSIX_FADV_DONTNEED)


def _scan(room: int) -> Scan:
    """A cluttered hall of 36 by 30 m, seen from its middle by 20,000 beams."""
    rng = np.random.default_rng(room)
    angle, range_m = rng.uniform(-np.pi, np.pi, 20_000), rng.uniform(6.0, 24.0, 24)
    range_of = range_m[((angle + np.pi) / (2 * np.pi) * 24).astype(int) % 24]
    points = np.stack(
        [range_of * np.cos(angle), range_of * np.sin(angle), rng.uniform(-1.5, 3.0, 20_000)], axis=1
    )
    pose = yaw_pose(_APART_M * room, 0.0, 0.0)
    return Scan(points=points.astype(np.float32), T_map_sensor=pose, robot_id="r1", seq=room)


def _memory_mb() -> dict[str, int]:
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return {words[0].rstrip(":"): int(words[1]) >> 10 for words in lines if words[0].startswith("Rss")}


if __name__ == "__main__":
    raise SystemExit(main())
