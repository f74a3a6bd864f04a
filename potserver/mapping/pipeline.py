"""What the pipelines of all profiles share: the records of their steps, and the steps themselves.

`default.py` and `paper.py` have a pipeline each, with `integrate` as the method on one screen.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from potschemas.answers import OBSERVED_ACTIVATION, AnswerRule
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_part import in_a_plane
from potserver.domain.map_state import MapState
from potserver.domain.running_scores import RunningScores
from potserver.domain.tiles import TiledMap
from potserver.domain.types import (
    KernelSet,
    MapUpdate,
    OwnMap,
    ParamsKind,
    Scan,
    Sector,
    SectorMatch,
    TileChange,
)
from potserver.mapping.carrying import Carried, Carrier
from potserver.mapping.checking import check
from potserver.mapping.fusion import SCAN_EFFORT, FitEffort, Fused, FusionOptions, Moment, grid_for
from potserver.mapping.leaning import Expectation, expect
from potserver.mapping.matching import Ranking
from potserver.mapping.sampling import BeamLimits, DrawnBeams, Draws, draw_beams, thin_beams
from potserver.mapping.sectors import SectorCut, cut_sectors
from potserver.mapping.settings import MappingSettings
from potserver.mapping.stopwatch import Stopwatch
from potserver.mapping.surfaces import FACE_SAMPLES, FaceSamples
from potserver.mapping.transport import CouplingOptions
from potserver.numerics.beams import LabelledPoints, label_beams

_FULL, _FULL_IN_PLANE = 3.4, 2.3  # activation that a full lattice of known kernels sums to
# Half of a lattice sums to about half of it: what has less lies beyond the data. `mean_moderation`: variances are
# of single weights, and all of them would make the map timid.
DEFAULT_RULE = AnswerRule(
    observed_activation=1.4, residual_var=50.0, mean_moderation=0.05, full_activation=_FULL
)


class Method(NamedTuple):
    """What is tuned and not chosen: a record a step. The defaults are those of profile `default`."""

    free_per_beam: int = 5  # free samples, one in each of so many equal pieces of a beam
    match_beams: int = 4_000  # beams that are cut into sectors, for transport and the scan's own map
    sectors: SectorCut = SectorCut()
    ranking: Ranking = Ranking()
    coupling: CouplingOptions = CouplingOptions()
    effort: FitEffort = SCAN_EFFORT
    faces: FaceSamples = FACE_SAMPLES
    rule: AnswerRule = DEFAULT_RULE  # how the map answers until its self-check has points enough
    is_calibrated: bool = True  # then the self-check chooses the rule's `mean_moderation`


class LabelledScan(NamedTuple):
    """A scan, ready to be learned from."""

    scan: Scan
    beams: DrawnBeams  # relative to the sensor, map axes
    about_sensor: LabelledPoints  # relative to the sensor, map axes
    labelled: LabelledPoints  # the same, map frame
    draws: Draws


class ScanMap(NamedTuple):
    """What atoms say about one scan: its instantaneous map."""

    reports: list[SectorMatch]
    prior: KernelSet  # as carried, map frame
    kernels: KernelSet  # refined, where the pipeline refines
    converged: bool

    @property
    def told(self) -> OwnMap:
        """What the sender gets."""
        origin = np.round(self.kernels.hinge_mean.mean(axis=0)) if len(self.kernels) else np.zeros(3)
        return OwnMap(
            kernels=self.kernels.moved(-origin),
            origin=origin,
            sectors=tuple(self.reports),
            converged=self.converged,
        )


class Integrated(NamedTuple):
    """What a scan makes of a map."""

    state: MapState
    update: MapUpdate


class Pipeline(ABC):
    """Integrates scans, one after the other."""

    keeps_evidence: bool  # false: the map keeps kernels alone, and nobody's share of it can be told

    def __init__(
        self, settings: MappingSettings, method: Method | None = None, *, threads: int, seed: int
    ) -> None:
        """Take what all scans have in common.

        Args:
            settings: Of the map.
            method: How each step works.
            threads: Threads of one scan.
            seed: Of every random choice.
        """
        self.settings, self.method = settings, method or Method()
        self.threads, self.seed = threads, seed
        self.fusion = FusionOptions.of(settings, self.method.effort, self.method.faces)

    @abstractmethod
    def integrate(self, state: MapState, scan: Scan, carrier: Carrier, params: ParamsKind) -> Integrated:
        """Map a scan. The state is not changed.

        Args:
            state: Of the map.
            scan: With its pose in the map.
            carrier: The dictionary's atoms.
            params: What the sender gets back; the map does not depend on it.
        Raises:
            EmptyError: no beam lies within the range limits.
            SolverError: a solve ended without numbers.
            SettingsError: the scan is too wide for the resolution.
        """

    @property
    def own_threads(self) -> int:
        """Threads for what atoms make of a scan."""
        return self.threads

    def carrier(self, dictionary: AtomDictionary) -> Carrier:
        """A dictionary, prepared for `integrate`."""
        method = self.method
        return Carrier(dictionary, method.ranking, method.coupling, threads=self.own_threads, seed=self.seed)

    def snapshot(self, tiled: TiledMap | None, revision: int, scores: RunningScores) -> KernelMap:
        """What a map answers from, by what its self-check has found so far."""
        parts = list(tiled.parts.values()) if tiled is not None else []
        rule = self.method.rule
        if self.method.is_calibrated:
            rule = dataclasses.replace(rule, mean_moderation=scores.moderation(rule.mean_moderation))
        if rule.full_activation and in_a_plane(parts):
            rule = in_plane(rule)
        lean = None if tiled is None else tiled.lean
        return KernelMap(parts, rule=rule, map_revision=revision, threads=self.threads, lean=lean)

    # --- the steps of a scan ---------------------------------------------------------------------------------------------

    def label(self, scan: Scan, draws: Draws) -> LabelledScan:
        """Draw beams, and put labelled points on them."""
        beams = draw_beams(scan, BeamLimits.of(self.settings), draws)
        labelled = label_beams(
            beams.learned,
            free_per_beam=self.method.free_per_beam,
            gap_m=self.settings.free_gap_m,
            rng=draws.learn,
        )
        in_map = labelled._replace(points=labelled.points + scan.origin)
        return LabelledScan(scan, beams, labelled, in_map, draws)

    def sectors(self, seen: LabelledScan) -> list[Sector]:
        """Cut some of a scan's labelled points into sectors."""
        method, n_beams = self.method, len(seen.beams.learned.ends)
        drawn = thin_beams(seen.about_sensor, n_beams, method.match_beams, seen.draws)
        return cut_sectors(drawn, seen.scan.T_map_sensor, self.settings.max_range_m, method.sectors)

    def moment(self, state: MapState, scan: Scan) -> Moment:
        """The change that a scan is."""
        newest_ns = max(state.stamp_ns, scan.stamp_ns)
        return Moment(state.map_revision + 1, newest_ns, self.settings.half_life_s)

    def ground(self, state: MapState, seen: LabelledScan) -> TiledMap:
        """The map that a scan is added to; the first scan chooses its grid."""
        if state.tiled is not None:
            return state.tiled
        return TiledMap.empty(
            grid_for(seen.beams.learned, self.settings.tile_size_m, self.settings.resolution_m)
        )

    def expect(self, seen: LabelledScan, carrier: Carrier) -> Expectation:
        """What the dictionary expects around a scan."""
        return expect(
            carrier.dictionary.expectations,
            seen.beams.learned,
            seen.labelled,
            seen.scan.origin,
            planar=seen.scan.is_planar,
        )

    def carry(self, seen: LabelledScan, carrier: Carrier, clock: Stopwatch) -> Carried:
        """Carry an atom to each sector."""
        with clock("match"):
            sectors = self.sectors(seen)
            matches = carrier.match(sectors, planar=seen.scan.is_planar)
        with clock("transport"):
            return Carried(sectors, matches, carrier.transport(matches, sectors))

    def check(
        self, snapshot: KernelMap, seen: LabelledScan, scores: RunningScores, draws: Draws
    ) -> RunningScores:
        """Ask the new map about the beams that it did not learn."""
        return check(snapshot, seen.beams.checked, seen.scan.origin, scores, draws)


def integrated(
    before: MapState,
    after: MapState,
    seen: LabelledScan,
    own: OwnMap,
    fused: Fused,
    timings_ms: dict[str, float],
    expected: Expectation | None = None,
) -> Integrated:
    """The new state with the report for the sender.

    Args:
        before: The state that the scan was added to.
        after: The state with its snapshot, map and scores.
        seen: The scan.
        own: What goes back to its sender.
        fused: What changed in the overall map.
        timings_ms: By step.
        expected: What the map leans on about this scan; None: the pipeline never leans.
    """
    assert after.tiled is not None, "a scan makes a map"
    update = MapUpdate(
        map_revision=after.map_revision,
        own=own,
        n_points=len(seen.beams.learned.ends) + len(seen.beams.checked.ends),
        n_kernels_added=fused.n_added,
        n_kernels_transported=fused.n_transported,
        map_kernels=len(after.snapshot),
        converged=own.converged and fused.converged,
        rule=rule_of(own, after.snapshot.rule),
        changed=TileChange(after.tiled.grid.size_m, sorted(fused.tiles)),
        timings_ms=timings_ms,
        leans_on=None if expected is None or expected.place is None else expected.place.name,
        foretold=None if expected is None or expected.place is None else expected.place.scale,
        not_leaning=None if expected is None else expected.reason,
    )
    return Integrated(dataclasses.replace(after, epoch=before.epoch, n_scans=before.n_scans + 1), update)


def in_plane(rule: AnswerRule) -> AnswerRule:
    """The rule of a map whose kernels all stand in a plane: lattices sum to less there."""
    return dataclasses.replace(
        rule,
        observed_activation=rule.observed_activation * _FULL_IN_PLANE / _FULL,
        full_activation=rule.full_activation * _FULL_IN_PLANE / _FULL,
    )


def rule_of(own: OwnMap, rule: AnswerRule) -> AnswerRule:
    """What turns a scan's own map into answers. Carried kernels are few and wide: where one is known, so is the place."""
    if own.spacings_m:
        return rule
    return dataclasses.replace(rule, observed_activation=OBSERVED_ACTIVATION, full_activation=0.0)
