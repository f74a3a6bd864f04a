"""The authors' own Town 1 map on their own test points, from the files they ship; RePOT fitted to those, and an honest one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from potclient.arrays import Float64
from potclient.holdout import LabelledPoints
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet
from potserver.evaluation.mappers import Answer
from potserver.evaluation.paper.scenes import NoDataError
from potserver.evaluation.paper.table import Cell, Found, Lab, Shown, Table, score_cells
from potserver.evaluation.paper.trial import Row, fitted, scored
from potserver.mapping.refinement import flat_prior

_FOLDER, _MAP, _POINTS = "rss2020_pot", "town1_to_town1_map.npz", "town1_test_points.npz"
_SPLITS = 4
_ITERATIONS = 5  # of the authors' refinement
_AT_ONCE = 100  # points
_PRIOR_VAR = 100.0

Ask = Callable[[Float64], Answer]
Fit = Callable[[LabelledPoints], Ask]


def _cells(lab: Lab) -> list[Cell]:
    return [Cell("Town 1 to Town 1, as shipped", partial(_score, lab))]


def _load(data: Path | None) -> tuple[KernelMap, LabelledPoints]:
    folder = None if data is None else data / _FOLDER
    if folder is None or not (folder / _MAP).exists():
        raise NoDataError(f"no {_FOLDER}/{_MAP} in the folder of --data")
    with np.load(folder / _MAP) as kept, np.load(folder / _POINTS) as asked:
        town = KernelMap.from_arrays(
            kept["qhinge_mean"],
            kept["qgamma_mean_forward"],
            kept["qw_mean"],
            np.maximum(kept["qw_var"], 1e-12),
        )
        points = np.concatenate([asked["X_test"][:, 1:], np.zeros((len(asked["X_test"]), 1))], axis=1)
        return town, LabelledPoints(points=points, occupied=np.ravel(asked["Y_test"]) > 0.5)


def _score(lab: Lab) -> list[Row]:
    town, labels = _load(lab.data)
    common = {"kernels": len(town), "cpu_ms": 0.0}
    plain = town.occupancy(labels.points)
    rows = [{"map": "POT"} | scored(Answer(plain.mean, plain.observed), labels)]

    def jointly(prior: KernelSet) -> Fit:
        return lambda known: fitted(prior, known.points, known.occupied, threads=lab.threads)

    def singly(known: LabelledPoints) -> Ask:
        refined = KernelMap(authors_refined(town.kernels, known), rule=town.rule, threads=lab.threads)

        def ask(points: Float64) -> Answer:
            told = refined.occupancy(points)
            return Answer(told.mean, told.observed)

        return ask

    fits = {
        "RePOT as the authors do": singly,
        "RePOT, solved jointly": jointly(town.kernels),
        "RePOT, solved jointly, flat prior": jointly(flat_prior(town.kernels, _PRIOR_VAR)),
    }
    for name, fit in fits.items():
        rows.append(
            {"map": f"{name}: fitted to the test points"} | scored(fit(labels)(labels.points), labels)
        )
        rows.append({"map": f"{name}: fitted to half, scored on the other"} | _halves(fit, labels))
    return [row | common for row in rows]


def authors_refined(kernels: KernelSet, labels: LabelledPoints) -> KernelSet:
    """Weights by the authors' refinement (rows A20 and A22): singly, five times, each posterior the next prior.

    So data count five times. Jaakkola and Jordan's bound, variances without what kernels have in common.
    """
    mean, var = (a.astype(np.float64) for a in (kernels.weight_mean, kernels.weight_var))
    bound = np.ones(len(labels))
    for _ in range(_ITERATIONS):
        tightness = 0.5 / bound * (1.0 / (1.0 + np.exp(-bound)) - 0.5)
        pull, precision = mean / var, 1.0 / var
        for cut, phi in _features(kernels, labels.points):
            precision += 2.0 * tightness[cut] @ np.square(phi)
            pull += (labels.occupied[cut] - 0.5) @ phi
        mean, var = pull / precision, 1.0 / precision
        for cut, phi in _features(kernels, labels.points):
            bound[cut] = np.sqrt(np.square(phi) @ var + np.square(phi @ mean))
    return kernels.replace(weight_mean=mean.astype(np.float32), weight_var=var.astype(np.float32))


def _features(kernels: KernelSet, points: Float64) -> Iterator[tuple[slice, Float64]]:
    """Activations (n, K) of some points after the other."""
    for start in range(0, len(points), _AT_ONCE):
        cut = slice(start, start + _AT_ONCE)
        square = sum(np.square(points[cut, None, axis] - kernels.hinge_mean[:, axis]) for axis in range(2))
        yield cut, np.exp(-kernels.gamma * square)


def _halves(fit: Fit, labels: LabelledPoints) -> Row:
    """Means over random halves."""
    found = []
    for seed in range(_SPLITS):
        half = np.random.default_rng(seed).permutation(len(labels)) < len(labels) // 2
        known, asked = (
            LabelledPoints(points=labels.points[chosen], occupied=labels.occupied[chosen])
            for chosen in (half, ~half)
        )
        found.append(scored(fit(known)(asked.points), asked))
    return {field: float(np.mean([row[field] for row in found])) for field in found[0]}


def _show(found: Found) -> list[Shown]:
    theirs = {
        "POT": "0.79, 0.88, 1.14",
        "RePOT as the authors do: fitted to the test points": "0.95, 0.99, 0.71",
    }
    lines = [
        [row["map"], *score_cells(row), f"{row['nll_authors_clip']:.3f}", theirs.get(row["map"], "-")]
        for rows in found.values()
        for row in rows
    ]
    heads = ["map", "ACC", "AUC", "NLL", "ECE", "NLL, clip 1e-15", "the paper's ACC, AUC, NLL"]
    return [Shown("2,000 test points of the authors", heads, lines)]


SHIPPED = (
    Table(
        "shipped",
        "The authors' Town 1 map",
        "The same map and points as the authors': these figures can be compared one by one.",
        "2",
        _cells,
        _show,
    ),
)
