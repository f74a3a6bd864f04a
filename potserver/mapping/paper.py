"""How profile `paper` maps a scan: the authors' published code, as far as it is a choice and not a bug.

Five sectors of 72 degrees, 20 m, coordinates in the map's axes; random subsamples of 200 hits and 50 free points; hits and
free points scored apart and normalised; eight 45-degree turns of the atom; all kernels moved by the hits' coupling with the
nearest point's displacement; full-circle crop; plain concatenation.

What differs from their code: one fixed subsample an atom where they draw a new one a candidate, which makes their choice
random; a sharper plan for the ranking; marginal errors in L1; a failed coupling is solved again with four times the reg, where
they add noise; atoms keep at most 500 points a label, turned to their bisector; dispersions of position and gamma are carried
and enter the answers, where they drop them; points without any kernel near are answered as unobserved.
"""

from __future__ import annotations

from potschemas.answers import AnswerRule
from potserver.domain.map_state import MapState
from potserver.domain.tiles import TiledMap
from potserver.domain.types import KernelSet, OwnMap, ParamsKind, Scan
from potserver.mapping.carrying import Carrier
from potserver.mapping.dispersions import integrated_out
from potserver.mapping.fusion import Fused, Moment, append
from potserver.mapping.matching import Ranking, RankScore
from potserver.mapping.pipeline import Integrated, LabelledScan, Method, Pipeline, ScanMap, integrated
from potserver.mapping.sampling import Draws
from potserver.mapping.sectors import SectorCut
from potserver.mapping.stopwatch import Stopwatch
from potserver.mapping.transport import CouplingOptions

_METRES = 50.0  # their coordinates are metres divided by this

PAPER = Method(
    free_per_beam=2,
    match_beams=8_000,
    sectors=SectorCut(n_sectors=5, is_aligned=False),
    ranking=Ranking(
        n_hits=200,
        n_free=50,
        voxel_m=0.0,
        # at the authors' 0.005 nine of sixty choices in 2D towns, and six of fifteen in 3D, were others than without entropy;
        # here one of seventy-five
        reg_m2=0.0008 * _METRES**2,
        tolerance=1e-3,
        score=RankScore.NORMALISED,
        rotations_deg=tuple(45.0 * k for k in range(-4, 4)),
        n_compared=256,
    ),
    coupling=CouplingOptions(
        n_points=1500,
        voxel_m=0.0,
        reg=0.0005,
        tolerance=1e-4,
        is_label_aware=False,
        stays_in_sector=False,
    ),
    rule=AnswerRule(),  # the paper's model
    is_calibrated=False,
)


class PotPipeline(Pipeline):
    """Parameter optimal transport alone: the map is the transported kernels of all scans, as they are."""

    keeps_evidence = False

    def integrate(self, state: MapState, scan: Scan, carrier: Carrier, params: ParamsKind) -> Integrated:
        clock, draws = Stopwatch(), Draws.of(self.seed, state.n_scans)
        moment = self.moment(state, scan)
        with clock("label"):
            seen = self.label(scan, draws)
        tiled, source = self.ground(state, seen).with_robot(scan.robot_id)
        own = self.own_map(seen, carrier, tiled.grid.fine_m, clock)
        with clock("fuse"):
            fused = self.fuse(tiled, own, seen, source, moment)
        with clock("index"):
            tiled = tiled.with_tiles(fused.tiles, threads=self.threads)
            snapshot = self.snapshot(tiled, moment.revision, state.scores)
        with clock("check"):
            scores = self.check(snapshot, seen, state.scores, draws)
        after = MapState(snapshot=snapshot, tiled=tiled, stamp_ns=moment.stamp_ns, scores=scores)
        told = OwnMap.nothing() if params is ParamsKind.NONE else own.told
        return integrated(state, after, seen, told, fused, clock.timings_ms)

    def own_map(self, seen: LabelledScan, carrier: Carrier, resolution_m: float, clock: Stopwatch) -> ScanMap:
        """The scan's instantaneous map: what was carried, its dispersions integrated out."""
        carried = self.carry(seen, carrier, clock)
        kernels = KernelSet.concatenate([done.kernels for _, done in carried.served()])
        prior = integrated_out(kernels, planar=seen.scan.is_planar)
        return ScanMap(carried.reports(), prior, prior, converged=True)

    def fuse(self, tiled: TiledMap, own: ScanMap, seen: LabelledScan, source: int, moment: Moment) -> Fused:
        """The overall map's tiles with all that was carried."""
        return Fused(append(tiled, own.prior, moment), len(own.prior), len(own.prior), True)
