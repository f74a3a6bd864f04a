"""What the adapters need of the services, as protocols: `MappingService` and `QueryService` satisfy them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from potserver.domain.types import AnswerRule, Atom, KernelSet, MapUpdate, Occupancy, Scan
from potserver.services.settings import MappingSettings


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


class Atoms(Protocol):
    """The dictionary."""

    def get(self, atom_id: str) -> Atom: ...
    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[Atom]: ...


class Mapper(Protocol):
    """The one writer of a map, and its readable state."""

    def integrate(self, scan: Scan) -> MapUpdate: ...
    def clear(self) -> None: ...
    def warm_up(self) -> None: ...
    @property
    def snapshot(self) -> Snapshot: ...
    @property
    def n_scans(self) -> int: ...
    @property
    def atom_usage(self) -> Mapping[str, int]: ...
    @property
    def dictionary(self) -> Atoms: ...
    @property
    def settings(self) -> MappingSettings: ...


class GridPlan(Protocol):
    """A grid query that passed its checks; all parts come from one snapshot."""

    @property
    def shape(self) -> tuple[int, int, int]: ...
    @property
    def n_parts(self) -> int: ...
    def part(self, index: int) -> tuple[int, Occupancy]: ...


class Asker(Protocol):
    """The read side of a map."""

    def occupancy(self, points: NDArray[np.floating[Any]]) -> Occupancy: ...
    def grid(
        self, lower: Sequence[float], upper: Sequence[float], resolution: float, *, part_cells: int
    ) -> GridPlan: ...
    def params(
        self, lower: Sequence[float] | None, upper: Sequence[float] | None, *, part_kernels: int
    ) -> tuple[list[KernelSet], int]: ...
