"""Draw the picture of docs/index.md: a map that grows in 3D, scan by scan.

    python docs/pictures/growing_map.py

A robot with a 64-ring LiDAR drives through a made-up street. After each scan the map is asked for the probability of occupancy
on a grid, and the surface where it crosses .5 is drawn, coloured by the standard deviation of that probability. Rays of the
picture march through the grid, so the surface is as smooth as the map. Takes half a minute on two processors.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import matplotlib
import numba as nb
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from potclient.towns import open_town
from potserver import MappingService, Scan

DATASET, SCANS = "town:terraces:7", slice(0, 120, 6)
CELL_M = 0.25
BEYOND_M = np.array([20.0, 20.0])  # of the grid, beyond the robot's way in x and y
BOTTOM_M, TOP_M = -0.75, 7.5
SIZE, MARGIN = (700, 420), 14  # pixels
VIEW_DEG = (236.0, 47.0)
FIELD_OF_VIEW = math.radians(38.0)
SKY = np.array([248.0, 249.0, 251.0])
LIGHT = np.array([-0.35, -0.5, 0.79])
MOST_SD = 0.45  # of the colours
ROBOT, INK = (214, 40, 40), (40, 44, 52)
MS_A_FRAME, MS_LAST = 350, 2600
N_COLOURS = 128


class Grid:
    """What the map says on a grid of cells, brought up to date tile by tile."""

    def __init__(self, lower: np.ndarray, upper: np.ndarray) -> None:
        self.lower = lower
        self.shape = tuple(np.ceil((upper - lower) / CELL_M).astype(int))
        self.mean = np.full(self.shape, 0.4, np.float32)  # unknown draws no surface
        self.sd = np.full(self.shape, 0.5, np.float32)

    def update(self, service: MappingService, tiles: list[tuple[int, int, int]], tile_m: float) -> None:
        """Ask the map again in some of its tiles."""
        for tile in np.asarray(tiles, np.float64):
            first = np.clip(np.ceil((tile * tile_m - self.lower) / CELL_M - 0.5), 0, self.shape).astype(int)
            last = np.clip(np.ceil(((tile + 1) * tile_m - self.lower) / CELL_M - 0.5), 0, self.shape).astype(
                int
            )
            if (first >= last).any():
                continue
            axes = [self.lower[c] + (np.arange(first[c], last[c]) + 0.5) * CELL_M for c in range(3)]
            points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
            answer = service.snapshot.occupancy(points.reshape(-1, 3))
            part = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
            shape = points.shape[:3]
            self.mean[part] = np.where(answer.observed, answer.mean, 0.4).reshape(shape)
            self.sd[part] = np.sqrt(answer.var).reshape(shape)


class Camera:
    """A pinhole that looks from an azimuth and an elevation, as near as it can see all of some points."""

    def __init__(self, points: np.ndarray, azimuth: float, elevation: float) -> None:
        back = np.array(
            [
                math.cos(azimuth) * math.cos(elevation),
                math.sin(azimuth) * math.cos(elevation),
                math.sin(elevation),
            ]
        )
        right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
        self.axes = np.stack([right, np.cross(back, right), back])  # right, up, back
        self.focal = 0.5 * SIZE[0] / math.tan(0.5 * FIELD_OF_VIEW)
        self.eye = points.mean(axis=0) + 500.0 * back
        for _ in range(60):  # centre, then come nearer by what is left at the edges
            pixel = self.project(points)
            middle = 0.5 * (pixel.min(axis=0) + pixel.max(axis=0)) - np.array(SIZE) / 2
            far = float((points - self.eye).mean(axis=0) @ -back)
            self.eye += (middle[0] * self.axes[0] - middle[1] * self.axes[1]) * far / self.focal
            fill = float(((pixel.max(axis=0) - pixel.min(axis=0)) / (np.array(SIZE) - 2 * MARGIN)).max())
            self.eye += (1.0 - fill) * -far * 0.5 * back

    def rays(self) -> np.ndarray:
        """(H, W, 3) unit directions of the pixels."""
        x = np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2
        y = SIZE[1] / 2 - np.arange(SIZE[1]) - 0.5
        in_camera = np.stack([*np.meshgrid(x, y), np.full(SIZE[::-1], -self.focal)], axis=-1)
        rays = in_camera @ self.axes
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def project(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) pixels of (N, 3) points, m."""
        in_camera = (points - self.eye) @ self.axes.T
        return in_camera[:, :2] * (self.focal / -in_camera[:, 2:]) * [1.0, -1.0] + np.array(SIZE) / 2


@nb.njit(nogil=True, cache=True, fastmath=True)
def trilinear(volume, x, y, z):
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    low = (volume[i, j, k] * (1 - u) + volume[i + 1, j, k] * u) * (1 - v)
    low += (volume[i, j + 1, k] * (1 - u) + volume[i + 1, j + 1, k] * u) * v
    high = (volume[i, j, k + 1] * (1 - u) + volume[i + 1, j, k + 1] * u) * (1 - v)
    high += (volume[i, j + 1, k + 1] * (1 - u) + volume[i + 1, j + 1, k + 1] * u) * v
    return low * (1 - w) + high * w


@nb.njit(nogil=True, cache=True, fastmath=True)
def march(mean, sd, eye, rays, step):
    """Where each ray first meets mean = .5: distance (inf: nowhere), unit normal, sd. Lengths in cells."""
    height, width = rays.shape[:2]
    distance = np.full((height, width), np.inf)
    normal = np.zeros((height, width, 3))
    spread = np.zeros((height, width))
    top = np.array([mean.shape[0] - 2.001, mean.shape[1] - 2.001, mean.shape[2] - 2.001])
    for r in range(height):
        for c in range(width):
            near, far = 0.0, np.inf
            for a in range(3):
                direction = rays[r, c, a]
                if abs(direction) < 1e-9:
                    direction = 1e-9
                one, other = (1.0 - eye[a]) / direction, (top[a] - eye[a]) / direction
                near, far = max(near, min(one, other)), min(far, max(one, other))
            t = near
            while t < far:
                x = eye + t * rays[r, c]
                value = trilinear(mean, x[0], x[1], x[2])
                if value >= 0.5:
                    low, high = max(t - step, near), t
                    for _ in range(6):
                        middle = 0.5 * (low + high)
                        x = eye + middle * rays[r, c]
                        if trilinear(mean, x[0], x[1], x[2]) >= 0.5:
                            high = middle
                        else:
                            low = middle
                    x = eye + high * rays[r, c]
                    distance[r, c] = high
                    n = np.zeros(3)
                    for a in range(3):
                        e = np.zeros(3)
                        e[a] = 0.8
                        p = np.minimum(np.maximum(x + e, 0.0), top)
                        q = np.minimum(np.maximum(x - e, 0.0), top)
                        n[a] = trilinear(mean, q[0], q[1], q[2]) - trilinear(mean, p[0], p[1], p[2])
                    normal[r, c] = n / max(np.sqrt((n * n).sum()), 1e-9)
                    spread[r, c] = trilinear(sd, x[0], x[1], x[2])
                    break
                t += step
    return distance, normal, spread


def draw(grid: Grid, camera: Camera, way: np.ndarray, caption: str) -> Image.Image:
    """One frame: the surface, the robot's way, (N, 3) m, and the legend."""
    distance, normal, sd = march(
        grid.mean, grid.sd, (camera.eye - grid.lower) / CELL_M - 0.5, camera.rays(), 0.6
    )
    distance *= CELL_M
    hit = np.isfinite(distance)
    colours = matplotlib.colormaps["viridis"](np.clip(sd / MOST_SD, 0.0, 1.0))[..., :3]
    light = LIGHT / np.linalg.norm(LIGHT)
    shade = 0.42 + 0.58 * np.clip((normal * light).sum(axis=-1), 0.0, 1.0)
    pixels = np.where(hit[..., None], 255.0 * colours * shade[..., None], SKY)
    image = Image.fromarray(pixels.round().astype(np.uint8))
    pen = ImageDraw.Draw(image)
    pixel = camera.project(way)
    if len(pixel) > 1:
        pen.line([tuple(p) for p in pixel], fill=(255, 255, 255), width=6, joint="curve")
        pen.line([tuple(p) for p in pixel], fill=ROBOT, width=3, joint="curve")
    x, y = pixel[-1]
    pen.ellipse([x - 7, y - 7, x + 7, y + 7], fill=ROBOT, outline=(255, 255, 255), width=2)
    legend(pen, caption)
    return image


def legend(pen: ImageDraw.ImageDraw, caption: str) -> None:
    """The caption, and the colours of the standard deviation."""
    font = ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), 12)
    width = 190
    x, y = SIZE[0] - width - 16, SIZE[1] - 62
    pen.text((x, y), caption, fill=INK, font=font)
    for i in range(width):
        colour = matplotlib.colormaps["viridis"](i / width)[:3]
        pen.line([(x + i, y + 20), (x + i, y + 29)], fill=tuple(int(255 * c) for c in colour))
    pen.text((x, y + 33), "0", fill=INK, font=font)
    pen.text((x + width / 2, y + 33), "sd of p", fill=INK, font=font, anchor="ma")
    pen.text((x + width, y + 33), f"{MOST_SD:.2f}".lstrip("0"), fill=INK, font=font, anchor="ra")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_suffix(".gif"))
    parser.add_argument("--frames", type=Path, help="write each frame as PNG into this folder too")
    parser.add_argument(
        "--view", type=float, nargs=2, default=VIEW_DEG, help="azimuth and elevation of the camera, degrees"
    )
    args = parser.parse_args()
    started = time.perf_counter()
    scans = list(open_town(DATASET)[SCANS])
    places = np.array([scan.T_map_sensor[:3, 3] for scan in scans])
    grid = Grid(
        np.append(places[:, :2].min(axis=0) - BEYOND_M, BOTTOM_M),
        np.append(places[:, :2].max(axis=0) + BEYOND_M, TOP_M),
    )
    around = np.array([[x, y, z] for x in (-13, 13) for y in (-13, 13) for z in (-2, 2)])
    camera = Camera((places[:, None] * [1, 1, 0] + around).reshape(-1, 3), *np.radians(args.view))
    service = MappingService()
    frames = []
    for number, scan in enumerate(scans, 1):
        update = service.integrate(
            Scan(
                points=scan.points,
                is_return=scan.is_return,
                T_map_sensor=scan.T_map_sensor,
                stamp_ns=scan.stamp_ns,
            )
        )
        grid.update(service, update.changed.tiles, update.changed.tile_size_m)
        caption = f"scan {number} of {len(scans)}: {update.map_kernels:,} kernels"
        frames.append(draw(grid, camera, places[:number] * [1, 1, 0] + [0, 0, 0.4], caption))
        if args.frames:
            args.frames.mkdir(parents=True, exist_ok=True)
            frames[-1].save(args.frames / f"{number:02d}.png")
        print(f"{caption}, {time.perf_counter() - started:.0f} s", flush=True)
    palette = frames[-1].quantize(N_COLOURS)
    paletted = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    paletted[0].save(
        args.output, save_all=True, append_images=paletted[1:], loop=0, optimize=True,
        duration=[MS_A_FRAME] * (len(frames) - 1) + [MS_LAST],
    )  # fmt: skip
    print(f"{args.output}: {args.output.stat().st_size / 1e3:,.0f} kB")


if __name__ == "__main__":
    main()
