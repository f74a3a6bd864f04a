"""How a dictionary grows: what one place's scans teach joins what is known, if it foretells that place better.

Nothing that was known is changed. Each scan leans on what foretells it best, so what was learned at one place does no harm at
another. Every fifth part of the scans, the last, judges: it is told to no net.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from potserver.atoms.admission import LEGAL_ID, Refusal, refused
from potserver.atoms.expectation import learn_further
from potserver.domain.atom_file import Learned
from potserver.domain.dictionary import EXPECTATION, AtomDictionary
from potserver.domain.types import Scan

MAX_GROWN = 8  # places; each costs a scan about a millisecond
LEAST_SCANS = 5
_HELD_OUT = 5  # one of so many scans judges
_LEAST_GAIN = 0.01  # nats
_MOST_NLL = 0.6  # nats; who knows nothing has .69


class Growth(NamedTuple):
    """A dictionary that has grown, and by what."""

    dictionary: AtomDictionary
    learned: Learned
    nll: float  # of what the held-out scans tell, nats
    nll_before: float  # of the best of what was known


def grow(
    dictionary: AtomDictionary,
    name: str,
    scans: Sequence[Scan],
    *,
    max_range_m: float,
    seed: int = 0,
    noted: Mapping[str, str] = {},
) -> Growth:
    """Learn from the scans of one place. The same scans give the same dictionary.

    Args:
        dictionary: What is known; it is not changed.
        name: Of what is learned; what has this name already goes on learning, and is replaced.
        scans: Of the place, in order, some metres apart: each teaches by its beams and by what the next two see behind things.
        max_range_m: Longer beams are cut.
        seed: Of all draws.
        noted: Kept in its provenance.
    Raises:
        AtomRefusedError: it may not join; `reason` is a `Refusal`.
    """
    _check_room(dictionary, name)
    if len(scans) < LEAST_SCANS:
        raise refused(
            Refusal.TOO_FEW_SCANS, f"{len(scans)} scans of {name!r} are too few: need {LEAST_SCANS}"
        )
    n_told = len(scans) - max(len(scans) // _HELD_OUT, 1)
    further = learn_further(
        [one.net for one in dictionary.expectations],
        scans[:n_told],
        scans[n_told:],
        max_range_m=max_range_m,
        seed=seed,
    )
    if further is None:
        raise refused(
            Refusal.TOO_FEW_SCANS,
            f"the scans of {name!r} show no ground below a sensor above it, or are planar",
        )
    if not further.nll <= _MOST_NLL:
        raise refused(
            Refusal.UNCALIBRATED,
            f"what {name!r} teaches foretells its own held-out beams with NLL {further.nll:.3f}, need {_MOST_NLL}",
        )
    if not further.nll <= further.nll_before - _LEAST_GAIN:
        raise refused(
            Refusal.DUPLICATE,
            f"what is known foretells the held-out beams of {name!r} with NLL {further.nll_before:.3f}; {further.nll:.3f} with"
            f" what they teach is not better by {_LEAST_GAIN}",
        )
    provenance = {
        **noted,
        "scans": str(len(scans)),
        "places": str(further.n_places),
        "newest_stamp_ns": str(max(scan.stamp_ns for scan in scans)),
        "held_out_nll": f"{further.nll:.4f}",
        "held_out_nll_before": f"{further.nll_before:.4f}",
    }
    learned = Learned(name, further.net, provenance)
    return Growth(dictionary.grow(learned), learned, further.nll, further.nll_before)


def _check_room(dictionary: AtomDictionary, name: str) -> None:
    if not LEGAL_ID.fullmatch(name):
        raise refused(
            Refusal.ILLEGAL_ID,
            f"the name {name[:80]!r} is not 1 to 63 of a-z 0-9 _ . - that start with a letter or digit",
        )
    if name == EXPECTATION or name in dictionary:
        raise refused(Refusal.TAKEN_ID, f"the dictionary has something else of the name {name!r}")
    others = [one for one in dictionary.grown if one.name != name]
    if len(others) >= MAX_GROWN:
        raise refused(
            Refusal.FULL,
            f"the dictionary has grown by {len(others)} places, the limit is {MAX_GROWN}: remove one of"
            f" {', '.join(one.name for one in others)}",
        )
