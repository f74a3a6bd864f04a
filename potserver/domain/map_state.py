"""MapState: everything a map is at one moment."""

from __future__ import annotations

import dataclasses
import secrets

from potserver.domain.kernel_map import KernelMap
from potserver.domain.running_scores import RunningScores
from potserver.domain.tiles import TiledMap


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MapState:
    """What queries answer from, what the next scan builds on, and what is saved. Never changes: a scan makes the next one."""

    snapshot: KernelMap
    tiled: TiledMap | None = None  # none before the first scan, which chooses the grid
    # Drawn when a map begins, is cleared or is replaced: revisions of two epochs mean nothing to each other.
    epoch: int = dataclasses.field(default_factory=lambda: secrets.randbits(62))
    n_scans: int = 0
    stamp_ns: int = 0  # map time: the newest scan's
    scores: RunningScores = dataclasses.field(default_factory=RunningScores)

    @property
    def map_revision(self) -> int:
        """Grows by one a change."""
        return self.snapshot.map_revision
