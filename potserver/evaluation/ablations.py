"""What our map is made of: the same settings, with one step of the method left out or put elsewhere.

The only place that knows how these maps are built.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from potserver.domain.dictionary import AtomDictionary
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings

# What each one changes. Every step that its name speaks of is stated, so that the name holds in every profile.
ABLATIONS: dict[str, dict[str, Any]] = {
    "POT, not refined": {"refine": False},
    "RePOT, transported prior": {"refine": True, "carry_into_map": True, "borrow_weights": True},
    "RePOT, flat prior": {"refine": True, "carry_into_map": True, "borrow_weights": False},
}


def build_map(
    ablation: str | None, dictionary: AtomDictionary, settings: MappingSettings, *, threads: int
) -> MappingService:
    """An empty map.

    Args:
        ablation: One of `ABLATIONS`, or None for the map as it ships.
        dictionary: The atoms.
        settings: Of the map.
        threads: Threads that integrating one scan may use.
    """
    changes = {} if ablation is None else ABLATIONS[ablation]
    return MappingService(dictionary, dataclasses.replace(settings, **changes), threads=threads)


def label_of(settings: MappingSettings) -> str:
    """The profile, and the settings that differ from it."""
    profile = MappingSettings.of_profile(settings.profile)
    changed = [
        f"{field.name}={value}"
        for field in dataclasses.fields(settings)
        if (value := getattr(settings, field.name)) != getattr(profile, field.name)
    ]
    return ", ".join([settings.profile, *changed])
