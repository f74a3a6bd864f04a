"""What a dictionary gains by learning from the first half of a drive, asked on the second half, and what it loses elsewhere.

    python benchmarks/growth.py town:offices:100m:7 --json growth.json
    python benchmarks/growth.py balm_garage kitti_raw_drive0005 --min-range 2.5 --scans 5

Rows are those of `thin.py`, of scans in the second half: one is mapped with few of its beams and asked about the others, or
about space that it did not see. Then all that was learned goes into one dictionary, which every drive's rows are asked with.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from shared import keep, parser_of
from thin import GAPS_M, Case, Labels, drawn, labels_of, one_scan_map, taken

from potclient.datasets import Recording
from potclient.metrics import score
from potserver.atoms.growth import grow
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.looks import Looks
from potserver.errors import SettingsError
from potserver.recordings import Reader, open_recording, to_scan

WHATS = ("1/256", "16 rings", "4 rings", "unseen")
RANGE_M = 25.0
FOLLOWED_M = 5.5


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("drives", nargs="+", metavar="DATASET")
    parser.add_argument("--min-range", type=float, default=0.0, metavar="M", help="nearer beams are dropped")
    parser.add_argument(
        "--elsewhere", nargs="+", default=[], metavar="DATASET", help="asked, not learned from"
    )
    parser.add_argument("--scans", type=int, default=5, help="scans a row")
    options = parser.parse_args()
    reader = Reader(min_range_m=options.min_range, max_range_m=RANGE_M, n_generated=200)
    drives = {name: open_recording(name, reader) for name in options.drives}
    builtin = AtomDictionary.builtin()
    all_grown, own = builtin, {}
    for number, (drive, recording) in enumerate(drives.items()):
        looks = Looks()
        for i in range(len(recording) // 2):
            looks.take(to_scan(recording[i], i))
        growth = grow(builtin, f"drive-{number}", looks.scans, max_range_m=RANGE_M)
        own[drive] = growth.dictionary
        all_grown = all_grown.grow(growth.learned)
        print(
            f"{drive}: {len(looks.scans)} scans, held out {growth.nll_before:.3f} -> {growth.nll:.3f}",
            flush=True,
        )
    rows = []
    drives |= {name: open_recording(name, reader) for name in options.elsewhere}
    for drive, recording in drives.items():
        known = {"builtin": builtin, "grown": own.get(drive, builtin), "all": all_grown}
        for what in WHATS:
            with contextlib.suppress(SettingsError):  # a sensor without rings
                rows.append(row_of(drive, what, recording, options.scans, known))
                print(rows[-1], flush=True)
    show(rows)
    keep(options, rows)


def row_of(
    drive: str, what: str, recording: Recording, n_scans: int, known: dict[str, AtomDictionary]
) -> dict[str, Any]:
    """Scores of all scans of a row: the NLL and AUC of each dictionary, what is not observed included."""
    case, half, last = Case(drive, what), len(recording) // 2, len(recording) - 1
    if what == "unseen":  # of scans that others follow from which its space is seen
        end = recording[last].T_map_sensor[:3, 3]
        far = [np.linalg.norm(recording[i].T_map_sensor[:3, 3] - end) > FOLLOWED_M for i in range(half, last)]
        last = half + int(np.flatnonzero(far)[-1])
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in known}
    for number in dict.fromkeys(np.linspace(half, last, n_scans).astype(int).tolist()):
        whole = recording[number]
        mapped = drawn(case, whole, np.random.default_rng((number, 11)))
        labels = labels_of(case, recording, number, ~mapped, GAPS_M[0])
        scan = taken(whole, mapped)
        if what == "unseen":
            unseen = ~one_scan_map(AtomDictionary(), scan).snapshot.occupancy(labels.points).observed
            labels = Labels(labels.points[unseen], labels.occupied[unseen])
        for name, dictionary in known.items():
            told = score(
                one_scan_map(dictionary, scan).snapshot.occupancy(labels.points).mean, labels.occupied
            )
            found[name].append((told.nll, told.auc))
    return {"drive": Path(drive).name, "what": what, "n_scans": len(found["builtin"])} | {
        name: {"nll": float(np.mean([s[0] for s in scores])), "auc": float(np.mean([s[1] for s in scores]))}
        for name, scores in found.items()
    }


def show(rows: list[dict[str, Any]]) -> None:
    table = Table(title="second half of a drive, NLL / AUC on beams that were not mapped")
    for head in (
        "drive",
        "one scan mapped",
        "built-in dictionary",
        "grown on its first half",
        "grown on all",
    ):
        table.add_column(head, justify="left" if head == "drive" else "right")
    for row in rows:
        cells = [f"{row[name]['nll']:.3f} / {row[name]['auc']:.3f}" for name in ("builtin", "grown", "all")]
        table.add_row(row["drive"], row["what"], *cells)
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
