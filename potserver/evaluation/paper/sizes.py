"""How much of everything a run of the tables takes."""

from __future__ import annotations

from typing import Any, NamedTuple


class Size(NamedTuple):
    """One size of all tables."""

    name: str
    scans: int  # of a target, at most
    most_beams: int  # of a scan: of a denser one every so many-th beam is taken
    source_frames: int  # from which a domain's atoms are learned
    learner: dict[str, Any]  # settings of the learner, beside those of the domain
    atoms: tuple[int, ...]  # in the table of the number of atoms
    frames: tuple[int, ...]  # in the table of the first frames
    drive: int = 100  # scans of a town at 10 Hz: 80 m
    towns: int = 3


_FAST: dict[str, Any] = {"max_epochs": 2, "dispersion_epochs": 1, "steps": 10, "max_labelled": 1000}

QUICK = Size("quick", 2, 600, 1, _FAST | {"max_kernels": 30}, (1, 3), (1,), towns=1)
SMALL = Size("small", 20, 6_000, 4, {"max_labelled": 4000}, (1, 3, 10, 30, 60), (1, 2, 5, 10))
FULL = Size("full", 60, 20_000, 10, {}, (1, 2, 5, 10, 20, 50, 100, 200, 400, 600), (1, 2, 5, 10), drive=400)
SIZES = {size.name: size for size in (QUICK, SMALL, FULL)}
