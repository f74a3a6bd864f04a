"""A Bayesian Hilbert map on fixed lattices, all weights solved at once when all scans have come."""

from __future__ import annotations

import math

import numpy as np

from potclient.arrays import Float64
from potclient.datasets import RecordedScan
from potschemas.answers import AnswerRule
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet
from potserver.evaluation.mappers import Answer, Mapper, Size, kernel_bytes
from potserver.mapping.placing import kernels_at
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.lattice_nodes import new_nodes
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

_SAMPLES = 200_000  # of all scans together: what a batch solve can hold
_FREE_A_BEAM = 2
_GAP_M = 0.3
_COARSE_PER_FINE = 2.5
_PRIOR_VAR = 50.0  # log-odds^2
_CUT = 0.01  # activations below this are left out of the solve
_NEWTON_STEPS, _GRADIENT_STEPS = 12, 60  # at most: Newton's, and conjugate gradients for each
_LEAST_CURVATURE = 1e-5  # next to none: a solve to the end
_FINEST_M, _COARSEST_M, _HALVINGS = 0.02, 10.0, 14


class GridMap(Mapper):
    """Kernels on a coarse lattice about all data and a finer one at hits, solved jointly on a sample of all scans' points.

    It is given as many kernels as the first map of the table has, by the choice of the lattices' spacing.

    Args:
        threads: Threads of the solve.
        samples: Labelled points at most, drawn evenly from all scans.
    """

    is_batch = True

    def __init__(self, *, threads: int, samples: int = _SAMPLES) -> None:
        self.name = "grid BHM, joint"
        self._threads, self._samples = threads, samples
        self._rng = np.random.default_rng(0)
        self._points, self._occupied = np.zeros((0, 3)), np.zeros(0, np.bool_)
        self._rank = np.zeros(0)  # the lowest ones stay: every point of every scan is as likely to
        self._planar = False
        self._map = KernelMap(KernelSet.empty())

    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        origin, ends = scan.T_map_sensor[:3, 3], scan.in_map
        length = np.linalg.norm(ends - origin, axis=1)
        beam = np.repeat(np.flatnonzero(length > _GAP_M), _FREE_A_BEAM)
        share = self._rng.random(len(beam)) * (length[beam] - _GAP_M) / length[beam]
        hits = ends[scan.is_return]
        points = np.concatenate([hits, origin + (ends[beam] - origin) * share[:, None]])
        rank = np.concatenate([self._rank, self._rng.random(len(points))])
        kept = np.argsort(rank)[: self._samples]
        self._rank = rank[kept]
        self._points = np.concatenate([self._points, points])[kept]
        self._occupied = np.concatenate([self._occupied, np.arange(len(points)) < len(hits)])[kept]
        self._planar = scan.is_planar
        return {}

    def finish(self, n_kernels: int) -> None:
        kernels = self._lattices(n_kernels)
        corner = self._points.min(axis=0)
        width_m = float(np.median(1.0 / np.sqrt(2.0 * kernels.gamma)))
        blocks = feature_blocks(
            self._points - corner, kernels.hinge_mean - corner, kernels.gamma, edge_m=width_m, cut=_CUT,
            threads=self._threads,
        )  # fmt: skip
        counts = np.ones(len(self._points), np.float32)
        solved = warm_fit(
            blocks, self._occupied, counts, Prior(kernels.weight_mean, kernels.weight_var), kernels.weight_mean,
            Solver(_NEWTON_STEPS, _GRADIENT_STEPS, least_curvature=_LEAST_CURVATURE), threads=self._threads,
        )  # fmt: skip
        self._map = KernelMap(
            kernels.replace(weight_mean=solved.weights, weight_var=solved.var),
            # the mode's own probability, as the published figures of such maps
            rule=AnswerRule(mean_moderation=0.0),
            threads=self._threads,
        )

    def occupancy(self, points: Float64) -> Answer:
        answer = self._map.occupancy(points)
        return Answer(answer.mean, answer.observed, answer.var)

    def size(self) -> Size:
        return Size(len(self._map), kernel_bytes(self._map.kernels))

    @property
    def kernel_map(self) -> KernelMap:
        return self._map

    def _lattices(self, n_kernels: int) -> KernelSet:
        """About as many kernels as asked for: the spacing is found by halving the interval of its logarithm."""
        low, high = math.log(_FINEST_M), math.log(_COARSEST_M)
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            low, high = (middle, high) if len(self._at(math.exp(middle))) > n_kernels else (low, middle)
        return self._at(math.exp(high))

    def _at(self, fine_m: float) -> KernelSet:
        none = np.zeros((0, 3))
        coarse_m = _COARSE_PER_FINE * fine_m
        coarse = new_nodes(self._points, none, coarse_m, within=1.0, planar=self._planar)
        fine = new_nodes(self._points[self._occupied], none, fine_m, within=1.0, planar=self._planar)
        return KernelSet.concatenate(
            [kernels_at(coarse, coarse_m, _PRIOR_VAR), kernels_at(fine, fine_m, _PRIOR_VAR)]
        )
