"""Draw docs/pictures/faces.png: walls, what is known behind them, and both along beams; ours beside OctoMap 0.1 m.

    python docs/pictures/faces.py [OUT]      some twenty seconds; needs the extra `peers`

Above, a horizontal slice of a made-up office at 1 m; white is unobserved. Below, the mean over beams of the last scan that
meet upright faces within 60 degrees of their normal, against the distance to the end of the beam.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from potclient.datasets import open_dataset
from potclient.towns import TownRecording
from potserver import AtomDictionary, MappingService, MappingSettings
from potserver.evaluation.mappers import ServiceMap
from potserver.evaluation.peers import peer_named

DATASET, N_SCANS, EVERY, THIN = "town:offices:23", 20, 5, 4
HEIGHT_M, HALF_M, CELL_M = 1.0, 6.0, 0.03
ALONG_M = np.linspace(-1.0, 0.8, 91)


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("faces.png")
    recording = open_dataset(DATASET, max_range_m=25.0, n_generated=N_SCANS * EVERY)
    assert isinstance(recording, TownRecording)
    scans = [recording[EVERY * k] for k in range(N_SCANS)]
    maps = [
        peer_named("octomap:0.1", threads=2),
        ServiceMap("ours", MappingService(AtomDictionary(()), MappingSettings())),
    ]
    keep = slice(None, None, THIN)
    for scan in scans:
        for one in maps:
            one.integrate(dataclasses.replace(scan, points=scan.points[keep], is_return=scan.is_return[keep]))

    figure = plt.figure(figsize=(11.5, 6.4), dpi=100, layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[3.4, 2.4])
    draw_slice(above, recording, scans, maps)
    draw_beams(below, recording, scans[-1], maps)
    figure.savefig(out)
    print(f"wrote {out}")


def draw_slice(figure, recording, scans, maps) -> None:
    centre = scans[N_SCANS // 2].T_map_sensor[:2, 3]
    along = np.arange(-HALF_M, HALF_M, CELL_M)
    x, y = np.meshgrid(centre[0] + along, centre[1] + along)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_M)])
    truth = recording.town.occupied(points, scans[-1].stamp_ns / 1e9).reshape(x.shape)
    panels = [("truth", np.where(truth, 1.0, 0.0), "coolwarm", 1.0)]
    for one in maps:
        answer = one.ask(points)
        p = np.where(answer.observed, answer.mean, np.nan).reshape(x.shape)
        panels.append((f"{one.name}: P(occupied)", p, "coolwarm", 1.0))
    sd = np.sqrt(answer.var).reshape(x.shape)
    panels.append(("ours: standard deviation", sd, "viridis", 0.5))
    extent = (-HALF_M, HALF_M, -HALF_M, HALF_M)
    for axis, (title, values, colours, most) in zip(figure.subplots(1, 4), panels, strict=True):
        shown = axis.imshow(values, origin="lower", extent=extent, cmap=colours, vmin=0.0, vmax=most)
        if title != "truth":
            axis.contour(truth, levels=[0.5], extent=extent, colors="black", linewidths=0.6, origin="lower")
        axis.set_title(title, fontsize=10, loc="left")
        axis.set_xticks([])
        axis.set_yticks([])
        figure.colorbar(shown, ax=axis, shrink=0.8)


def draw_beams(figure, recording, scan, maps) -> None:
    ends = scan.in_map[scan.is_return]
    origin = scan.T_map_sensor[:3, 3]
    rays = (ends - origin) / np.linalg.norm(ends - origin, axis=1)[:, None]
    met = recording.cast(recording.eye(scan.T_map_sensor), rays, scan.stamp_ns / 1e9)
    upright = (np.abs(met.normals[:, 2]) < 0.1) & (np.abs(np.sum(met.normals * rays, axis=1)) > 0.5)
    rays, range_m = rays[upright][:2000], met.range_m[upright][:2000]
    points = origin + rays[:, None] * (range_m[:, None] + ALONG_M)[..., None]
    axes = figure.subplots(1, 2)
    for one, colour in zip(maps, ("tab:gray", "tab:red"), strict=True):
        answer = one.ask(points.reshape(-1, 3))
        mean = answer.mean.reshape(len(rays), -1)
        axes[0].plot(ALONG_M, mean.mean(axis=0), color=colour, label=one.name)
        observed = answer.observed.reshape(len(rays), -1).mean(axis=0)
        axes[1].plot(ALONG_M, observed, color=colour, label=f"{one.name}: share observed")
        if answer.var is not None:
            sd = np.sqrt(answer.var).reshape(len(rays), -1).mean(axis=0)
            axes[1].plot(ALONG_M, sd, color=colour, linestyle="--", label=f"{one.name}: standard deviation")
    axes[0].set_ylabel("P(occupied)")
    for axis in axes:
        axis.axvline(0.0, color="black", linewidth=0.6)
        axis.set_ylim(0.0, 1.02)
        axis.set_xlabel("m behind the face")
        axis.legend(fontsize=8, loc="upper left" if axis is axes[0] else "center left")


if __name__ == "__main__":
    main()
