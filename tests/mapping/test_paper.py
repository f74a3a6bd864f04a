"""Profile `paper` is what the authors' code does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potclient.datasets import open_dataset
from potserver.domain.dictionary import AtomDictionary
from potserver.mapping.matching import RankScore
from potserver.mapping.paper import PAPER, PotPipeline
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.recordings import to_scan


def test_its_numbers_are_the_authors() -> None:
    """Rows A2-A8, A11, A12, A14, A17 of the comparison with their code."""
    settings = MappingSettings.of_profile("paper")
    assert (settings.max_range_m, settings.beams_per_scan) == (20.0, 8_000)
    assert (PAPER.free_per_beam, PAPER.match_beams) == (2, 8_000)
    assert PAPER.sectors.n_sectors == 5
    assert not PAPER.sectors.is_aligned
    assert sorted(a % 360 for a in PAPER.ranking.rotations_deg) == [45.0 * k for k in range(8)]
    assert PAPER.ranking.score is RankScore.NORMALISED
    assert (PAPER.ranking.n_hits, PAPER.ranking.n_free) == (200, 50)
    assert PAPER.ranking.reg_m2 == pytest.approx(2.0)  # theirs is 12.5: see the choice of exact transport
    assert (PAPER.coupling.n_points, PAPER.coupling.reg) == (1500, 0.0005)
    assert not PAPER.coupling.is_label_aware
    assert PAPER.coupling.out_of_sample.value == "nearest"
    assert not PAPER.coupling.stays_in_sector
    assert PAPER.rule.mean_moderation == 1.0


def test_the_profile_names_the_pipeline() -> None:
    paper = MappingService(AtomDictionary(()), MappingSettings.of_profile("paper"), threads=1)
    assert not paper.keeps_evidence
    assert not PotPipeline.keeps_evidence
    assert MappingService(AtomDictionary(()), threads=1).keeps_evidence


def _vaguer(dictionary: AtomDictionary, factor: float) -> AtomDictionary:
    """Atoms whose positions and widths are known less well; all means as before."""
    return AtomDictionary(
        tuple(
            dataclasses.replace(
                atom,
                kernels=atom.kernels.replace(
                    hinge_var=atom.kernels.hinge_var * np.float32(factor),
                    gamma_shape=atom.kernels.gamma_shape / np.float32(factor),
                    gamma_rate=atom.kernels.gamma_rate / np.float32(factor),
                ),
            )
            for atom in dictionary
        )
    )


def test_dispersions_of_hinge_and_gamma_enter_the_answers() -> None:
    scan = open_dataset("town:suburb:2d:7", max_range_m=20.0)[0]
    ends = scan.in_map[scan.is_return]
    atoms = AtomDictionary.builtin().of_dims(2)
    found = []
    for factor in (1.0, 1000.0):
        service = MappingService(_vaguer(atoms, factor), MappingSettings.of_profile("paper"), threads=2)
        update = service.integrate(to_scan(scan, 0))
        found.append(service.snapshot.occupancy(ends))
        # the sender has the same numbers
        assert len(update.kernels) == len(service.snapshot)
        np.testing.assert_allclose(
            np.sort(update.kernels.weight_mean), np.sort(service.snapshot.kernels.weight_mean)
        )
    assert np.abs(found[0].mean - found[1].mean).mean() > 0.1
    assert found[1].mean.std() < 0.2 * found[0].mean.std(), "nothing stays sharp"
