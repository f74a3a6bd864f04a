"""A picture of atoms for people: their points, their kernels, and what the kernels say, on shared colour scales."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Atom, Float64, KernelSet
from potserver.errors import SettingsError
from potserver.mapping.pipeline import DEFAULT_RULE

_HIT, _FREE, _UNKNOWN, _FAINT = "#b2182b", "#2166ac", "#d9d9d9", 0.15
_AXES = "xyz"
_BAND_M = 0.5  # points and kernels this near to a slice are drawn in full colour
_TOUCH_M = 0.15  # hits this near to a slice are drawn over the prediction
_CELLS = 160  # of a prediction, along its longer side
_SCALES = {  # panel -> colour map; red is occupied and blue is free, everywhere
    "gamma": "cividis",
    "weight": "RdBu_r",
    "mean": "RdBu_r",
    "std": "viridis",
}
_TITLES = ("points", "kernels: width", "kernels: weight", "predicted occupancy", "its standard deviation")
# inches
_PANEL, _GAP, _LEFT, _RIGHT, _TOP, _HEADER, _TICKS, _BOTTOM = 3.1, 0.25, 0.75, 0.25, 0.8, 0.36, 0.5, 0.95


class _View(NamedTuple):
    """A plane through an atom: two axes that span it, the one across it, and where it cuts that one."""

    across: int
    right: int
    up: int
    level_m: float
    lower: Float64  # (2,) m, of the window, right and up
    upper: Float64

    @property
    def height_in(self) -> float:
        """Inches; the same scale along both axes."""
        width, height = self.upper - self.lower
        return float(_PANEL * height / width)


class _Palette(NamedTuple):
    """Scales that all atoms of a sheet share."""

    gamma: Normalize
    weight: Normalize
    mean: Normalize
    std: Normalize


def choose(dictionary: AtomDictionary, atom_ids: Sequence[str], limit: int) -> list[Atom]:
    """The atoms to draw: those that are named, else at most `limit`, spread evenly over the dictionary.

    Raises:
        UnknownAtomError: an id is not in the dictionary. SettingsError: nothing to draw.
    """
    if limit < 1:
        raise SettingsError(f"cannot draw {limit} atoms")
    if atom_ids:
        return [dictionary.get(atom_id) for atom_id in atom_ids]
    if len(dictionary) == 0:
        raise SettingsError("the dictionary has no atoms to draw")
    picked = np.unique(np.linspace(0, len(dictionary) - 1, min(limit, len(dictionary))).round().astype(int))
    atoms = dictionary.atoms
    return [atoms[i] for i in picked]


def draw_sheet(atoms: Sequence[Atom], path: str | Path, *, title: str = "") -> None:
    """Draw one row of panels for each atom from above, and for those in 3D a second one from the side.

    Args:
        atoms: At least one.
        path: PNG file to write.
        title: Over the picture.
    Raises:
        OSError: the file cannot be written.
    """
    views = [views_of(atom) for atom in atoms]
    palette = _palette(atoms)
    width = _LEFT + 5 * _PANEL + 4 * _GAP + _RIGHT
    rows = [[view.height_in + _TICKS for view in of_atom] for of_atom in views]
    height = _TOP + sum(_HEADER + sum(row) for row in rows) + _BOTTOM
    figure = Figure(figsize=(width, height), dpi=110, facecolor="white")
    figure.text(_LEFT / width, 1 - 0.16 / height, title, fontsize=13, weight="bold", va="top")
    at = height - _TOP
    for number, (atom, of_atom) in enumerate(zip(atoms, views, strict=True)):
        at -= _HEADER
        # `$` would begin a formula
        name = figure.text(
            _LEFT / width, (at + 0.08) / height, atom.atom_id, fontsize=10.5, weight="bold", parse_math=False
        )
        if number == 0:
            _draw_titles(figure, height)
        for view in of_atom:
            at -= view.height_in
            panel = _draw_row(figure, atom, view, palette, at / height, view.height_in / height)
            at -= _TICKS
        panel.annotate(
            _header(atom),
            (1, 0.5),
            (12, 0),
            name,
            "offset points",
            fontsize=10.5,
            va="center",
            annotation_clip=False,
        )
    _draw_scales(figure, palette, height)
    figure.savefig(path)


# --- what to show -------------------------------------------------------------------------------------------


def _header(atom: Atom) -> str:
    parts = [
        f"{atom.dims}D, {math.degrees(atom.azimuth_width_rad):.0f}° × {atom.radius_m:g} m",
        f"{len(atom.hit_points)} hits, {len(atom.free_points)} free points, {len(atom.kernels)} kernels",
    ]
    scores = [
        f"{name.upper()} {atom.provenance[key]}"
        for name in ("auc", "nll", "ece")
        if (key := f"held_out_{name}") in atom.provenance
    ]
    if scores:
        parts.append(f"held-out beams: {', '.join(scores)}")
    return "   |   ".join(parts)


def views_of(atom: Atom) -> list[_View]:
    """From above, and of an atom in 3D from the side too."""
    planes = [(2, 0, 1)] if atom.dims == 2 else [(2, 0, 1), (1, 0, 2)]
    return [_view(atom, *plane) for plane in planes]


def _view(atom: Atom, across: int, right: int, up: int) -> _View:
    sensor = np.zeros((1, 3))
    shown = np.concatenate([atom.hit_points, atom.free_points, atom.kernels.hinge_mean, sensor])[
        :, [right, up]
    ]
    margin = 0.03 * float(np.ptp(shown, axis=0).max()) + 0.2
    lower, upper = shown.min(axis=0) - margin, shown.max(axis=0) + margin
    # very flat or very tall windows would make panels that nobody can read
    width, height = upper - lower
    grow = np.maximum([height / 1.5 - width, 0.22 * width - height], 0.0) / 2.0
    level = 0.0 if atom.dims == 2 else slice_level(atom, across)
    return _View(across, right, up, level, np.float64(lower - grow), np.float64(upper + grow))


def slice_level(atom: Atom, across: int) -> float:
    """m: where a slice cuts walls and free space both; one along the floor, or through the sky, would say little."""
    hits, free = atom.hit_points[_on_walls(atom.hit_points, across), across], atom.free_points[:, across]
    both = np.concatenate([hits, free])
    levels = np.arange(math.floor(both.min() * 4), math.ceil(both.max() * 4) + 1) / 4.0
    near_hits, near_free = (
        (np.abs(points[:, None] - levels) < _BAND_M).sum(axis=0) for points in (hits, free)
    )
    return float(levels[int(np.argmax((near_hits + 1) * (near_free + 1)))])


def _on_walls(hits: NDArray[Any], across: int) -> NDArray[np.bool_]:
    """(H,) hits above the foot of columns of a square metre that reach more than a metre; all, if there are none such."""
    columns = np.floor(np.delete(hits, across, axis=1)).astype(np.int64)
    _, column = np.unique(columns, axis=0, return_inverse=True)
    column = column.reshape(-1)
    low, high = np.full(len(hits), np.inf), np.full(len(hits), -np.inf)
    np.minimum.at(low, column, hits[:, across])
    np.maximum.at(high, column, hits[:, across])
    on_walls: NDArray[np.bool_] = ((high - low)[column] > 1.0) & (hits[:, across] > low[column] + 0.4)
    return on_walls if on_walls.any() else np.ones(len(hits), np.bool_)


def _palette(atoms: Sequence[Atom]) -> _Palette:
    gamma = np.concatenate([atom.kernels.gamma for atom in atoms])
    weight = np.abs(np.concatenate([atom.kernels.weight_mean for atom in atoms]))
    low, high = (float(gamma.min()), float(gamma.max())) if len(gamma) else (0.1, 1.0)
    # the few largest weights would leave no colour for the rest
    most = max(float(np.quantile(weight, 0.98)), 1e-3) if len(weight) else 1.0
    return _Palette(
        LogNorm(low / 1.05, high * 1.05), Normalize(-most, most), Normalize(0.0, 1.0), Normalize(0.0, 0.5)
    )


# --- drawing ------------------------------------------------------------------------------------------------


def _column(figure: Figure, column: int) -> tuple[float, float]:
    """Left edge and width of a column of panels, in figure fractions."""
    width = float(figure.get_size_inches()[0])
    return (_LEFT + column * (_PANEL + _GAP)) / width, _PANEL / width


def _draw_titles(figure: Figure, height: float) -> None:
    for column, title in enumerate(_TITLES):
        left, wide = _column(figure, column)
        figure.text(left + wide / 2, 1 - (_TOP - 0.1) / height, title, fontsize=11, ha="center", va="bottom")


def _draw_row(
    figure: Figure, atom: Atom, view: _View, palette: _Palette, bottom: float, height: float
) -> Any:
    """One view; its first panel."""
    panels: list[Any] = []
    for column in range(5):
        left, wide = _column(figure, column)
        axes = figure.add_axes((left, bottom, wide, height))
        axes.set_xlim(view.lower[0], view.upper[0])
        axes.set_ylim(view.lower[1], view.upper[1])
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7.5, length=2.5, labelleft=column == 0)
        axes.set_xlabel(f"{_AXES[view.right]} / m", fontsize=8, labelpad=1)
        if column == 0:
            axes.set_ylabel(f"{_AXES[view.up]} / m", fontsize=8, labelpad=1)
        panels.append(axes)
    points, by_gamma, by_weight, mean, std = panels
    _draw_points(points, atom.free_points, view, _FREE)
    _draw_points(points, atom.hit_points, view, _HIT)
    # narrow ones on top of wide ones
    kernels = atom.kernels.take(np.argsort(atom.kernels.gamma, kind="stable"))
    _draw_kernels(by_gamma, kernels, kernels.gamma, view, "gamma", palette.gamma)
    _draw_kernels(by_weight, kernels, kernels.weight_mean, view, "weight", palette.weight)
    _draw_prediction(mean, std, atom, view, palette)
    for axes in panels:
        _draw_sector(axes, atom, view)
    if atom.dims == 3:
        points.text(
            0.02, 0.97, f"bold: within {_BAND_M:g} m of {_AXES[view.across]} = {view.level_m:g} m", fontsize=7.5,
            transform=points.transAxes, va="top", bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 1.5},
        )  # fmt: skip
        for axes in (mean, std):
            axes.text(
                0.02, 0.97, f"slice at {_AXES[view.across]} = {view.level_m:g} m", fontsize=7.5, va="top",
                transform=axes.transAxes, bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 1.5},
            )  # fmt: skip
    return points


def _near(points: NDArray[Any], view: _View) -> NDArray[Any]:
    """(N,) opacity: full near the slice, faint elsewhere."""
    return np.where(np.abs(points[:, view.across] - view.level_m) <= _BAND_M, 1.0, _FAINT)


def _draw_points(axes: Any, points: NDArray[Any], view: _View, colour: str) -> None:
    if len(points) == 0:  # matplotlib takes no empty list of opacities
        return
    axes.scatter(points[:, view.right], points[:, view.up], s=5, c=colour, alpha=_near(points, view), lw=0)


def _draw_kernels(
    axes: Any,
    kernels: KernelSet,
    values: NDArray[Any],
    view: _View,
    scale: str,
    norm: Normalize,
) -> None:
    """Discs of half a length scale, so that neighbours do not cover one another."""
    if len(kernels) == 0:
        return
    points_a_metre = 72.0 * _PANEL / float(view.upper[0] - view.lower[0])
    diameter = np.clip(points_a_metre / np.sqrt(2.0 * kernels.gamma), 2.5, 14.0)
    hinges = kernels.hinge_mean
    axes.scatter(
        hinges[:, view.right], hinges[:, view.up], s=np.square(diameter), c=values, cmap=_SCALES[scale], norm=norm,
        alpha=np.maximum(_near(hinges, view), 0.3), edgecolors="#404040", linewidths=0.2,
    )  # fmt: skip


def _draw_prediction(mean: Any, std: Any, atom: Atom, view: _View, palette: _Palette) -> None:
    cell = float((view.upper - view.lower).max()) / _CELLS
    n_right, n_up = (np.ceil((view.upper - view.lower) / cell)).astype(int)
    right, up = np.meshgrid(
        view.lower[0] + (np.arange(n_right) + 0.5) * cell, view.lower[1] + (np.arange(n_up) + 0.5) * cell
    )
    points = np.full((right.size, 3), view.level_m)
    points[:, view.right], points[:, view.up] = right.ravel(), up.ravel()
    answer = KernelMap(atom.kernels, rule=DEFAULT_RULE, threads=1).occupancy(points)
    extent = (
        view.lower[0], view.lower[0] + n_right * cell, view.lower[1], view.lower[1] + n_up * cell
    )  # fmt: skip
    for axes, values, scale, norm in (
        (mean, answer.mean, "mean", palette.mean),
        (std, np.sqrt(answer.var), "std", palette.std),
    ):
        axes.set_facecolor(_UNKNOWN)
        axes.imshow(
            np.ma.masked_where(~answer.observed, values).reshape(n_up, n_right), origin="lower", extent=extent,
            cmap=_SCALES[scale], norm=norm, interpolation="nearest",
        )  # fmt: skip
        axes.set_xlim(view.lower[0], view.upper[0])
        axes.set_ylim(view.lower[1], view.upper[1])
    near = atom.hit_points[np.abs(atom.hit_points[:, view.across] - view.level_m) <= _TOUCH_M]
    mean.scatter(near[:, view.right], near[:, view.up], s=2.5, c="black", lw=0)


def _draw_sector(axes: Any, atom: Atom, view: _View) -> None:
    """The sensor, and from above the sector's edges."""
    axes.plot(0, 0, marker="^", ms=5, c="black", mec="white", mew=0.5, zorder=5, clip_on=True)
    if view.across != 2:
        return
    half = atom.azimuth_width_rad / 2.0
    arc = np.linspace(-half, half, 60)
    outline = np.concatenate(
        [[[0.0, 0.0]], atom.radius_m * np.stack([np.cos(arc), np.sin(arc)], axis=1), [[0.0, 0.0]]]
    )
    axes.plot(outline[:, 0], outline[:, 1], c="#606060", lw=0.8, ls=(0, (4, 3)), zorder=4)


def _draw_scales(figure: Figure, palette: _Palette, height: float) -> None:
    left, wide = _column(figure, 0)
    marks = [
        Line2D([], [], marker="o", ls="", ms=4, c=_HIT, label="hit"),
        Line2D([], [], marker="o", ls="", ms=4, c=_FREE, label="free"),
        Line2D([], [], marker="^", ls="", ms=6, c="black", label="sensor"),
        Line2D([], [], c="#606060", lw=0.8, ls=(0, (4, 3)), label="sector"),
    ]
    figure.legend(
        handles=marks, loc="center", bbox_to_anchor=(left + wide / 2, 0.6 / height), ncols=4, fontsize=8, frameon=False,
        handletextpad=0.3, columnspacing=1.0,
    )  # fmt: skip
    for column, (scale, norm, label, extend) in enumerate(
        (
            ("gamma", palette.gamma, "mean of gamma / m⁻² (narrow kernels are yellow)", "neither"),
            ("weight", palette.weight, "mean weight / log-odds", "both"),
            ("mean", palette.mean, "P(occupied); grey: unknown; dots: hits", "neither"),
            ("std", palette.std, "standard deviation of P(occupied)", "neither"),
        ),
        start=1,
    ):
        left, wide = _column(figure, column)
        axes = figure.add_axes((left + 0.05 * wide, 0.58 / height, 0.9 * wide, 0.13 / height))
        bar = figure.colorbar(
            ScalarMappable(norm, _SCALES[scale]), cax=axes, orientation="horizontal", extend=extend
        )
        if scale == "gamma":
            bar.ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            bar.ax.xaxis.set_major_formatter(FormatStrFormatter("%g"))
            bar.ax.xaxis.set_minor_locator(NullLocator())
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=7.5)
