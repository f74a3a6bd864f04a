"""A dictionary that grows: by what a place teaches, and by nothing that is known already."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from potserver.atoms.growth import LEAST_SCANS, MAX_GROWN, Growth, grow
from potserver.cli import main
from potserver.domain.dictionary import EXPECTATION, AtomDictionary
from potserver.domain.types import Scan
from potserver.errors import AtomRefusedError, UnknownAtomError
from potserver.mapping.service import MappingService
from potserver.recordings import Reader, open_recording, to_scan

BUILTIN = AtomDictionary.builtin()
REACH_M = 15.0
OFFICES = "town:offices:vlp16:60m:3"


def some_scans(town: str, n: int) -> list[Scan]:
    recording = open_recording(town, Reader(max_range_m=REACH_M if town == OFFICES else None))
    return [to_scan(recording[i], i) for i in np.linspace(0, len(recording) - 1, n).astype(int)]


@pytest.fixture(scope="module")
def offices() -> list[Scan]:
    return some_scans(OFFICES, 16)


@pytest.fixture(scope="module")
def growth(offices: list[Scan]) -> Growth:
    return grow(BUILTIN, "offices", offices[:10], max_range_m=REACH_M, noted={"source": "here"})


def leans_on(dictionary: AtomDictionary, scan: Scan) -> str:
    update = MappingService(dictionary, threads=1).integrate(scan)
    return update.own.borrowed[0].name


def test_what_a_place_teaches_foretells_it_better(growth: Growth, offices: list[Scan]) -> None:
    assert growth.nll < growth.nll_before - 0.02
    assert growth.dictionary.expectation is BUILTIN.expectation
    assert [one.name for one in growth.dictionary.expectations] == [EXPECTATION, "offices"]
    noted = growth.learned.provenance
    assert (noted["source"], noted["scans"]) == ("here", "10")
    assert float(noted["held_out_nll"]) == pytest.approx(growth.nll, abs=1e-4)


def test_a_scan_leans_on_what_foretells_it_best(growth: Growth, offices: list[Scan]) -> None:
    assert "offices" in {leans_on(growth.dictionary, scan) for scan in offices[10:]}
    streets = some_scans("town:suburb:vlp16:60m:31", 4)
    assert {leans_on(growth.dictionary, scan) for scan in streets} == {EXPECTATION}


def test_the_same_scans_give_the_same_file(growth: Growth, offices: list[Scan], tmp_path: Path) -> None:
    again = grow(BUILTIN, "offices", offices[:10], max_range_m=REACH_M, noted={"source": "here"})
    for number, one in enumerate((growth, again)):
        one.dictionary.save(tmp_path / f"{number}.atoms")
    assert (tmp_path / "0.atoms").read_bytes() == (tmp_path / "1.atoms").read_bytes()
    kept = AtomDictionary.load(tmp_path / "0.atoms")
    assert kept.grown[0].provenance == growth.learned.provenance
    for one, other in zip(kept.grown[0].net, growth.learned.net, strict=True):
        np.testing.assert_array_equal(one, other)
    left = kept.of_dims(3).remove("offices")
    assert not left.grown
    with pytest.raises(UnknownAtomError):
        left.remove("offices")


def refusal(dictionary: AtomDictionary, name: str, scans: list[Scan]) -> str:
    with pytest.raises(AtomRefusedError) as caught:
        grow(dictionary, name, scans, max_range_m=25.0)
    return str(caught.value.reason)


def test_what_may_not_join(growth: Growth, offices: list[Scan]) -> None:
    assert refusal(BUILTIN, "again", some_scans("town:terraces:120m:101", 10)) == "duplicate"
    assert refusal(BUILTIN, "No", offices) == "illegal_id"
    assert refusal(BUILTIN, EXPECTATION, offices) == "taken_id"
    assert refusal(BUILTIN, BUILTIN.atoms[0].atom_id, offices) == "taken_id"
    assert refusal(BUILTIN, "few", offices[: LEAST_SCANS - 1]) == "too_few_scans"
    flat = dataclasses.replace(offices[0], points=offices[0].points * np.float32([1, 1, 0]), is_planar=True)
    assert refusal(BUILTIN, "planar", [flat] * LEAST_SCANS) == "too_few_scans"
    full = growth.dictionary
    for number in range(MAX_GROWN - 1):
        full = full.grow(growth.learned._replace(name=f"place-{number}"))
    assert refusal(full, "one-more", offices) == "full"


def test_what_the_held_out_scans_contradict_is_refused(offices: list[Scan]) -> None:
    """Of the last scans the lengths of beams are shuffled: nothing foretells them."""
    rng = np.random.default_rng(0)

    def shuffled(scan: Scan) -> Scan:
        length = np.linalg.norm(scan.points, axis=1, keepdims=True)
        return dataclasses.replace(scan, points=scan.points / length * rng.permutation(length))

    scans = [*offices[:8], *map(shuffled, offices[8:10])]
    assert refusal(AtomDictionary(), "noise", scans) == "uncalibrated"


def test_the_command(offices: list[Scan], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "site.atoms"
    command = ["atoms", "learn", OFFICES, "--name", "site", "-o", str(out), "--max-range", str(REACH_M)]
    assert main([*command, "--scans", "::8"]) == 0
    assert "site: learned from" in capsys.readouterr().out
    assert [one.name for one in AtomDictionary.load(out).grown] == ["site"]
    assert AtomDictionary.load(out).grown[0].provenance["source"] == OFFICES
    assert main([*command, "--scans", "2"]) != 0
    assert "too few" in capsys.readouterr().err
    assert main(["atoms", "info", str(out)]) == 0
    assert "site" in capsys.readouterr().out
