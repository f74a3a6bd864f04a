"""`potserver atoms learn`: a dictionary grows by what one place teaches."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from potclient.commands.output_files import output_file
from potclient.errors import DatasetError, UsageError
from potserver.commands.atoms_build import check_installed
from potserver.commands.shared import (
    EXIT_OK,
    add_settings_flags,
    add_verb,
    dictionary_of,
    say,
    settings_of,
)
from potserver.errors import DictionaryError

if TYPE_CHECKING:
    from potserver.domain.types import Scan

_ABOUT = """\
Learn what a place teaches to expect where little was seen, and put it into a dictionary beside what is known. Each scan
that is mapped later leans on what foretells it best. The last fifth of the scans is told to nobody and judges: what tells it
no better than what is known already is refused. Minutes of driving are enough, and learning takes less than a minute.

The same recordings give the same file."""

_EXAMPLES = """\
examples:
  potserver atoms learn /data/yesterday --name yard -o yard.atoms      then: potserver serve --set dictionary=yard.atoms
  potserver atoms learn tuesday.mcap --name yard --set dictionary=yard.atoms -o yard.atoms     goes on with what it knows"""


def add(verbs: Any) -> None:
    """Add the verb."""
    parser = add_verb(
        verbs, "learn", _run, help="let a dictionary grow by one place", description=_ABOUT, epilog=_EXAMPLES
    )
    parser.add_argument("datasets", nargs="+", metavar="DATASET", help="recordings of the place, with poses")
    parser.add_argument(
        "-o", "--out", type=output_file, required=True, metavar="FILE", help="dictionary to write"
    )
    parser.add_argument("--name", required=True, help="of what is learned; what has it already is replaced")
    parser.add_argument(
        "--scans", default=":", metavar="N", help="the first N of each recording, or START:STOP:STEP [all]"
    )
    parser.add_argument(
        "--min-range", type=float, default=0.0, metavar="M", help="nearer beams are dropped [0]"
    )
    parser.add_argument(
        "--max-range", type=float, default=25.0, metavar="M", help="longer beams are free up to here [25]"
    )
    add_settings_flags(parser)


def _run(options: argparse.Namespace) -> int:
    from potserver.atoms.growth import grow
    from potserver.log import configure_logging

    check_installed("torch")
    configure_logging("warning", "console")
    dictionary = dictionary_of(settings_of(options).dictionary)
    scans = [scan for dataset in options.datasets for scan in _looks_at(dataset, options)]
    source = ", ".join(Path(dataset).name for dataset in options.datasets)
    growth = grow(dictionary, options.name, scans, max_range_m=options.max_range, noted={"source": source})
    growth.dictionary.save(options.out)
    say(
        f"{options.name}: learned from {len(scans)} scans; NLL of the beams that were held out"
        f" {growth.nll_before:.3f} -> {growth.nll:.3f}, written to {options.out}"
    )
    return EXIT_OK


def _looks_at(dataset: str, options: argparse.Namespace) -> tuple[Scan, ...]:
    from potserver.domain.looks import Looks
    from potserver.recordings import Reader, open_recording, scan_numbers, to_scan

    looks = Looks()
    try:
        recording = open_recording(
            dataset, Reader(min_range_m=options.min_range, max_range_m=options.max_range)
        )
        for number in scan_numbers(options.scans, len(recording)):
            looks.take(to_scan(recording[number], number))
    except (DatasetError, UsageError) as error:
        raise DictionaryError(str(error)) from error
    return looks.scans
