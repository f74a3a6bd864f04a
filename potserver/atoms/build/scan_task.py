"""One scan's share of a dictionary: a pure function of what it is given, so that it may run on any processor, in any order."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from potclient.datasets import RecordedScan, Recording
from potclient.errors import DatasetError
from potclient.holdout import HoldOut, LabelledPoints
from potclient.metrics import Metrics, score
from potschemas import __version__
from potserver.atoms.build.recipe import Quality
from potserver.atoms.learning import LearningSettings, SectorEpoch, learn_atoms
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Atom
from potserver.errors import PotserverError, SolverError
from potserver.mapping.sectors import SectorCut, sector_frames
from potserver.recordings import Reader, open_recording, to_scan

NOT_JUDGED = "too few held-out points to judge it"


class ScanTask(msgspec.Struct, frozen=True, kw_only=True):
    """Which scan, and what to do with it. Small: what a worker needs it reads itself."""

    recording: int  # number in the recipe
    name: str  # prefix of the atoms' ids
    dataset: str  # where it is opened
    reader: Reader
    source: str  # `dataset` as the recipe says it
    licence: str
    dims: int | None  # what the scan must have
    number: int  # of the scan in its recording
    window: int  # so many scans from that one on are learned together
    later: tuple[int, ...]  # scans whose held-out beams also judge the atoms
    settings: LearningSettings
    quality: Quality
    seed: int


class Candidate(NamedTuple):
    """An atom that is good enough to be chosen."""

    atom: Atom
    scores: Metrics  # on the held-out beams of its own sector
    later: Metrics | None  # on later scans' held-out beams; None where none saw the sector again
    content_nats: float  # what it tells about the held-out beams of its own sector, see `content_nats`


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class ScanResult:
    """What came of one scan."""

    task: ScanTask
    candidates: list[Candidate]
    refused: dict[str, str]  # atom id -> why
    n_without_hits: int  # sectors with too few hits to learn from
    failure: str | None = None  # why there is nothing at all


class Progress(NamedTuple):
    """How a sector's kernels do while they are learned."""

    task: ScanTask
    sector: int
    epoch: int
    n_epochs: int  # at most
    scores: Metrics | None  # on the held-out beams of the sector; None where they cannot judge it


def learn_scan(task: ScanTask, on_epoch: Callable[[Progress], None] | None = None) -> ScanResult:
    """Learn the atoms of one scan and judge them on beams that were held out.

    Expected errors (an unreadable scan, a solver that ended without a result) end up in the result's `failure`.
    """
    try:
        return _learn_scan(task, on_epoch)
    except (DatasetError, PotserverError, OSError) as error:
        return ScanResult(task=task, candidates=[], refused={}, n_without_hits=0, failure=str(error))


def _learn_scan(task: ScanTask, on_epoch: Callable[[Progress], None] | None) -> ScanResult:
    recording = _opened(task.dataset, task.reader)
    # beams held out as everywhere in the project: what a map is judged on was never learned
    numbers = range(task.number, min(task.number + task.window, len(recording)))
    parts = [HoldOut().split(recording[number], number) for number in numbers]
    recorded, held_out = parts[0][0], [labels for _, labels in parts]
    dims = 2 if recorded.is_planar else 3
    if task.dims not in (None, dims):
        raise DatasetError(f"{recorded.name} has {dims} dimensions, where the recipe says {task.dims}")
    name = f"{task.name}-{task.number}"
    refused: dict[str, str] = {}

    def diverged(sector: int, error: SolverError) -> None:
        refused[f"{name}-s{sector}"] = str(error)

    def scored(at: SectorEpoch) -> None:
        where = SectorOf(recorded, at.sector, task.settings)
        kernels = _means_alone(at.epoch.hinge, at.epoch.gamma, at.epoch.weight)
        scores = _judge(kernels, where, held_out)
        on_epoch(Progress(task, at.sector, at.epoch.epoch, at.epoch.n_epochs, scores))  # type: ignore[misc]

    atoms = learn_atoms(
        [to_scan(scan, number) for (scan, _), number in zip(parts, numbers, strict=True)], name, task.settings,
        _provenance(task, recorded), seed=task.seed, on_failure=diverged, on_epoch=scored if on_epoch else None,
    )  # fmt: skip
    n_without_hits = task.settings.n_sectors - len(atoms) - len(refused)
    later = _held_out_of(recording, task.later)
    candidates = []
    for atom in atoms:
        where = SectorOf(recorded, int(atom.provenance["sector"]), task.settings)
        kernels = _means_alone(atom.kernels.hinge_mean, atom.kernels.gamma, atom.kernels.weight_mean)
        own = _judge(kernels, where, held_out)
        reason = _refusal(own, task.quality)
        if own is None or reason is not None:
            refused[atom.atom_id] = reason or NOT_JUDGED
            continue
        seen_again = [labels for labels in later if where.pick(labels)[1].any()]
        then = _judge(kernels, where, seen_again)
        noted = _written("held_out", own) | {"later_scans": str(len(seen_again) if then else 0)}
        if then is not None:
            noted |= _written("later", then)
        content = content_nats(own, np.concatenate([where.pick(labels)[1] for labels in held_out]))
        noted |= {"content_nats": f"{content:.0f}"}
        noted_atom = dataclasses.replace(atom, provenance=atom.provenance | noted)
        candidates.append(Candidate(noted_atom, own, then, content))
    return ScanResult(task=task, candidates=candidates, refused=refused, n_without_hits=n_without_hits)


@functools.lru_cache(maxsize=2)
def _opened(dataset: str, reader: Reader) -> Recording:
    """Opening may parse a whole log or make a whole town, and a recording does not change."""
    return open_recording(dataset, reader)


def _held_out_of(recording: Recording, numbers: tuple[int, ...]) -> list[LabelledPoints]:
    """What the held-out beams of some scans say. A scan that cannot be read is left out: its own task reports it."""
    found = []
    for number in numbers:
        with contextlib.suppress(DatasetError, OSError):
            found.append(HoldOut().split(recording[number], number)[1])
    return found


def _provenance(task: ScanTask, recorded: RecordedScan) -> dict[str, str]:
    return {
        "source": task.source,
        "reader": _json(msgspec.structs.asdict(task.reader)),
        "scan": recorded.name,
        "scan_number": str(task.number),
        "licence": task.licence,
        "settings": _json(dataclasses.asdict(task.settings)),
        "seed": str(task.seed),
        "version": __version__,
    }


def _json(values: dict[str, Any]) -> str:
    """Canonical: the same values give the same text."""
    return json.dumps(values, sort_keys=True, separators=(",", ":"))


class SectorOf(NamedTuple):
    """A sector of a scan."""

    recorded: RecordedScan
    number: int
    settings: LearningSettings

    def pick(self, labels: LabelledPoints) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The points that lie in it, (N, 3) m in the atom's frame, and which are occupied, (N,)."""
        pose = self.recorded.T_map_sensor
        frame = sector_frames(pose, self.settings.max_range_m, SectorCut(self.settings.n_sectors))[
            self.number
        ]
        about_sensor = labels.points - pose[:3, 3]
        inside = frame.inside(about_sensor)
        return frame.local(about_sensor[inside]), labels.occupied[inside]


def _means_alone(hinge: NDArray[Any], gamma: NDArray[Any], weight: NDArray[Any]) -> KernelMap:
    """A map that answers with the means of the weights, without their variances."""
    return KernelMap.from_arrays(hinge, gamma, weight, np.zeros(len(weight)))


def _judge(kernels: KernelMap, where: SectorOf, held_out: list[LabelledPoints]) -> Metrics | None:
    """Scores in a sector; None where what was held out shows hits alone, free space alone, or nothing."""
    parts = [where.pick(labels) for labels in held_out]
    occupied = np.concatenate([part[1] for part in parts]) if parts else np.zeros(0, bool)
    if not occupied.any() or occupied.all():
        return None
    answer = kernels.occupancy(np.concatenate([part[0] for part in parts]))
    return score(answer.mean, occupied, answer.observed)


def content_nats(scores: Metrics, occupied: NDArray[np.bool_]) -> float:
    """What kernels tell about held-out points: how much likelier these are than by the share of occupied ones among them, nats.

    Args:
        scores: Of the kernels on these points.
        occupied: (N,) the truth, both labels present.
    """
    share = float(occupied.mean())
    constant = -(share * np.log(share) + (1.0 - share) * np.log1p(-share))
    return float(scores.n * (constant - scores.nll))


def _refusal(scores: Metrics | None, quality: Quality) -> str | None:
    if scores is None or scores.n < quality.min_points:
        return NOT_JUDGED
    # four digits: a last bit that differs must not decide
    if not round(scores.auc, 4) >= quality.min_auc:
        return f"AUC below {quality.min_auc:g}"
    if not round(scores.nll, 4) <= quality.max_nll:
        return f"NLL above {quality.max_nll:g}"
    return None


def _written(when: str, scores: Metrics) -> dict[str, str]:
    return {
        f"{when}_n": str(scores.n),
        f"{when}_acc": f"{scores.accuracy:.4f}",
        f"{when}_auc": f"{scores.auc:.4f}",
        f"{when}_nll": f"{scores.nll:.4f}",
        f"{when}_ece": f"{scores.ece:.4f}",
    }
