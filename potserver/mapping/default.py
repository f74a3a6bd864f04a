"""How profile `default` maps a scan.

Two things come of it, and neither needs the other. Its labels become evidence of the overall map, whose kernels stand on
lattices; it takes none from atoms. And its instantaneous map goes back to the sender, where one is wanted: by default kernels
that are fitted to it and lean on what the dictionary expects; else atoms are carried to it, and refined by its labels.
"""

from __future__ import annotations

from potserver.domain.map_state import MapState
from potserver.domain.tiles import TiledMap
from potserver.domain.types import KernelSet, OwnMap, ParamsKind, Scan
from potserver.mapping.carrying import Carrier
from potserver.mapping.fitting import fitted_map
from potserver.mapping.fusion import Fused, Look, Moment, fuse, refit, stalest_part
from potserver.mapping.leaning import Expectation, Expected, lean_of_tiles, tiles_to_lean
from potserver.mapping.pipeline import Integrated, LabelledScan, Pipeline, ScanMap, integrated
from potserver.mapping.refinement import borrowed_prior, instantaneous_map
from potserver.mapping.sampling import Draws
from potserver.mapping.stopwatch import Stopwatch
from potserver.numerics.threads import parallel_pair


class DefaultPipeline(Pipeline):
    """Evidence, lattice kernels and joint solves for the map; a fit of its own, or refined atoms, for the sender."""

    keeps_evidence = True

    def integrate(self, state: MapState, scan: Scan, carrier: Carrier, params: ParamsKind) -> Integrated:
        clock, draws = Stopwatch(), Draws.of(self.seed, state.n_scans)
        moment = self.moment(state, scan)
        with clock("label"):
            seen = self.label(scan, draws)
        tiled, source = self.ground(state, seen).with_robot(scan.robot_id)
        with clock("expect"):
            unseen = tiles_to_lean(tiled, seen.labelled, tiled.grid.coarse_m)
            is_asked = len(unseen) > 0 or params is ParamsKind.FITTED
            expected = self.expect(seen, carrier) if is_asked else Expectation(None, None)
            leans = lean_of_tiles(expected.place, unseen, tiled.grid) if expected.place else {}
        look = Look(
            seen.labelled,
            seen.beams.learned,
            scan.origin,
            source,
            scan.is_planar,
            draws.surface,
            leans,
        )
        own, fused = parallel_pair(
            lambda: self.own_map(params, seen, expected.place, carrier, tiled.grid.fine_m, clock),
            lambda: self.fuse(tiled, look, moment, clock),
            self.threads,
        )
        with clock("index"):
            tiled, fused = self.age(tiled.with_tiles(fused.tiles, threads=self.threads), fused, moment)
            snapshot = self.snapshot(tiled, moment.revision, state.scores)
        with clock("check"):
            scores = self.check(snapshot, seen, state.scores, draws)
        after = MapState(snapshot=snapshot, tiled=tiled, stamp_ns=moment.stamp_ns, scores=scores)
        return integrated(state, after, seen, own, fused, clock.timings_ms, expected)

    @property
    def own_threads(self) -> int:
        """Half of them: the overall map is worked out at the same time."""
        return max(1, self.threads // 2)

    # --- the steps, in order ---------------------------------------------------------------------------------------------

    def own_map(
        self,
        params: ParamsKind,
        seen: LabelledScan,
        expected: Expected | None,
        carrier: Carrier,
        resolution_m: float,
        clock: Stopwatch,
    ) -> OwnMap:
        """The scan's instantaneous map, as its sender wants it."""
        if params is ParamsKind.NONE:
            return OwnMap.nothing()
        if params is ParamsKind.TRANSPORTED:
            return self.transported(seen, carrier, resolution_m, clock).told
        scan = seen.scan
        with clock("fit"):
            return fitted_map(
                seen.beams.learned,
                scan.origin,
                expected,
                resolution_m,
                seen.draws.own,
                planar=scan.is_planar,
                threads=self.own_threads,
            )

    def transported(
        self, seen: LabelledScan, carrier: Carrier, resolution_m: float, clock: Stopwatch
    ) -> ScanMap:
        """Atoms carried to the scan, refined by its labels."""
        carried = self.carry(seen, carrier, clock)
        prior = KernelSet.concatenate([self.prior_of(t.kernels, m.w2_m2) for m, t in carried.served()])
        with clock("refine"):
            refined = instantaneous_map(prior, seen.labelled, resolution_m, threads=self.own_threads)
        return ScanMap(carried.reports(), prior, refined.kernels, refined.converged)

    def prior_of(self, carried: KernelSet, w2_m2: float) -> KernelSet:
        """What one sector's carried kernels are worth before the scan's labels."""
        return borrowed_prior(carried, w2_m2)

    def fuse(self, tiled: TiledMap, look: Look, moment: Moment, clock: Stopwatch) -> Fused:
        """The overall map's tiles with the scan in them."""
        with clock("fuse"):
            return fuse(tiled, look, self.fusion, moment, threads=self.threads)

    def age(self, tiled: TiledMap, fused: Fused, moment: Moment) -> tuple[TiledMap, Fused]:
        """The map with its stalest part fitted again, if evidence ages."""
        stale = stalest_part(tiled, moment)
        if stale is None:
            return tiled, fused
        aged, _ = refit(tiled, stale, self.fusion, moment, threads=self.threads)
        return tiled.with_tiles(aged), fused._replace(tiles=fused.tiles | aged)
