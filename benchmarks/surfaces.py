"""Where a map answers a surface: how far before the face p crosses .5, and what it says behind a wall.

    python benchmarks/surfaces.py walls
    python benchmarks/surfaces.py DATASET [--scans 0:100:5] [--min-range 0.3] [--max-range 25] [--thin 1]

`walls` maps one flat wall seen head-on, at several distances. A dataset is asked along a fifth of each scan's beams, held out
of training: the crossing is the first p >= .5 between 1.2 m before and 1.2 m behind the measured end.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools

import numpy as np

from potclient.datasets import open_dataset
from potclient.holdout import HoldOut
from potserver import MappingService, Scan

REACH_M, STEP_M = 1.2, 0.02
RANGES_M = (0.0, 5.0, 10.0, 25.0)
MOST_BEAMS = 20_000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("--scans", default="::")
    parser.add_argument("--min-range", type=float, default=0.3)
    parser.add_argument("--max-range", type=float, default=25.0)
    parser.add_argument("--thin", type=int, default=1, help="every n-th point")
    options = parser.parse_args()
    if options.dataset == "walls":
        for distance_m in (2.0, 5.0, 10.0, 20.0):
            crossing = wall_crossing(distance_m)
            print(
                f"wall at {distance_m:4.0f} m, seen five times: p reaches .5 {100 * crossing:.0f} cm before it"
            )
        behind_a_wall()
    else:
        dataset_crossings(options)


def wall_scan(distance_m: float, n: int, rng: np.random.Generator, noise_m: float) -> Scan:
    """A scan of nothing but the plane x = distance, from the origin."""
    azimuth, elevation = rng.uniform(-0.9, 0.9, n), rng.uniform(-0.3, 0.3, n)
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    points = directions * (distance_m / directions[:, :1] + rng.normal(0.0, noise_m, (n, 1)))
    return Scan(points=points, T_map_sensor=np.eye(4))


def wall_crossing(distance_m: float) -> float:
    """m before a wall at which p crosses .5, mean over six lines of sight, after five scans."""
    rng, service = np.random.default_rng(0), MappingService(threads=1)
    for _ in range(5):
        service.integrate(wall_scan(distance_m, 8000, rng, 0.01))
    x = np.linspace(distance_m - 1.0, distance_m + 0.5, 301)
    lines = [
        np.stack([x, np.full(301, y), np.full(301, z)], axis=1) for y in (-0.5, 0.0, 0.5) for z in (-0.2, 0.2)
    ]
    mean = np.mean([service.snapshot.occupancy(line).mean for line in lines], axis=0)
    return distance_m - float(x[np.argmax(mean >= 0.5)])


def behind_a_wall() -> None:
    """What one scan of a wall at 3 m makes the map say behind it, where no beam ever was."""
    service = MappingService(threads=1)
    service.integrate(wall_scan(3.0, 6000, np.random.default_rng(0), 0.02))
    behind = np.array([0.0, 0.3, 0.5, 1.0, 1.5])
    answer = service.snapshot.occupancy(np.stack([3.0 + behind, 0 * behind, 0 * behind], axis=1))
    for depth, mean, var, observed in zip(behind, answer.mean, answer.var, answer.observed, strict=True):
        seen = "observed" if observed else "unobserved"
        print(f"{depth:.1f} m behind a wall at 3 m: p {mean:.3f}, sd {var**0.5:.3f}, {seen}")


def dataset_crossings(options: argparse.Namespace) -> None:
    """Print where p crosses .5 along held-out beams, by range."""
    recording = open_dataset(options.dataset, min_range_m=options.min_range, max_range_m=options.max_range)
    numbers = range(len(recording))[
        slice(*(int(part) if part else None for part in options.scans.split(":")))
    ]
    service, hold_out = MappingService(), HoldOut()
    origins, ends = [], []
    for number in numbers:
        whole = recording[number]
        whole = dataclasses.replace(
            whole, points=whole.points[:: options.thin], is_return=whole.is_return[:: options.thin]
        )
        scan, _ = hold_out.split(whole, number)
        service.integrate(
            Scan(
                points=scan.points, is_return=scan.is_return, T_map_sensor=scan.T_map_sensor,
                stamp_ns=scan.stamp_ns, is_planar=scan.is_planar,
            )
        )  # fmt: skip
        held = whole.in_map[hold_out.beams(len(whole), number) & whole.is_return]
        ends.append(held)
        origins.append(np.broadcast_to(whole.T_map_sensor[:3, 3], held.shape))
    origin, end = np.concatenate(origins), np.concatenate(ends)
    chosen = np.random.default_rng(0).permutation(len(end))[:MOST_BEAMS]
    origin, end = origin[chosen], end[chosen]
    range_m = np.linalg.norm(end - origin, axis=1)
    usable = range_m > REACH_M
    origin, end, range_m = origin[usable], end[usable], range_m[usable]
    crossing = crossings(service, origin, end, range_m)
    print(
        f"{options.dataset}: {len(numbers)} scans, {len(end):,} held-out beams, {len(service.snapshot):,} kernels"
    )
    print("range, m   beams   median  5 %  95 % (cm before the measured end)   none")
    for low, high in [*itertools.pairwise(RANGES_M), (0.0, np.inf)]:
        inside = (range_m >= low) & (range_m < high)
        found = 100 * crossing[inside & np.isfinite(crossing)]
        if len(found):
            q = np.percentile(found, [50, 5, 95])
            label = "all" if high == np.inf else f"{low:g}-{high:g}"
            none = np.isnan(crossing[inside]).mean()
            print(f"{label:9s} {inside.sum():6,d}   {q[0]:6.0f} {q[1]:4.0f} {q[2]:5.0f}   {none:42.1%}")


def crossings(
    service: MappingService, origin: np.ndarray, end: np.ndarray, range_m: np.ndarray
) -> np.ndarray:
    """(N,) m before each end at which p first is .5 or more; NaN where it is nowhere, or from the start."""
    before = np.arange(REACH_M, -REACH_M - STEP_M / 2, -STEP_M)
    direction = (end - origin) / range_m[:, None]
    points = end[:, None] - before[None, :, None] * direction[:, None]
    mean = service.snapshot.occupancy(points.reshape(-1, 3)).mean.reshape(len(end), -1)
    over = mean >= 0.5
    return np.where(over.any(axis=1) & ~over[:, 0], before[over.argmax(axis=1)], np.nan)


if __name__ == "__main__":
    main()
