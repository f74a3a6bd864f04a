"""Our map with parts of the method taken out: rows of `potserver eval --ablations`, no part of the product.

A row's name says what ran. All of them share the settings, labels, sectors and atoms of profile `default`.
"""

from __future__ import annotations

import dataclasses

from potserver.domain.tiles import TiledMap
from potserver.domain.types import KernelSet
from potserver.mapping.carrying import Carrier
from potserver.mapping.default import DefaultPipeline
from potserver.mapping.fusion import Fused, Look, Moment
from potserver.mapping.paper import PotPipeline
from potserver.mapping.pipeline import LabelledScan, Pipeline, ScanMap
from potserver.mapping.refinement import flat_prior
from potserver.mapping.settings import MappingSettings
from potserver.mapping.stopwatch import Stopwatch


class RePotPipeline(DefaultPipeline):
    """The overall map takes the transported kernels too: their weights are a prior, and the lattice adds what is missing."""

    def learn(
        self,
        tiled: TiledMap,
        look: Look,
        seen: LabelledScan,
        moment: Moment,
        carrier: Carrier,
        clock: Stopwatch,
    ) -> tuple[ScanMap, Fused]:
        own = self.own_map(seen, carrier, tiled.grid.fine_m, clock)
        return own, self.fuse(tiled, look, own.prior, moment, clock)

    @property
    def own_threads(self) -> int:
        return self.threads


class FlatRePotPipeline(RePotPipeline):
    """As `RePotPipeline`, but only positions and widths are transported: weights start from a flat prior."""

    def prior_of(self, carried: KernelSet, w2_m2: float) -> KernelSet:
        return flat_prior(carried, self.method.rule.prior_var)


ABLATIONS: dict[str, type[Pipeline]] = {
    "POT, not refined": PotPipeline,
    "RePOT, transported prior": RePotPipeline,
    "RePOT, flat prior": FlatRePotPipeline,
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
