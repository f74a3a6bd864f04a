"""How far answers are from the truth, by what the map says of its errors; and the fit of what it says.

    python benchmarks/errors.py                                     # fits the constants, and says how well they hold
    python benchmarks/errors.py town:terraces:23 gauntlet:hdl64     # only says how well those of the package hold

Maps every tenth of 100 scans of made-up places, and asks each map about points of known state: uniform ones, and in balls of
half a metre about held-out hits. The fit is of `potschemas.answers`: G, B, B_VAR and B_DENSE, by the least log-loss over all
places, whose points count the same together. The table has, for bins of the standard deviation, the squared error over the
variance (1 is right, below 1 is careful) and the share of the observed points.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.optimize import minimize
from shared import keep, machine, parser_of

from potclient.arrays import Bool, Float64
from potclient.holdout import HoldOut
from potschemas import answers
from potserver.evaluation.questions import KeptBack
from potserver.evaluation.truth import SD_EDGES
from potserver.mapping.service import MappingService
from potserver.recordings import Reader, open_recording, to_scan

FITTED_ON = (
    *(
        f"town:{style}:{seed}"
        for seed in (11, 13)
        for style in ("terraces", "suburb:vlp16", "offices", "offices:2d")
    ),
    "town:downtown:13",
    "town:offices:13:vlp16",
    "gauntlet:hdl64",
    "gauntlet:vlp16",
)
SCANS, EVERY, MAX_RANGE_M = 100, 10, 25.0
LEAST_IN_A_BIN = 50
DENSE_THIN = 4  # every so many beams of sensors with 64 rings


class Seen(NamedTuple):
    """The observed points of one place."""

    z: Float64  # (N,) log-odds of the mean
    latent_var: Float64  # (N,)
    density: Float64  # (N,) known activation over that of a full lattice
    occupied: Bool  # (N,) the truth

    def errors(self, true: Float64) -> list[float]:
        """The squared error over the variance in each bin, and the share of points in it, if `true` are occupied."""
        mean = answers.sigmoid(self.z)
        squared = np.square(mean - self.occupied)
        var = true * (1.0 - mean) ** 2 + (1.0 - true) * mean**2
        found = []
        for low, high in zip(SD_EDGES[:-1], (*SD_EDGES[1:-1], np.inf), strict=True):
            rows = (np.sqrt(var) >= low) & (np.sqrt(var) < high)
            few = rows.sum() < LEAST_IN_A_BIN
            found += [
                float("nan") if few else float(squared[rows].mean() / var[rows].mean()),
                float(rows.mean()),
            ]
        return found


def seen_of(place: str) -> Seen:
    """Map a place and ask about it."""
    recording = open_recording(place, Reader(max_range_m=MAX_RANGE_M, n_generated=SCANS))
    service, kept_back = MappingService(threads=1), KeptBack(HoldOut(0.2), None)
    thin = 1 if "vlp16" in place or ":2d" in place else DENSE_THIN
    every = 1 if len(recording) < SCANS else EVERY
    for number in range(0, len(recording), every):
        whole = recording[number]
        whole = dataclasses.replace(whole, points=whole.points[::thin], is_return=whole.is_return[::thin])
        service.integrate(to_scan(kept_back.split(whole, number), number))
    questions = kept_back.questions(recording)
    if questions is None or questions.truth is None:
        raise SystemExit(f"{place}: its truth is not known, or it has no beams")
    labels, snapshot = questions.truth.labels, service.snapshot
    answer = snapshot.occupancy(labels.points)
    density = snapshot.latent(labels.points).activation / snapshot.rule.full_activation
    seen = answer.observed
    z = np.log(answer.mean[seen]) - np.log1p(-answer.mean[seen])
    return Seen(z, answer.latent_var[seen], density[seen], labels.occupied[seen])


def true_share(seen: Seen, constants: Float64) -> Float64:
    """(N,) how often such points are occupied, by G, B, B_VAR and B_DENSE."""
    slope, less, by_var, by_density = constants
    log_odds = (
        slope * seen.z - less + by_var * seen.latent_var - by_density * np.clip(seen.density - 1.0, 0.0, 1.0)
    )
    return answers.LEAST + (1.0 - 2.0 * answers.LEAST) * answers.sigmoid(log_odds)


def loss(constants: Float64, places: list[Seen]) -> float:
    """Nats a point, the mean over places."""
    found = []
    for seen in places:
        true = true_share(seen, constants)
        found.append(-np.log(np.where(seen.occupied, true, 1.0 - true)).mean())
    return float(np.mean(found))


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument(
        "places", nargs="*", help="made-up places; none: those that the constants are fitted on"
    )
    options = parser.parse_args()
    names = options.places or list(FITTED_ON)
    places = [seen_of(name) for name in names]
    constants = np.array([answers.G, answers.B, answers.B_VAR, answers.B_DENSE])
    found: dict[str, Any] = {"machine": machine(), "shipped": constants.tolist()}
    if not options.places:
        steps = minimize(loss, constants, args=(places,), method="Nelder-Mead")
        found["fitted"] = steps.x.tolist()
        print(
            "G, B, B_VAR, B_DENSE fitted:",
            steps.x.round(3),
            f"loss {steps.fun:.4f}, shipped {loss(constants, places):.4f}",
        )
    table = Table(title="squared error over variance (share of points), by standard deviation")
    table.add_column("place")
    for low, high in zip(SD_EDGES[:-1], (*SD_EDGES[1:-1], 1.0), strict=True):
        table.add_column(f"{low:g}-{high:g}", justify="right")
    found["places"] = {}
    for name, seen in zip(names, places, strict=True):
        errors = seen.errors(true_share(seen, constants))
        found["places"][name] = errors
        cells = zip(errors[::2], errors[1::2], strict=True)
        table.add_row(name, *(f"{ratio:.2f} ({100 * share:.0f} %)" for ratio, share in cells))
    Console(width=150).print(table)
    keep(options, found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
