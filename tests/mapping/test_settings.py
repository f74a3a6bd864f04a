"""Settings refuse nonsense and say which."""

from __future__ import annotations

import dataclasses
import math

import pytest

from potserver.errors import SettingsError
from potserver.mapping.settings import PAPER, PROFILES, MappingSettings, RankScore

NUMBERS = [
    f.name
    for f in dataclasses.fields(MappingSettings)
    if isinstance(f.default, int | float) and not isinstance(f.default, bool)
]


def test_profiles_by_name() -> None:
    assert MappingSettings.of_profile("default") == MappingSettings()
    assert MappingSettings.of_profile("paper") is PAPER
    assert all(settings.profile == name for name, settings in PROFILES.items())
    with pytest.raises(SettingsError, match="papr"):
        MappingSettings.of_profile("papr")


@pytest.mark.parametrize("name", NUMBERS)
def test_negative_numbers_are_refused_by_name(name: str) -> None:
    with pytest.raises(SettingsError, match=name):
        dataclasses.replace(MappingSettings(), **{name: -1})


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", [n for n in NUMBERS if isinstance(getattr(MappingSettings(), n), float)])
def test_numbers_must_be_finite(name: str, value: float) -> None:
    with pytest.raises(SettingsError):
        dataclasses.replace(MappingSettings(), **{name: value})


def test_ranges_that_make_no_sense_together() -> None:
    with pytest.raises(SettingsError, match="max_range_m"):
        MappingSettings(min_range_m=5.0, max_range_m=4.0)
    with pytest.raises(SettingsError, match="rotations_deg"):
        MappingSettings(rotations_deg=())
    with pytest.raises(SettingsError, match="feature_cut"):
        MappingSettings(feature_cut=1.0)


def test_the_paper_profile_is_what_the_authors_code_does() -> None:
    """Rows A2-A8, A11, A12, A14, A17."""
    assert PAPER.n_sectors == 5
    assert PAPER.max_range_m == 20.0
    assert not PAPER.align_sectors
    assert sorted(a % 360 for a in PAPER.rotations_deg) == [45.0 * k for k in range(8)]
    assert PAPER.rank_score is RankScore.NORMALISED
    assert (PAPER.rank_hits, PAPER.rank_free) == (200, 50)
    assert PAPER.rank_reg_m2 == pytest.approx(12.5)
    assert (PAPER.couple_points, PAPER.couple_reg) == (1500, 0.0005)
    assert not PAPER.label_aware
    assert PAPER.out_of_sample.value == "nearest"
    assert not PAPER.keep_in_sector
    assert not PAPER.refine
    assert (PAPER.free_per_beam, PAPER.beams_per_scan, PAPER.match_beams) == (2, 8_000, 8_000)
    assert PAPER.mean_moderation == 1.0


def test_settings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        PAPER.refine = True
