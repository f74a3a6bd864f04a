"""Other ways to map beside ours: rows of `potserver eval --ablations`, no part of the product.

A row's name says what ran. All of them have the settings, labels, sectors, atoms, ranking and couplings of profile `default`.
"""

from __future__ import annotations

import dataclasses
from functools import partial

from potschemas.answers import OBSERVED_ACTIVATION
from potserver.evaluation.repot import FlatRePotPipeline, RePotPipeline
from potserver.mapping.paper import PotPipeline
from potserver.mapping.pipeline import DEFAULT_RULE, Method
from potserver.mapping.service import MakePipeline
from potserver.mapping.settings import MappingSettings

# atoms bring few and wide kernels: where one of them is known, so is the place
METHOD = Method(rule=dataclasses.replace(DEFAULT_RULE, observed_activation=OBSERVED_ACTIVATION))
ABLATIONS: dict[str, MakePipeline] = {
    "POT, not refined": partial(PotPipeline, method=METHOD),
    "RePOT, transported prior": partial(RePotPipeline, method=METHOD),
    "RePOT, flat prior": partial(FlatRePotPipeline, method=METHOD),
}


def label_of(settings: MappingSettings) -> str:
    """The profile, and the settings that differ from it."""
    profile = MappingSettings.of_profile(settings.profile)
    changed = [
        f"{field.name}={value}"
        for field in dataclasses.fields(settings)
        if (value := getattr(settings, field.name)) != getattr(profile, field.name)
    ]
    return ", ".join([settings.profile, *changed])
