"""What the adapters need of the services, as protocols: `MappingService` and `QueryService` satisfy them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from potschemas.answers import AnswerRule
from potserver.asking.tiles import KnownTiles, TilesPlan
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.map_state import MapState
from potserver.domain.running_scores import RunningScores
from potserver.domain.types import (
    Float64,
    KernelSet,
    MapUpdate,
    Occupancy,
    PathRisk,
    RayReturns,
    Scan,
    TileChange,
    Unknown,
)
from potserver.mapping.settings import MappingSettings


class Payload(Protocol):
    """Received bytes that are not copied out yet; `zenoh.ZBytes` is one."""

    def __len__(self) -> int: ...
    def to_bytes(self) -> bytes: ...


class Snapshot(Protocol):
    """One immutable state of a map."""

    @property
    def kernels(self) -> KernelSet: ...
    @property
    def map_revision(self) -> int: ...
    @property
    def rule(self) -> AnswerRule: ...
    def __len__(self) -> int: ...


class Mapper(Protocol):
    """The one writer of a map, and its readable state."""

    def integrate(self, scan: Scan, *, commit: Callable[[], None] | None = None) -> MapUpdate: ...
    def clear(self, *, commit: Callable[[MapState], None] | None = None) -> TileChange: ...
    def restore(self, state: MapState, *, commit: Callable[[MapState], None] | None = None) -> TileChange: ...
    def merge(
        self, other: MapState, T_map_other: Float64, *, commit: Callable[[MapState], None] | None = None
    ) -> TileChange: ...
    def remove_robot(
        self, robot_id: str, *, commit: Callable[[MapState], None] | None = None
    ) -> TileChange: ...
    @property
    def state(self) -> MapState: ...
    def warm_up(self) -> None: ...
    def use_dictionary(self, dictionary: AtomDictionary) -> None: ...
    @property
    def snapshot(self) -> Snapshot: ...
    @property
    def n_scans(self) -> int: ...
    @property
    def keeps_evidence(self) -> bool: ...
    @property
    def scores(self) -> RunningScores: ...
    @property
    def atom_usage(self) -> Mapping[str, int]: ...
    @property
    def dictionary(self) -> AtomDictionary: ...
    @property
    def settings(self) -> MappingSettings: ...


class Keeper(Protocol):
    """Where a map survives; `MapStore`, or `MemoryOnly`."""

    @property
    def durable(self) -> bool: ...
    def append(self, scan: Scan) -> None: ...
    def advance(self, mapper: Mapper, stamps: Mapping[str, int]) -> None: ...
    def replace(self, state: MapState, stamps: Mapping[str, int]) -> None: ...
    def save(self, name: str | None, mapper: Mapper, stamps: Mapping[str, int]) -> str: ...
    def load(self, name: str, mapper: Mapper) -> tuple[MapState, dict[str, int]]: ...


class GridPlan(Protocol):
    """A grid query that passed its checks; all parts come from one snapshot."""

    @property
    def shape(self) -> tuple[int, int, int]: ...
    @property
    def n_parts(self) -> int: ...
    def part(self, index: int) -> tuple[int, Occupancy]: ...


class RayPlan(Protocol):
    """A query of rays that passed its checks; all parts come from one snapshot."""

    @property
    def n_parts(self) -> int: ...
    def part(self, i: int) -> Any: ...
    def result(self, parts: Iterable[Any]) -> RayReturns: ...


class RiskPlan(Protocol):
    """A query of risk that passed its checks; all parts come from one snapshot."""

    @property
    def n_parts(self) -> int: ...
    def part(self, i: int) -> Any: ...
    def result(self, parts: Iterable[Any]) -> PathRisk: ...


class Asker(Protocol):
    """The read side of a map."""

    def warm_up(self) -> None: ...
    def occupancy(self, points: NDArray[np.floating[Any]], *, with_gradient: bool = False) -> Occupancy: ...
    def rays(
        self,
        origins: NDArray[np.floating[Any]],
        directions: NDArray[np.floating[Any]],
        max_range_m: float,
        *,
        quantiles: Sequence[float],
        unknown: Unknown,
        width_m: float | None,
        step_m: float | None,
    ) -> RayPlan: ...
    def risk(
        self,
        path: NDArray[np.floating[Any]],
        spheres: NDArray[np.floating[Any]],
        *,
        unknown: Unknown,
        resolution_m: float | None,
        correlation_m: float | None,
        dims: int,
    ) -> RiskPlan: ...
    def grid(
        self, lower: Sequence[float], upper: Sequence[float], resolution: float, *, part_cells: int
    ) -> GridPlan: ...
    def params(
        self, lower: Sequence[float] | None, upper: Sequence[float] | None, *, part_kernels: int
    ) -> tuple[list[KernelSet], int]: ...
    def tiles(
        self,
        known: KnownTiles | None,
        *,
        lower: Sequence[float] | None,
        upper: Sequence[float] | None,
        mantissa_bits: int,
        part_kernels: int,
    ) -> TilesPlan: ...
