"""What is evaluated: anything that takes scans one after the other and says how likely points are occupied."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet
from potserver.mapping.service import MappingService
from potserver.recordings import to_scan

_NUMBERS_A_KERNEL = 10  # position, its variances, gamma's shape and rate, the weight and its variance


_POINTS_AT_A_TIME = 200_000


class Answer(NamedTuple):
    """What a map says at N points."""

    mean: Float64  # (N,) P(occupied)
    observed: Bool  # (N,) false: the map does not know
    var: Float64 | None = None  # (N,) of that probability; None: the map has none


class Size(NamedTuple):
    """How large a map is."""

    cells: int  # kernels, or voxels of known state
    n_bytes: int  # of what a reader needs to give the same answers
    n_bytes_binary: int | None = None  # of a file that tells only occupied from free


class Mapper(ABC):
    """One row of the table."""

    name: str
    is_batch = False  # fitted once, after the last scan

    def warm_up(self, *, planar: bool) -> None:  # noqa: B027 - most have nothing to compile
        """Compile what is compiled, so that no scan pays for it."""

    @abstractmethod
    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        """Add a scan; ms by stage, where the mapper tells stages apart."""

    def finish(self, n_kernels: int) -> None:  # noqa: B027 - only batch mappers have work left
        """All scans have come.

        Args:
            n_kernels: Of the first map of the table, for those that are given as many.
        """

    @abstractmethod
    def occupancy(self, points: Float64) -> Answer:
        """What the map says at (N, 3) points, m, map frame."""

    def ask(self, points: Float64) -> Answer:
        """As `occupancy`, for any number of points; where the map does not know, its mean counts as 0.5."""
        starts = range(0, max(len(points), 1), _POINTS_AT_A_TIME)
        parts = [self.occupancy(np.ascontiguousarray(points[k : k + _POINTS_AT_A_TIME])) for k in starts]
        mean, observed = (np.concatenate([part[k] for part in parts]) for k in range(2))
        var = [part.var for part in parts if part.var is not None]
        return Answer(np.where(observed, mean, 0.5), observed, np.concatenate(var) if var else None)

    @abstractmethod
    def size(self) -> Size:
        """How large the map is now."""

    @property
    def kernel_map(self) -> KernelMap | None:
        """The map as kernels, if it is one: then rays can be asked."""
        return None


class ServiceMap(Mapper):
    """Our map, through the service that the server runs.

    Args:
        name: Of the row.
        service: An empty one.
    """

    def __init__(self, name: str, service: MappingService) -> None:
        self.name, self._service = name, service
        self._n_scans = 0

    def warm_up(self, *, planar: bool) -> None:
        self._service.warm_up()

    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        update = self._service.integrate(to_scan(scan, self._n_scans))
        self._n_scans += 1
        return update.timings_ms

    def occupancy(self, points: Float64) -> Answer:
        answer = self.kernel_map.occupancy(points)
        return Answer(answer.mean, answer.observed, answer.var)

    def size(self) -> Size:
        return Size(len(self.kernel_map), kernel_bytes(self.kernel_map.kernels))

    @property
    def kernel_map(self) -> KernelMap:
        return self._service.snapshot


def kernel_bytes(kernels: KernelSet) -> int:
    """Bytes that kernels take on the way to a reader: all their numbers in single precision."""
    return len(kernels) * _NUMBERS_A_KERNEL * np.dtype(np.float32).itemsize
