"""RePOT: all transported kernels are in the map, and their transported weights are the prior (paper, section III-D).

The map is solved online, scan by scan: labels become rows of evidence, and the weights of all kernels about a scan are solved
jointly on all rows there. The prior stays the transported one and every datum counts once. Nothing is placed where no atom
was carried, and nothing that was carried is left out.

The paper's own refinement updates each weight singly, and takes each posterior for the next prior, so that data count five
times.
"""

from __future__ import annotations

import numpy as np

from potserver.domain.tiles import CARRIED, MapKernels, Region, TiledMap
from potserver.domain.types import Float64, KernelSet
from potserver.errors import SolverError
from potserver.mapping.carrying import Carrier
from potserver.mapping.fusion import Fused, Moment, add_evidence
from potserver.mapping.paper import PAPER, PotPipeline
from potserver.mapping.pipeline import LabelledScan, Method, ScanMap
from potserver.mapping.refinement import FEATURE_CUT, flat_prior, instantaneous_map
from potserver.mapping.settings import MappingSettings
from potserver.mapping.stopwatch import Stopwatch
from potserver.mapping.surfaces import Samples
from potserver.numerics import evidence
from potserver.numerics.beams import beam_weights
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.geometry import bounds, inside_box
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

_REACH_M = 5.0  # at which the widest kernels of atoms have faded
_SATURATION = 20.0  # looks at one place that count in a solve
_CUBE_M = 1.0  # along a cube whose rows are solved together
_LONGEST_STEP = 4.0  # Newton steps


class RePotPipeline(PotPipeline):
    """POT, and the weights of all that was carried are refined by the labels of all scans."""

    keeps_evidence = True

    def __init__(self, settings: MappingSettings, method: Method = PAPER, *, threads: int, seed: int) -> None:
        """Take what all scans have in common; arguments as for `Pipeline`."""
        super().__init__(settings, method, threads=threads, seed=seed)

    def own_map(self, seen: LabelledScan, carrier: Carrier, resolution_m: float, clock: Stopwatch) -> ScanMap:
        """The scan's instantaneous map, refined by its labels."""
        own = super().own_map(seen, carrier, resolution_m, clock)
        prior = self.prior_of(own.prior)
        with clock("refine"):
            refined = instantaneous_map(prior, seen.labelled, resolution_m, threads=self.threads)
        return ScanMap(own.reports, prior, refined.kernels, refined.converged)

    def prior_of(self, carried: KernelSet) -> KernelSet:
        """What carried kernels are worth before any label: what they bring."""
        return carried

    def fuse(self, tiled: TiledMap, own: ScanMap, seen: LabelledScan, source: int, moment: Moment) -> Fused:
        """The overall map's tiles with all that was carried and all labels, solved again."""
        points, hinge = seen.labelled.points, own.prior.hinge_mean
        lower, upper = bounds(np.concatenate([points, hinge]))
        lower, upper = lower - _REACH_M, upper + _REACH_M
        region = Region.of(tiled, lower - 2 * _REACH_M, upper + 2 * _REACH_M)
        labels = seen.labelled.occupied.astype(np.uint8)
        samples = Samples(points - region.origin_m, labels, beam_weights(seen.labelled))
        add_evidence(region, samples, source, turn=moment.revision)
        new = MapKernels.new(self.joining(own, region, samples, seen.scan.is_planar), CARRIED)
        region.kernels = MapKernels.concatenate([region.kernels, new])
        effort = self.method.effort
        solver = Solver(effort.newton_steps, effort.gradient_steps, _LONGEST_STEP)
        box = lower - region.origin_m, upper - region.origin_m
        solved = _solve(region, *box, solver, threads=self.threads)
        tiles = region.tiles(lower, upper, revision=moment.revision, stamp_ns=moment.stamp_ns)
        return Fused(tiles, len(new), len(new), solved)

    def joining(self, own: ScanMap, region: Region, samples: Samples, planar: bool) -> KernelSet:
        """The kernels that the map takes with a scan, in the region's frame: all that was carried."""
        return own.prior.moved(-region.origin_m)


class FlatRePotPipeline(RePotPipeline):
    """As `RePotPipeline`, but only positions and widths are carried: weights start from a flat prior."""

    def prior_of(self, carried: KernelSet) -> KernelSet:
        return flat_prior(carried, self.method.rule.prior_var)


def _solve(region: Region, lower: Float64, upper: Float64, solver: Solver, *, threads: int) -> bool:
    """Solve the weights of the kernels in a box, those around it held; whether the solve went well.

    Raises:
        SolverError: the solve ended without numbers.
    """
    fine_m, kernels = region.grid.fine_m, region.kernels
    where = evidence.positions(region.rows, fine_m)
    counts = evidence.counts(region.rows, region.cells or evidence.cells(region.rows), _SATURATION)
    rows = np.flatnonzero(inside_box(where, lower - _REACH_M, upper + _REACH_M) & (counts > 0.0))
    hinge = kernels.kernels.hinge_mean
    local = np.flatnonzero(inside_box(hinge, lower - 2 * _REACH_M, upper + 2 * _REACH_M))
    free = inside_box(hinge[local], lower, upper)
    near = kernels.take(local)
    blocks = feature_blocks(
        where[rows], hinge[local], near.kernels.gamma, edge_m=_CUBE_M, cut=FEATURE_CUT, bytes_a_value=1, threads=threads
    )  # fmt: skip
    fit = warm_fit(
        blocks, evidence.LABELS[region.rows.sort[rows]], counts[rows], Prior(near.prior_mean, near.prior_var),
        near.kernels.weight_mean, solver, free=free, threads=threads,
    )  # fmt: skip
    if not (np.isfinite(fit.weights).all() and np.isfinite(fit.var).all()):
        raise SolverError(f"the weights of {len(local)} kernels on {len(rows)} rows came out NaN or infinite")
    mean, var = kernels.kernels.weight_mean.copy(), kernels.kernels.weight_var.copy()
    mean[local[free]], var[local[free]] = fit.weights[free], fit.var[free]
    region.kernels = MapKernels(
        kernels=kernels.kernels.replace(weight_mean=mean, weight_var=var),
        level=kernels.level,
        prior_mean=kernels.prior_mean,
        prior_var=kernels.prior_var,
    )
    return fit.converged
