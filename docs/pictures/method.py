"""Draw the figure of docs/method.md: from a cloud to an answer in six panels.

    python docs/pictures/method.py

The cloud is the first of the two bundled scans of a street. All panels show the same run of `MappingService`, from above; the
coupling of panel 4 is solved again here, on fewer points, so that single lines can be seen.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.patches import Wedge

from potserver import KernelMap, MappingService, Scan
from potserver.bundled import open_bundled
from potserver.domain.types import Atom, KernelSet, MapUpdate, ParamsKind, SectorMatch
from potserver.numerics.coupling import couple
from potserver.numerics.geometry import in_sector, rotation_z

RADIUS_M = 25.0
VIEW_M = (-24.5, 19.5, -25.0, 11.0)  # x and y of the panels that show the whole scan
SLICE_M = (-1.2, 0.6)  # heights that panels 5 and 6 show, map frame
HIT, FREE, GREY, ATOM = "#c8382f", "#4a90c2", "#b9bec6", "#7a3fa0"
N_COUPLED = 120


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).with_suffix(".png"))
    args = parser.parse_args()
    service, recorded = MappingService(), open_bundled("street")[0]
    update = service.integrate(
        Scan(points=recorded.points, is_return=recorded.is_return, T_map_sensor=recorded.T_map_sensor),
        params=ParamsKind.TRANSPORTED,
    )
    ends = recorded.in_map
    matched = [sector for sector in update.sectors if sector.atom_id is not None]
    chosen = max(matched, key=lambda sector: sector.n_hits)
    atom = service.dictionary.get(chosen.atom_id)
    pyplot.rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.titlelocation": "left"})
    figure, axes = pyplot.subplots(2, 3, figsize=(11.0, 6.6), layout="constrained")
    for axis in axes.flat:
        axis.set_aspect("equal")
        axis.set_xticks([])
        axis.set_yticks([])
    draw_cloud(axes[0, 0], ends)
    draw_sectors(axes[0, 1], ends, update, chosen)
    draw_atom(axes[0, 2], atom)
    draw_transport(axes[1, 0], ends, atom, chosen)
    draw_map(axes[1, 1], service.snapshot.kernels)
    draw_answer(figure, axes[1, 2], service.snapshot)
    figure.savefig(args.output, dpi=100)
    print(f"{args.output}: {args.output.stat().st_size / 1e3:,.0f} kB, sector with {chosen.atom_id}")


def draw_cloud(axis: Any, ends: np.ndarray) -> None:
    """Echoes are occupied, points along the beams are free."""
    rng = np.random.default_rng(0)
    some = ends[rng.choice(len(ends), 5000, replace=False)]
    free = np.repeat(some, 3, axis=0) * rng.random((3 * len(some), 1))
    axis.scatter(*free[:, :2].T, s=1.6, c=FREE, lw=0)
    axis.scatter(*some[:, :2].T, s=2.2, c=HIT, lw=0)
    window(axis, "1  cloud: hits (red), free samples (blue)")


def draw_sectors(axis: Any, ends: np.ndarray, update: MapUpdate, chosen: SectorMatch) -> None:
    """The pie slices, each with the atom that serves it."""
    axis.scatter(*ends[::4, :2].T, s=1.0, c=GREY, lw=0)
    members = sector_members(ends, chosen)
    axis.scatter(*ends[members][::3, :2].T, s=1.2, c=HIT, lw=0)
    for sector in update.sectors:
        low, high = np.degrees([sector.azimuth_min_rad, sector.azimuth_max_rad])
        is_chosen = sector is chosen
        axis.add_patch(
            Wedge((0, 0), RADIUS_M, low, high, fill=False, lw=1.6 if is_chosen else 0.6, ec=HIT if is_chosen else "#5b6470",
                  zorder=3 if is_chosen else 2)
        )  # fmt: skip
        middle = 0.5 * (sector.azimuth_min_rad + sector.azimuth_max_rad)
        label = sector.atom_id or "no atom"
        turn = "" if sector.atom_id is None else f"\nturned {np.degrees(sector.rotation_rad):.0f}°"
        axis.text(
            11.5 * np.cos(middle), 10 * np.sin(middle), label + turn, ha="center", va="center", fontsize=7,
            bbox={"fc": "white", "ec": "none", "alpha": 0.8, "pad": 1}, zorder=4,
        )  # fmt: skip
    window(axis, "2  sectors, each with its nearest atom")


def draw_atom(axis: Any, atom: Atom) -> None:
    """The points of the chosen atom and the kernels that were learned on them."""
    circles(axis, atom.kernels, scale=1.0)
    axis.scatter(*atom.free_points[:, :2].T, s=3, c=FREE, lw=0)
    axis.scatter(*atom.hit_points[:, :2].T, s=3, c=HIT, lw=0)
    close_up(axis, atom.kernels.hinge_mean)
    axis.set_title(f"3  atom {atom.atom_id}: points, {len(atom.kernels)} kernels")


def draw_transport(axis: Any, ends: np.ndarray, atom: Atom, chosen: SectorMatch) -> None:
    """The coupling of the atom's hits with the sector's, both about their centres."""
    rng = np.random.default_rng(1)
    target = ends[sector_members(ends, chosen)].astype(np.float64)
    source = atom.hit_points.astype(np.float64)
    middle = 0.5 * (chosen.azimuth_min_rad + chosen.azimuth_max_rad)
    source = (source - source.mean(axis=0)) @ rotation_z(chosen.rotation_rad + middle).T + target.mean(axis=0)
    x, y = (points[rng.choice(len(points), N_COUPLED, replace=False)] for points in (source, target))
    plan = couple(
        x.astype(np.float32), y.astype(np.float32), reg=0.002, tolerance=1e-3, max_iterations=2000
    ).plan
    share = plan / plan.max()
    i, j = np.nonzero(share > 0.1)
    lines = np.stack([x[i, :2], y[j, :2]], axis=1)
    axis.add_collection(
        LineCollection(lines, colors="#30343c", linewidths=0.9 * share[i, j], alpha=0.8, zorder=1)
    )
    axis.scatter(*target[::6, :2].T, s=0.5, c="#eab3ae", lw=0, zorder=0)
    axis.scatter(*x[:, :2].T, s=12, c=ATOM, lw=0, zorder=2)
    axis.scatter(*y[:, :2].T, s=12, c=HIT, lw=0, zorder=2)
    close_up(axis, np.concatenate([x, y]))
    axis.set_title("4  transport: atom (violet) to sector (red)")


def draw_map(axis: Any, kernels: KernelSet) -> None:
    """The kernels of the overall map at some heights, coloured by weight."""
    z = kernels.hinge_mean[:, 2]
    circles(axis, kernels.take((z > SLICE_M[0]) & (z < SLICE_M[1])), scale=0.6)
    window(axis, f"5  overall map: {len(kernels):,} kernels by weight")


def draw_answer(figure: Any, axis: Any, snapshot: KernelMap) -> None:
    """The probability of occupancy at one height; unobserved cells stay white."""
    cell = 0.1
    x = np.arange(VIEW_M[0] + cell / 2, VIEW_M[1], cell)
    y = np.arange(VIEW_M[2] + cell / 2, VIEW_M[3], cell)
    points = np.stack(np.meshgrid(x, y, np.mean(SLICE_M), indexing="ij"), axis=-1)[:, :, 0].swapaxes(0, 1)
    answer = snapshot.occupancy(points.reshape(-1, 3))
    p = np.where(answer.observed, answer.mean, np.nan).reshape(len(y), len(x))
    drawn = axis.imshow(p, origin="lower", extent=VIEW_M, cmap="coolwarm", vmin=0, vmax=1)
    figure.colorbar(drawn, ax=axis, shrink=0.55, location="right", label="P(occupied)", pad=0.01)
    window(axis, f"6  answer at z = {np.mean(SLICE_M):.1f} m; white: unobserved")


def sector_members(points: np.ndarray, sector: SectorMatch) -> np.ndarray:
    """(N,) which points lie in a sector of the scan, whose sensor is at the origin."""
    return in_sector(points, sector.azimuth_min_rad, sector.azimuth_max_rad, RADIUS_M)


def circles(axis: Any, kernels: KernelSet, *, scale: float) -> None:
    """Kernels as circles: the radius is `scale` standard deviations of the Gaussian, the colour the weight's sign and size."""
    width = 2.0 * scale / np.sqrt(2.0 * kernels.gamma.astype(np.float64))
    most = np.percentile(np.abs(kernels.weight_mean), 90)
    shown = EllipseCollection(
        width, width, np.zeros(len(width)), units="xy", offsets=kernels.hinge_mean[:, :2], transOffset=axis.transData,
        cmap="coolwarm", array=kernels.weight_mean, clim=(-most, most), lw=0, alpha=0.5,
    )  # fmt: skip
    axis.add_collection(shown)


def close_up(axis: Any, points: np.ndarray) -> None:
    """A part of the map around points, in the shape of the other panels."""
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    shape = np.array([VIEW_M[1] - VIEW_M[0], VIEW_M[3] - VIEW_M[2]])
    half = 0.5 * shape * 1.08 * ((high - low) / shape).max()
    axis.set_xlim(*(0.5 * (low[0] + high[0]) + half[0] * np.array([-1, 1])))
    axis.set_ylim(*(0.5 * (low[1] + high[1]) + half[1] * np.array([-1, 1])))


def window(axis: Any, title: str) -> None:
    """The same part of the map for every panel that shows the whole scan."""
    axis.set_xlim(*VIEW_M[:2])
    axis.set_ylim(*VIEW_M[2:])
    axis.set_title(title)


if __name__ == "__main__":
    main()
