"""Settings refuse nonsense and say which."""

from __future__ import annotations

import dataclasses
import math

import pytest

from potserver.errors import SettingsError
from potserver.mapping.settings import PROFILES, MappingSettings

NUMBERS = [f.name for f in dataclasses.fields(MappingSettings) if isinstance(f.default, int | float)]


def test_profiles_by_name() -> None:
    assert MappingSettings.of_profile("default") == MappingSettings()
    assert [MappingSettings.of_profile(name).profile for name in PROFILES] == ["default", "paper"]
    with pytest.raises(SettingsError, match="papr"):
        MappingSettings.of_profile("papr")
    with pytest.raises(SettingsError, match=r"mapping\.profile"):
        MappingSettings(profile="papr")


@pytest.mark.parametrize("name", NUMBERS)
def test_negative_numbers_are_refused_by_name(name: str) -> None:
    with pytest.raises(SettingsError, match=name):
        dataclasses.replace(MappingSettings(), **{name: -1})


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", [n for n in NUMBERS if isinstance(getattr(MappingSettings(), n), float)])
def test_numbers_must_be_finite(name: str, value: float) -> None:
    with pytest.raises(SettingsError, match=name):
        dataclasses.replace(MappingSettings(), **{name: value})


def test_ranges_that_make_no_sense_together() -> None:
    with pytest.raises(SettingsError, match="max_range_m"):
        MappingSettings(min_range_m=5.0, max_range_m=4.0)
    with pytest.raises(SettingsError, match="check_share"):
        MappingSettings(check_share=0.6)


def test_a_map_without_evidence_cannot_age() -> None:
    with pytest.raises(SettingsError, match="half_life_s"):
        dataclasses.replace(MappingSettings.of_profile("paper"), half_life_s=60.0)


def test_settings_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        MappingSettings().max_range_m = 3.0
