"""A planner: what a map says at points, on a grid, along rays, and about a path.

    potserver serve
    python clients/examples/planner.py [--connect tcp/127.0.0.1:7447] [--map default]

The map must hold something: robot.py sends scans.
"""

from __future__ import annotations

import argparse

import numpy as np

from potclient import MapClient


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--map", default="default", metavar="ID")
    arguments = parser.parse_args()

    with MapClient(arguments.connect, map=arguments.map) as client:
        client.wait_ready()
        info = client.info()
        if info.lower is None or info.upper is None:
            raise SystemExit("the map is empty: publish something first, e.g. with robot.py")
        lower, upper = np.asarray(info.lower), np.asarray(info.upper)
        middle = (lower + upper) / 2

        # Points: the probability, how sure the map is, and whether it has seen anything near.
        answer = client.occupancy([middle], with_gradient=True)
        known = "observed" if answer.observed[0] else "unknown"
        print(f"the middle: P(occupied) {answer.mean[0]:.2f}, sd {np.sqrt(answer.var[0]):.2f}, {known}")

        # A grid of any resolution, all cells from one revision of the map.
        upper = np.maximum(upper, lower + 0.5)
        grid = client.grid(lower, upper, resolution=0.5)
        free = grid.observed & (grid.mean < 0.25)
        print(f"{grid.shape} cells: {free.sum()} free, {(~grid.observed).sum()} unknown")

        # Rays: how far one sees from there, with quantiles.
        azimuth = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
        ways = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(8)], axis=1)
        rays = client.rays(middle, ways, max_range_m=20.0, quantiles=[0.1, 0.9])
        for angle, mean_m, (low_m, high_m) in zip(azimuth, rays.mean_m, rays.quantile_m, strict=True):
            print(f"{np.degrees(angle):3.0f} degrees: {mean_m:.1f} m, 80 % in {low_m:.1f} to {high_m:.1f} m")

        # A path of poses, for a robot of one sphere: unknown cells count as occupied.
        path = np.tile(np.eye(4), (5, 1, 1))
        path[:, :3, 3] = middle + np.linspace(0.0, 1.0, 5)[:, None] * [2.0, 0.0, 0.0]
        risk = client.risk(path, [0.0, 0.0, 0.0, 0.3])
        print(f"two metres ahead: a collision with probability {risk.path_union_probability:.2f}")


if __name__ == "__main__":
    main()
