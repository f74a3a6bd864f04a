"""What the server accepts. One plain record, so that settings, checks and `q/info` cannot disagree."""

from __future__ import annotations

import dataclasses
from typing import Annotated, ClassVar


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Every bound on what comes in: the table `limits` of the settings, and bounds that follow from them."""

    max_cloud_bytes: Annotated[int, "of one cloud's message"] = 8 * 2**20
    max_cloud_points: Annotated[int, "of one cloud"] = 400_000
    max_query_bytes: Annotated[int, "of one question's message"] = 4 * 2**20
    max_query_points: Annotated[int, "of one `q/points`"] = 200_000
    max_grid_cells: Annotated[int, "of one `q/grid`"] = 4_000_000
    max_query_samples: Annotated[
        int, "steps of all rays of one `q/rays`, cells at all poses of one `q/risk`"
    ] = 4_000_000
    max_coordinate_m: Annotated[float, "of anything in the map frame; UTM northings end at 1e7"] = 2.0e7
    max_map_bytes: Annotated[int, "of one map, about; a cloud that comes then is refused `map_full`"] = (
        8 * 2**30
    )
    max_robot_bytes: Annotated[
        int,
        "of one map, by what one robot saw; its next cloud is refused `map_full`, those of others are not",
    ] = 4 * 2**30
    max_resident_bytes: Annotated[
        int, "of one map in memory, about; what no scan has touched for longest lies on pages in its store"
    ] = 2 * 2**30
    max_robots: Annotated[int, "robots remembered at once: poses, presence"] = 1024

    # The bytes and the samples of a query bound its work; these only say early that a query asks for too much.
    max_query_rays: ClassVar[int] = 50_000
    max_query_poses: ClassVar[int] = 5_000
    max_query_spheres: ClassVar[int] = 256
    max_query_tiles: ClassVar[int] = 100_000  # that the asker of one `q/tiles` has

    @property
    def wire_guard_bytes(self) -> int:
        """Size at which Zenoh itself drops a message, silently: far above what gets a typed error from us."""
        return 4 * max(self.max_cloud_bytes, self.max_query_bytes)
