"""Pictures of towns: plans, views and scans. `python -m potclient.towns.pictures docs/towns.png` draws the styles."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Float64
from potclient.pictures import load_pyplot
from potclient.towns.raycast import RayScene
from potclient.towns.recording import TownRecording, open_town
from potclient.towns.solids import Kind, SolidSet
from potclient.towns.surveyed import PERIOD_S
from potclient.towns.town import Town

_COLOURS = {
    Kind.PAVEMENT: "#d9d4cb",
    Kind.BUILDING: "#b5715a",
    Kind.ROOF: "#8f4a3c",
    Kind.WALL: "#7d7468",
    Kind.HEDGE: "#5f8a4a",
    Kind.TREE: "#3f7a3a",
    Kind.POLE: "#303030",
    Kind.CAR: "#2f6db3",
    Kind.FURNITURE: "#c79a3b",
    Kind.PERSON: "#c2307a",
}
_ROAD, _SKY, _CEILING = "#8b8d92", "#dbe9f6", "#f1efe9"
_INNER_WALL = "#e3d9c6"
_GRASS = "#b9cf9f"  # the blocks of a suburb


def draw_plan(recording: TownRecording, path: Path, *, margin_m: float | None = None) -> None:
    """Draw a town from above, with the drive and the places of the scans.

    Args:
        recording: The drive.
        path: PNG file to write.
        margin_m: What is shown beyond the drive.
    Raises:
        UsageError: matplotlib is missing.
    """
    pyplot = load_pyplot()
    town = recording.town
    lower, upper = _extent(recording, margin_m)
    wide, high = upper - lower
    width = 11.0 if wide >= high else max(5.0, 11.0 * wide / high)
    figure, axis = pyplot.subplots(figsize=(width, width * high / wide + 0.8), layout="constrained")
    plot_plan(axis, town, lower, upper)
    plot_drive(axis, recording)
    kind = "dynamic" if town.dynamic else "static"
    axis.set_title(
        f"{town.style.name}, seed {town.seed}, {kind}: {town.drive.length_m:.0f} m, {len(recording)} scans"
    )
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def plot_plan(axis: Any, town: Town, lower: Float64, upper: Float64, *, time_s: float = 0.0) -> None:
    """The solids in a box (2,), (2,) m from above, on matplotlib axes."""
    from matplotlib.collections import PolyCollection

    outlines: list[Float64] = []
    colours: list[str] = []
    tops: list[float] = []
    below = math.inf if town.style.ceiling_m is None else town.style.ceiling_m - 0.1
    sets = [town.solids(cell) for cell in town.cells(lower, upper)]
    sets.append(SolidSet(town.moving(time_s, lower, upper)))
    for solids in sets:
        for k in range(len(solids)):
            if (solids.lower[k, :2] > upper).any() or (solids.upper[k, :2] < lower).any():
                continue
            if town.style.ceiling_m is not None and solids.lower[k, 2] > 1.9:
                continue  # lintels
            outlines.append(_hull(solids.corners(k)[:, :2]))
            kind = Kind(int(solids.kind[k]))
            colours.append(
                _GRASS if kind == Kind.PAVEMENT and town.style.name == "suburb" else _COLOURS[kind]
            )
            tops.append(min(float(solids.upper[k, 2]), below))
    order = np.argsort(tops, kind="stable")
    axis.set_facecolor(_CEILING if town.style.ceiling_m is not None else _ROAD)
    axis.add_collection(
        PolyCollection(
            [outlines[k] for k in order],
            facecolors=[colours[k] for k in order],
            edgecolors="#00000055",
            linewidths=0.2,
        )
    )
    axis.set(
        xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal", xlabel="x [m]", ylabel="y [m]"
    )


def plot_drive(axis: Any, recording: TownRecording) -> None:
    """The way, its beginning and the places of the scans."""
    town = recording.town
    way = town.drive.at(np.arange(0.0, town.drive.length_m, 0.1 if town.style.ceiling_m is not None else 0.5))
    axis.plot(way[:, 0], way[:, 1], color="#e8262a", linewidth=1.4, label="drive")
    at = town.drive.at(np.array(recording.indices) * PERIOD_S * town.style.speed_m_s)
    if len(at) <= 400:
        axis.plot(at[:, 0], at[:, 1], ".", color="#e8262a", markersize=3.0)
    axis.plot(*at[0, :2], "o", color="white", mec="#e8262a", markersize=6, label="start")
    axis.legend(loc="upper right", fontsize="small")


def render_view(
    town: Town,
    pose: Float64,
    *,
    time_s: float = 0.0,
    width: int = 640,
    height: int = 360,
    fov_rad: float = 1.3,
) -> NDArray[np.float64]:
    """(height, width, 3) in [0, 1]: what a camera at a pose (4, 4; x ahead, z up) sees, lit from above and one side.

    Raises:
        DatasetError: open3d is missing.
    """
    from matplotlib.colors import to_rgb

    eye, reach = pose[:3, 3], 180.0 if town.style.ceiling_m is None else 60.0
    sets = [town.solids(cell) for cell in town.cells(eye[:2] - reach, eye[:2] + reach)]
    sets.append(SolidSet(town.moving(time_s, eye[:2] - reach, eye[:2] + reach)))
    scene = RayScene(sets, eye[:2])
    fine = 2  # samples a pixel and axis
    half = math.tan(fov_rad / 2)
    across = np.linspace(half, -half, fine * width)
    up = np.linspace(half, -half, fine * height) * height / width
    rays = np.stack(np.broadcast_arrays(1.0, across[None, :], up[:, None]), axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays @ pose[:3, :3].T
    hits = scene.cast(eye, rays)
    palette = np.array([to_rgb(_COLOURS[Kind(k)]) for k in range(len(Kind))] + [to_rgb(_SKY)])
    if town.style.ceiling_m is not None:
        palette[Kind.WALL] = to_rgb(_INNER_WALL)
    if town.style.name == "suburb":
        palette[Kind.PAVEMENT] = to_rgb(_GRASS)
    colour, range_m, normals = palette[hits.kind], hits.range_m.copy(), hits.normals.astype(np.float64)
    for at, plain in ((0.0, _ROAD), (town.style.ceiling_m, _CEILING)):
        if at is None:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (at - eye[2]) / rays[:, 2]
        seen = (t > 0) & (t < range_m)
        range_m[seen], colour[seen], normals[seen] = t[seen], to_rgb(plain), (0.0, 0.0, 1.0)
    normals *= -np.sign((normals * rays).sum(axis=1, keepdims=True))
    sun = np.array([0.35, -0.5, 0.79])
    light = 0.62 + 0.38 * np.maximum(normals @ sun, 0.0) - 0.08 * (np.abs(normals[:, 0]) > 0.7)
    lit = np.isfinite(range_m)
    haze = 1 - np.exp(-range_m[lit] / 220.0)[:, None]
    colour[lit] = colour[lit] * light[lit, None] * (1 - haze) + np.array(to_rgb(_SKY)) * haze
    image: NDArray[np.float64] = colour.reshape(height, fine, width, fine, 3).mean(axis=(1, 3))
    return np.clip(image, 0.0, 1.0)


def draw_styles(path: Path, names: tuple[str, ...]) -> None:
    """Draw towns side by side: plan, view and one scan of each.

    Raises:
        UsageError: matplotlib is missing; DatasetError: open3d is, or a name means nothing.
    """
    pyplot = load_pyplot()
    figure, axes = pyplot.subplots(
        3,
        len(names),
        figsize=(5.2 * len(names), 13.2),
        height_ratios=(5.2, 2.9, 4.6),
        layout="constrained",
        squeeze=False,
    )
    for (plan, view, cloud), name in zip(axes.T, names, strict=True):
        recording = open_town(name)
        town = recording.town
        k = len(recording) // 3
        time_s = k * PERIOD_S
        pose = town.pose(time_s)
        indoors = town.style.ceiling_m is not None
        half = 14.0 if indoors else 85.0
        middle = pose[:2, 3]
        plot_plan(plan, town, middle - half, middle + half, time_s=time_s)
        plot_drive(plan, recording)
        plan.plot(
            *middle,
            marker=(3, 0, math.degrees(math.atan2(pose[1, 0], pose[0, 0])) - 90),
            color="#ffe14d",
            mec="black",
            markersize=11,
        )
        plan.set_title(f"{town.style.name}\n{_wrapped(town.style.summary)}", fontsize=11)
        if recording.lidar.is_planar:
            eye = pose.copy()
            eye[2, 3] = 1.5
        else:
            eye = pose
        view.imshow(render_view(town, eye, time_s=time_s), extent=(0, 16, 0, 9))
        view.set_axis_off()
        _plot_scan(cloud, recording, k, 12.0 if indoors else 40.0)
    figure.savefig(path, dpi=75)
    pyplot.close(figure)


def _plot_scan(axis: Any, recording: TownRecording, k: int, half_m: float) -> None:
    scan = recording[k]
    points = scan.points[scan.is_return]
    axis.set_facecolor("#101418")
    if scan.is_planar:
        axis.plot(points[:, 0], points[:, 1], ".", color="#ffd166", markersize=1.5)
    else:
        axis.scatter(
            points[:, 0],
            points[:, 1],
            c=points[:, 2],
            s=0.25,
            cmap="turbo",
            vmin=-2.0,
            vmax=4.0,
            linewidths=0,
        )
    axis.plot(0, 0, marker=(3, 0, -90), color="white", markersize=8)
    axis.set(
        xlim=(-half_m, half_m),
        ylim=(-half_m * 0.85, half_m * 0.85),
        aspect="equal",
        xlabel="ahead [m]",
        ylabel="left [m]",
    )
    axis.set_title(f"one scan: {recording.lidar.name}", fontsize=10)


def _wrapped(text: str) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, 52))


def _extent(recording: TownRecording, margin_m: float | None) -> tuple[Float64, Float64]:
    town = recording.town
    way = town.drive.at(np.arange(0.0, town.drive.length_m, 1.0))[:, :2]
    margin = margin_m if margin_m is not None else 6.0 if town.style.ceiling_m is not None else 45.0
    return way.min(axis=0) - margin, way.max(axis=0) + margin


def _hull(points: Float64) -> Float64:
    """The convex hull of points (N, 2), counter-clockwise (monotone chain)."""
    ordered = sorted(map(tuple, points.tolist()))
    chains = []
    for run in (ordered, ordered[::-1]):
        chain: list[Any] = []
        for p in run:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], p) <= 0:
                chain.pop()
            chain.append(p)
        chains.append(chain[:-1])
    return np.array(chains[0] + chains[1])


def _turn(a: Any, b: Any, c: Any) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def main(words: list[str]) -> None:
    """`FILE [NAME ...]`: pictures of the named towns, by default of all styles."""
    names = tuple(words[1:]) or (
        "town:terraces:dynamic:160m:1",
        "town:suburb:dynamic:200m:2",
        "town:downtown:dynamic:200m:1",
        "town:offices:2d:dynamic:30m:2",
    )
    draw_styles(Path(words[0]), names)


if __name__ == "__main__":
    main(sys.argv[1:])
