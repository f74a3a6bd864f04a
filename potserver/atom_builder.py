"""`potserver atoms build`: learn a dictionary from recordings, and say how good each atom is on beams it never saw."""

from __future__ import annotations

import argparse
import dataclasses
import logging
from pathlib import Path

from potclient.datasets import RecordedScan, Recording, open_dataset
from potclient.errors import DatasetError
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import score
from potserver import bundled
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Atom, Scan
from potserver.errors import DictionaryError, EmptyError, SolverError
from potserver.numerics.geometry import in_sector, rotation_z, yaw_of
from potserver.services.learning import LearningSettings, choose_diverse, learn_atoms

_OUTDOOR = LearningSettings()
_INDOOR = LearningSettings(coarse_m=1.0, fine_m=0.4, max_range_m=10.0)
# name, settings, licence and source, how many atoms are kept
_BUILTIN = (
    (bundled.STREET, _OUTDOOR, "MIT, small_gicp, Kenji Koide", 10),
    (bundled.ROOMS, _INDOOR, "MIT, la3dm, Robust Field Autonomy Lab", 8),
    (bundled.STREET_PLAN, _OUTDOOR, "MIT, small_gicp, Kenji Koide", 6),
    (bundled.PLAN, _INDOOR, "MIT, la3dm, Robust Field Autonomy Lab", 8),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of `potserver atoms build`."""
    parser.add_argument("datasets", nargs="*", metavar="DATASET", help="recordings to learn from")
    parser.add_argument("-o", "--out", required=True, metavar="FILE", help="dictionary file to write")
    parser.add_argument("--builtin", action="store_true", help="learn the dictionary that the package ships")
    parser.add_argument(
        "--atoms", type=int, default=12, metavar="N", help="atoms kept of each recording [12]"
    )
    parser.add_argument(
        "--scans", type=int, default=10, metavar="N", help="first scans taken of each recording [10]"
    )
    parser.add_argument(
        "--sectors", type=int, default=_OUTDOOR.n_sectors, metavar="N", help=f"a scan [{_OUTDOOR.n_sectors}]"
    )
    parser.add_argument(
        "--max-range", type=float, default=_OUTDOOR.max_range_m, metavar="M", help=f"[{_OUTDOOR.max_range_m}]"
    )
    parser.add_argument(
        "--coarse",
        type=float,
        default=_OUTDOOR.coarse_m,
        metavar="M",
        help=f"kernel spacing [{_OUTDOOR.coarse_m}]",
    )
    parser.add_argument(
        "--fine",
        type=float,
        default=_OUTDOOR.fine_m,
        metavar="M",
        help=f"the same at hits [{_OUTDOOR.fine_m}]",
    )
    parser.add_argument(
        "--licence", default="not stated", help="licence of the recordings, kept with the atoms"
    )


def run(options: argparse.Namespace) -> AtomDictionary:
    """Learn, choose, score, save.

    Raises:
        DictionaryError: nothing to learn from, or a recording cannot be read.
    """
    if options.builtin == bool(options.datasets):
        raise DictionaryError("name recordings to learn from, or --builtin, and not both")
    if options.atoms < 1 or options.scans < 1:
        raise DictionaryError("--atoms and --scans must be at least 1")
    names = [_name_of(path) for path in options.datasets]
    if len(set(names)) < len(names):
        raise DictionaryError(f"the recordings' names must differ, got {', '.join(names)}")
    atoms: list[Atom] = []
    try:
        if options.builtin:
            for name, settings, licence, keep in _BUILTIN:
                atoms += _learn_recording(bundled.open_bundled(name), name, settings, licence, keep)
        else:
            settings = LearningSettings(
                n_sectors=options.sectors,
                max_range_m=options.max_range,
                coarse_m=options.coarse,
                fine_m=options.fine,
            )
            for path, name in zip(options.datasets, names, strict=True):
                recording = open_dataset(path)[: options.scans]
                atoms += _learn_recording(recording, name, settings, options.licence, options.atoms)
    except (DatasetError, EmptyError, SolverError) as error:
        raise DictionaryError(str(error)) from error
    dictionary = AtomDictionary(tuple(atoms))
    dictionary.save(options.out)
    return dictionary


def _name_of(path: str) -> str:
    """A prefix for atom ids: the last two parts of the path, e.g. `kitti-00`."""
    parts = Path(path).resolve().with_suffix("").parts[-2:]
    return "-".join(parts).lower().replace("_", "-").replace(" ", "-")


def _learn_recording(
    recording: Recording, name: str, settings: LearningSettings, licence: str, keep: int
) -> list[Atom]:
    # beams held out as everywhere in the project: what the demo is judged on was never learned
    hold_out = HoldOut()
    candidates: list[Atom] = []
    for number, (scan, held_out) in enumerate(map(hold_out.split, recording)):
        learned = learn_atoms(
            to_scan(scan, number), f"{name}-{number}", settings,
            {"source": name, "scan": scan.name, "licence": licence}, seed=number,
        )  # fmt: skip
        candidates += [_scored(atom, scan, held_out) for atom in learned]
        logging.getLogger(__name__).info(
            "%s: scan %d of %d, %d atoms", name, number + 1, len(recording), len(learned)
        )
    return list(choose_diverse(candidates, keep))


def _scored(atom: Atom, scan: RecordedScan, held_out: LabelledPoints) -> Atom:
    """The atom with its scores on the held-out beams of its own sector, in its provenance."""
    number, width = int(atom.provenance["sector"]), atom.azimuth_width_rad
    bisector = yaw_of(scan.T_map_sensor) + number * width
    local = (held_out.points - scan.T_map_sensor[:3, 3]) @ rotation_z(bisector)
    inside = in_sector(local, -width / 2.0, width / 2.0, atom.radius_m)
    occupied = held_out.occupied[inside]
    if not occupied.any() or occupied.all():
        return atom
    answer = KernelMap(atom.kernels).occupancy(local[inside])
    scores = score(answer.mean, occupied, answer.observed)
    noted = {
        "held_out_auc": f"{scores.auc:.4f}",
        "held_out_nll": f"{scores.nll:.4f}",
        "held_out_n": str(scores.n),
    }
    return dataclasses.replace(atom, provenance=atom.provenance | noted)


def to_scan(recorded: RecordedScan, seq: int) -> Scan:
    """A recorded scan as the mapper takes it."""
    return Scan(
        robot_id="recording",
        seq=seq,
        stamp_ns=recorded.stamp_ns,
        points=recorded.points,
        is_return=recorded.is_return,
        T_map_sensor=recorded.T_map_sensor,
        is_planar=recorded.is_planar,
    )
