"""What the server accepts. One plain record, so that settings, checks and `q/info` cannot disagree."""

from __future__ import annotations

import dataclasses
from typing import ClassVar


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Every bound on what comes in. The fields are settings, in the table `[limits]`; the others are constants."""

    max_cloud_bytes: int = 8 * 2**20
    max_cloud_points: int = 400_000
    max_query_bytes: int = 4 * 2**20
    max_query_points: int = 200_000
    max_grid_cells: int = 4_000_000
    max_query_samples: int = 4_000_000  # steps of all rays of a query; cells at all poses of one
    max_coordinate_m: float = 2.0e7  # each coordinate in the map frame; UTM northings end at 1e7
    max_robots: int = 1024  # robots remembered at once: stamps, poses, presence

    # The bytes and the samples of a query bound its work; these only say early that a query asks for too much.
    max_query_rays: ClassVar[int] = 50_000
    max_query_poses: ClassVar[int] = 5_000
    max_query_spheres: ClassVar[int] = 256
    max_query_tiles: ClassVar[int] = 100_000  # that the asker of one `q/tiles` has

    @property
    def wire_guard_bytes(self) -> int:
        """Size at which Zenoh itself drops a message, silently: far above what gets a typed error from us."""
        return 4 * max(self.max_cloud_bytes, self.max_query_bytes)
