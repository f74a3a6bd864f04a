"""What a map says after one scan with few beams, and of space that its first scan did not see: with the dictionary and without.

    python benchmarks/thin.py --kitti FOLDER --json thin.json
    python benchmarks/thin.py --scans 3 --only "terraces, 16 rings"

Each cell maps one scan and asks about beams that were not mapped: their ends, and a point on each, uniform from the sensor to a
gap before the end (0.05 m; 0.5 m under protocol 1). `thin` rows ask about the same scan's other beams, `unseen` rows about
beams of scans 5 and 10 m farther, where the map of every fourth beam of the first has not observed anything.
What is unobserved counts as .5 in the columns without the dictionary. Numbers are means over scans, +- their deviation.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table
from shared import keep, parser_of

from potclient.datasets import RecordedScan, Recording
from potclient.metrics import Metrics, score
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Occupancy
from potserver.evaluation.rings import ring_numbers
from potserver.mapping.service import MappingService
from potserver.recordings import Reader, open_recording, to_scan

GAPS_M = (0.05, 0.5)
ASKED_BEAMS = 4_000
BORROWED = 0.5  # share from which an answer counts as borrowed


class Case(NamedTuple):
    """One row of the table."""

    place: str
    what: str  # "1/256" of the beams, "16 rings", or "unseen"

    @property
    def name(self) -> str:
        return f"{self.place}, {self.what}"


CASES = [
    Case(place, what)
    for place, whats in {
        "terraces": ("1/256", "1/1024", "16 rings", "4 rings", "unseen"),
        "downtown": ("16 rings", "unseen"),
        "KITTI": ("1/256", "4 rings", "16 rings", "unseen"),
    }.items()
    for what in whats
]
TOWNS = {"terraces": "town:terraces:300m:7", "downtown": "town:downtown:300m:7"}


class Labels(NamedTuple):
    """Points of known state."""

    points: np.ndarray[Any, Any]  # (N, 3) m, map frame
    occupied: np.ndarray[Any, Any]  # (N,)


class Asked(NamedTuple):
    """What three maps say about the same points."""

    leaning: Occupancy
    evidence: Occupancy  # of the same map, `evidence_only`
    bare: Occupancy  # of the map with an empty dictionary
    labels: Labels


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument(
        "--kitti", metavar="FOLDER", help="KITTI raw drive 0005; without it its rows are left out"
    )
    parser.add_argument("--scans", type=int, default=10, help="scans a row")
    parser.add_argument("--only", metavar="ROW", help="one row by its name")
    options = parser.parse_args()
    cases = [c for c in CASES if options.only in (None, c.name) and (options.kitti or c.place != "KITTI")]
    if not cases:
        sys.exit(f"no such row; there are: {'; '.join(c.name for c in CASES)}")
    rows = [row_of(case, recording_of(case, options), options.scans) for case in cases]
    show(rows)
    keep(options, rows)


def recording_of(case: Case, options: argparse.Namespace) -> Recording:
    if case.place == "KITTI":
        return open_recording(options.kitti, Reader(min_range_m=2.5, max_range_m=25.0))
    return open_recording(TOWNS[case.place], Reader(max_range_m=25.0, n_generated=300))


def row_of(case: Case, recording: Recording, n_scans: int) -> dict[str, Any]:
    """Scores of all scans of a row."""
    first = np.linspace(0, len(recording) * (0.6 if case.what == "unseen" else 1.0) - 1, n_scans).astype(int)
    found: dict[float, list[Asked]] = {gap: [] for gap in GAPS_M}
    for number in dict.fromkeys(first.tolist()):
        whole = recording[number]
        rng = np.random.default_rng((number, 11))
        mapped = drawn(case, whole, rng)
        maps = [one_scan_map(d, taken(whole, mapped)) for d in (AtomDictionary.builtin(), AtomDictionary())]
        for gap in GAPS_M:
            labels = labels_of(case, recording, number, ~mapped, gap)
            seen, bare = maps[0].snapshot, maps[1].snapshot
            if case.what == "unseen":
                unseen = ~bare.occupancy(labels.points).observed
                labels = Labels(labels.points[unseen], labels.occupied[unseen])
            answers = seen.occupancy(labels.points), seen.occupancy(labels.points, evidence_only=True)
            found[gap].append(Asked(*answers, bare.occupancy(labels.points), labels))
    return summary(case, found)


def one_scan_map(dictionary: AtomDictionary, scan: RecordedScan) -> MappingService:
    service = MappingService(dictionary)
    service.integrate(to_scan(scan, 0))
    return service


def drawn(case: Case, scan: RecordedScan, rng: np.random.Generator) -> np.ndarray[Any, Any]:
    """(N,) which beams are mapped."""
    n = len(scan)
    if case.what == "unseen":
        return np.arange(n) % 4 == 0
    if case.what.endswith("rings"):
        rings = ring_numbers(scan)
        every = (int(rings.max()) + 1) // int(case.what.split()[0])
        return np.asarray(rings % every == every // 2)
    few = n // int(case.what.partition("/")[2])
    return np.isin(np.arange(n), rng.choice(n, max(few, 1), replace=False))


def taken(scan: RecordedScan, members: np.ndarray[Any, Any]) -> RecordedScan:
    return dataclasses.replace(scan, points=scan.points[members], is_return=scan.is_return[members])


def labels_of(
    case: Case, recording: Recording, number: int, others: np.ndarray[Any, Any], gap_m: float
) -> Labels:
    """Ends and free points of beams that are not mapped."""
    if case.what != "unseen":
        return labels_on(taken(recording[number], others), gap_m)
    start = recording[number].T_map_sensor[:3, 3]
    parts, wanted = [], [5.0, 10.0]
    for later in range(number + 1, len(recording)):
        scan = recording[later]
        if np.linalg.norm(scan.T_map_sensor[:3, 3] - start) >= wanted[0]:
            labels = labels_on(scan, gap_m)
            near = np.linalg.norm(labels.points - start, axis=1) < 25.0
            parts.append(Labels(labels.points[near], labels.occupied[near]))
            wanted.pop(0)
        if not wanted:
            break
    return Labels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def labels_on(scan: RecordedScan, gap_m: float) -> Labels:
    rng = np.random.default_rng(len(scan))
    beams = rng.permutation(len(scan))[:ASKED_BEAMS]
    eye, ends = scan.T_map_sensor[:3, 3], scan.in_map[beams]
    length = np.linalg.norm(ends - eye, axis=1)
    share = (rng.random(len(beams)) * (length - gap_m) / length)[:, None]
    free = (eye + share * (ends - eye))[length > gap_m]
    hits = ends[scan.is_return[beams]]
    points = np.concatenate([hits, free])
    return Labels(points, np.arange(len(points)) < len(hits))


def summary(case: Case, found: dict[float, list[Asked]]) -> dict[str, Any]:
    """The numbers of a row."""

    def scores(asked: list[Asked], which: str, *, told: bool = False) -> list[Metrics]:
        return [
            score((o := getattr(a, which)).mean, a.labels.occupied, None if told else o.observed)
            for a in asked
        ]

    fine, coarse = (found[gap] for gap in GAPS_M)
    leaning = scores(fine, "leaning", told=True)
    pairs = [
        (a.leaning.mean[m], a.labels.occupied[m]) for a in fine if (m := a.leaning.borrowed > BORROWED).any()
    ]
    borrowed = score(*(np.concatenate(c) for c in zip(*pairs, strict=True))) if pairs else None
    nll = {
        "dictionary": [m.nll for m in leaning],
        "evidence_only": [m.nll for m in scores(fine, "evidence")],
        "empty": [m.nll for m in scores(fine, "bare")],
        "dictionary_protocol_1": [m.nll for m in scores(coarse, "leaning", told=True)],
        "empty_protocol_1": [m.nll for m in scores(coarse, "bare")],
    }
    return {
        "row": case.name,
        "n_scans": len(fine),
        "n_points": sum(len(a.labels.occupied) for a in fine),
        "nll": {name: [float(np.mean(v)), float(np.std(v))] for name, v in nll.items()},
        "auc": float(np.mean([m.auc for m in leaning])),
        "auc_empty": float(np.mean([m.auc for m in scores(fine, "bare")])),
        "share_borrowed": float(np.mean(np.concatenate([a.leaning.borrowed for a in fine]))),
        "ece_borrowed": None if borrowed is None else borrowed.ece,
    }


def show(rows: list[dict[str, Any]]) -> None:
    table = Table(title="one scan mapped; NLL on beams that were not")
    heads = ["row", "dictionary", "evidence only", "empty", "AUC", "(empty)", "borrowed", "its ECE"]
    for head in (*heads, "protocol 1", "(empty)"):
        table.add_column(head, justify="left" if head == "row" else "right")
    for row in rows:
        nll = {name: f"{mean:.3f} +- {sd:.3f}" for name, (mean, sd) in row["nll"].items()}
        ece = "" if row["ece_borrowed"] is None else f"{row['ece_borrowed']:.3f}"
        table.add_row(
            row["row"], nll["dictionary"], nll["evidence_only"], nll["empty"], f"{row['auc']:.3f}",
            f"{row['auc_empty']:.3f}", f"{row['share_borrowed']:.2f}", ece, nll["dictionary_protocol_1"],
            nll["empty_protocol_1"],
        )  # fmt: skip
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
