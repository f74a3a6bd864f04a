"""Maps that learn from each scan by themselves, online, with as many kernels as a time budget allows: BHM and ABHM.

They share labels, sectors, tiles and answers with `paper`; only where kernels and weights come from differs.
"""

from __future__ import annotations

import numpy as np

from potschemas.answers import PRIOR_VAR
from potserver.atoms.learning import LearningSettings, learn_kernels
from potserver.domain.tiles import Region
from potserver.domain.types import KernelSet, Sector
from potserver.evaluation.repot import RePotPipeline
from potserver.mapping.carrying import Carrier
from potserver.mapping.dispersions import integrated_out
from potserver.mapping.paper import PAPER, PotPipeline
from potserver.mapping.pipeline import LabelledScan, ScanMap
from potserver.mapping.placing import kernels_at
from potserver.mapping.settings import MappingSettings
from potserver.mapping.stopwatch import Stopwatch
from potserver.mapping.surfaces import Samples
from potserver.numerics.geometry import rotated_diagonal
from potserver.numerics.lattice_nodes import new_nodes

_LEAST_POINTS = 8  # of a sector that is worth learning


class BhmPipeline(RePotPipeline):
    """A Bayesian Hilbert map: kernels of one width on a lattice, placed where data come; weights as in RePOT, prior 0."""

    def __init__(self, settings: MappingSettings, *, spacing_m: float, threads: int, seed: int) -> None:
        """Take what all scans have in common.

        Args:
            settings, threads, seed: As for `Pipeline`.
            spacing_m: Of the lattice; a tile's edge is a multiple of it.
        """
        super().__init__(settings, PAPER, threads=threads, seed=seed)
        self._spacing_m = spacing_m

    def own_map(self, seen: LabelledScan, carrier: Carrier, resolution_m: float, clock: Stopwatch) -> ScanMap:
        """Nothing is carried."""
        return ScanMap([], KernelSet.empty(), KernelSet.empty(), converged=True)

    def joining(self, own: ScanMap, region: Region, samples: Samples, planar: bool) -> KernelSet:
        """Nodes of the lattice that have no kernel yet."""
        there = region.kernels.kernels.hinge_mean
        nodes = new_nodes(samples.points, there, self._spacing_m, within=1.0, planar=planar)
        return kernels_at(nodes, self._spacing_m, PRIOR_VAR)


class AbhmPipeline(PotPipeline):
    """An automorphing Bayesian Hilbert map of each sector of each scan, learned from scratch; joined as POT's sectors are."""

    def __init__(
        self, settings: MappingSettings, *, learning: LearningSettings, threads: int, seed: int
    ) -> None:
        """Take what all scans have in common.

        Args:
            settings, threads, seed: As for `Pipeline`.
            learning: How a sector is learned; its budget.
        """
        super().__init__(settings, PAPER, threads=threads, seed=seed)
        self._learning = learning

    def own_map(self, seen: LabelledScan, carrier: Carrier, resolution_m: float, clock: Stopwatch) -> ScanMap:
        """What is learned of each sector."""
        with clock("learn"):
            kernels = KernelSet.concatenate([self._learned(sector) for sector in self.sectors(seen)])
        own = integrated_out(kernels, planar=seen.scan.is_planar)
        return ScanMap([], own, own, converged=True)

    def _learned(self, sector: Sector) -> KernelSet:
        points = np.concatenate([sector.hit_points, sector.free_points]).astype(np.float64)
        if len(points) < _LEAST_POINTS:
            return KernelSet.empty()
        occupied = np.arange(len(points)) < len(sector.hit_points)
        found = KernelSet.of(
            learn_kernels(points, occupied, self._learning, seed=self.seed, threads=self.threads)
        )
        R, t = sector.T_map_sector[:3, :3], sector.T_map_sector[:3, 3]
        return found.replace(
            hinge_mean=found.hinge_mean @ R.T + t, hinge_var=rotated_diagonal(found.hinge_var, R)
        )
