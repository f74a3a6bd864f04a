"""A planner: what a map that robot.py has filled says at points, on a grid, along rays, and about a path.

potserver serve
python clients/examples/planner.py [--connect tcp/127.0.0.1:7447] [--map default]
"""

from __future__ import annotations

import argparse

import numpy as np

from potclient import MapClient


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--map", default="default", metavar="ID")
    parser.add_argument("--at", type=float, nargs=3, metavar=("X", "Y", "Z"), help="where to ask, m")
    arguments = parser.parse_args()

    with MapClient(arguments.connect, map=arguments.map) as client:
        client.wait_ready()
        info = client.info()
        if info.lower is None or info.upper is None:
            raise SystemExit("the map is empty: publish something first, e.g. with robot.py")
        lower, upper = np.asarray(info.lower), np.asarray(info.upper)

        # A grid of any resolution, all cells from one revision of the map.
        grid = client.grid(lower, np.maximum(upper, lower + 0.5), resolution=0.5)
        free = grid.observed & (grid.mean < 0.25)
        print(f"{grid.shape} cells: {free.sum()} free, {(~grid.observed).sum()} unknown")

        # Where to ask: a free cell in the midst of what was observed, since most of the box may be unknown.
        cells = lower + 0.5 * (np.argwhere(free if free.any() else grid.observed) + 0.5)
        nearest = np.linalg.norm(cells - np.median(cells, axis=0), axis=1).argmin()
        here = np.array(arguments.at or cells[nearest].round(2))

        # Points: the probability, how sure the map is, and whether it has seen anything near.
        answer = client.occupancy([here], with_gradient=True)
        sd, known = np.sqrt(answer.var[0]), "observed" if answer.observed[0] else "unknown"
        print(f"{here}: P(occupied) {answer.mean[0]:.2f}, sd {sd:.2f}, {known}")

        # Rays: how far one sees from there, with quantiles.
        azimuth = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
        ways = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(8)], axis=1)
        rays = client.rays(here, ways, max_range_m=20.0, quantiles=[0.1, 0.9])
        for angle, mean_m, (low_m, high_m) in zip(azimuth, rays.mean_m, rays.quantile_m, strict=True):
            print(f"{np.degrees(angle):3.0f} degrees: {mean_m:.1f} m, 80 % in {low_m:.1f} to {high_m:.1f} m")

        # A path of poses, for a robot of one sphere: unknown cells count as occupied.
        path = np.tile(np.eye(4), (5, 1, 1))
        path[:, :3, 3] = here + np.linspace(0.0, 1.0, 5)[:, None] * [2.0, 0.0, 0.0]
        risk = client.risk(path, [0.0, 0.0, 0.0, 0.3])
        print(f"two metres ahead: a collision with probability {risk.path_union_probability:.2f}")


if __name__ == "__main__":
    main()
