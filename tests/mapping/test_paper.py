"""Profile `paper` is what the authors' code does."""

from __future__ import annotations

import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.mapping.matching import RankScore
from potserver.mapping.paper import PAPER, PotPipeline
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings


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
    assert PAPER.ranking.reg_m2 == pytest.approx(12.5)
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
