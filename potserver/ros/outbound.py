"""What goes out: the map as an OccupancyGrid, an Octomap and a cloud of surfaces, computed while somebody listens."""

from __future__ import annotations

import threading
from typing import NamedTuple

from potclient.client import MapClient
from potclient.errors import PotclientError, UsageError
from potclient.ros import maps
from potclient.ros.types import OCCUPANCY_GRID, OCCUPANCY_GRID_UPDATE, OCTOMAP, POINT_CLOUD
from potschemas import messages
from potserver.health import Health
from potserver.log import get_logger
from potserver.ros.changes import Changes
from potserver.ros.drops import Drops
from potserver.ros.grid_layer import GridLayer
from potserver.ros.settings import RosSettings
from potserver.ros.topics import RosNode, RosTopic
from potserver.ros.voxel_layer import VoxelLayer
from potserver.threads import spawn

log = get_logger("potserver.ros")

UPDATES_A_GRID = 10  # so many updates at most between two whole grids: whoever comes late misses those before
_SET_BACK_NS = 10**10  # so far back no cloud is late: a simulation began anew
_JOIN_S = 10.0  # one question to the map may be on its way


class _Stamp(NamedTuple):
    frame_id: str
    stamp_ns: int


class Outbound:
    """All topics that a bridge publishes, on one thread."""

    def __init__(self, node: RosNode, settings: RosSettings, client: MapClient, health: Health) -> None:
        self._settings, self._health = settings, health
        self._drops = Drops(health, "maps")
        self._newest_ns = 0
        self._ended = threading.Event()
        self._outputs: list[_GridOutput | _VoxelOutput] = []
        if settings.out:
            self._outputs = [
                _GridOutput(node, GridLayer(client, settings), settings),
                _VoxelOutput(node, VoxelLayer(client, settings), settings),
            ]
        self._ticks = client.watch_revisions(self._note_revision)
        self._thread = spawn("ros-out", self._run)

    def note_stamp(self, stamp_ns: int) -> None:
        """A cloud of this stamp went into the map: what goes out from now on is as new as the newest."""
        if stamp_ns > self._newest_ns or stamp_ns < self._newest_ns - _SET_BACK_NS:
            self._newest_ns = stamp_ns

    def close(self) -> bool:
        """Withdraw all topics; false if the thread did not end in time."""
        self._ended.set()
        self._ticks.close()
        self._thread.join(_JOIN_S)
        for output in self._outputs:
            output.close()
        return not self._thread.is_alive()

    def _note_revision(self, tick: messages.Revision) -> None:
        for output in self._outputs:
            output.changes.add(tick)

    def _run(self) -> None:
        while not self._ended.wait(self._settings.period_s):
            stamp = _Stamp(self._settings.map_frame.strip("/"), self._newest_ns)
            for output in self._outputs:
                try:
                    self._health.count("ros.maps.sent", output.refresh(stamp))
                except PotclientError as error:
                    output.changes.give_back()
                    reason = "not_possible" if isinstance(error, UsageError) else "no_answer"
                    self._drops.count(reason, output.name, str(error))
                except Exception as error:
                    output.changes.give_back()
                    log.exception("ros_output_failed", topic=output.name)
                    self._drops.count("internal", output.name, repr(error))


class _GridOutput:
    """The OccupancyGrid and its updates."""

    def __init__(self, node: RosNode, layer: GridLayer, settings: RosSettings) -> None:
        self.name, self.changes = settings.out_topic("map"), Changes()
        self._layer, self._grid_m = layer, settings.grid_m
        self._whole = node.topic(self.name, OCCUPANCY_GRID, latched=True)
        self._updates = node.topic(f"{self.name}_updates", OCCUPANCY_GRID_UPDATE, latched=False)
        self._had_listeners = False
        self._n_updates = 0

    def refresh(self, stamp: _Stamp) -> int:
        """Compute and publish what changed, if somebody listens; how many messages that made."""
        listens, listened = self._whole.has_listeners, self._had_listeners
        self._had_listeners = listens
        change = self.changes.take() if listens else None
        patches = self._layer.update(change) if change else []
        if self._layer.whole.values.size == 0:  # nothing was ever in the map
            return 0
        if patches is None or (patches and not self._wants_updates()) or (listens and not listened):
            self._put_whole(stamp)
            return 1
        for patch in patches:
            first, whole = patch.first, self._layer.whole.first
            place = (first[0] - whole[0], first[1] - whole[1])
            self._updates.put(maps.occupancy_grid_update(patch.values, place, **stamp._asdict()))
        self._n_updates += 1 if patches else 0
        return len(patches)

    def close(self) -> None:
        self._whole.close()
        self._updates.close()

    def _wants_updates(self) -> bool:
        return self._updates.has_listeners and self._n_updates < UPDATES_A_GRID

    def _put_whole(self, stamp: _Stamp) -> None:
        self._n_updates = 0
        (i, j), values = self._layer.whole
        lower = (i * self._grid_m, j * self._grid_m)
        self._whole.put(maps.occupancy_grid(values, lower, self._grid_m, **stamp._asdict()))


class _VoxelOutput:
    """The Octomap and the surfaces, of the same voxels."""

    def __init__(self, node: RosNode, layer: VoxelLayer, settings: RosSettings) -> None:
        self.name, self.changes = settings.out_topic("octomap"), Changes()
        self._layer, self._voxel_m = layer, settings.voxel_m
        self._octomap = node.topic(self.name, OCTOMAP, latched=True)
        self._surfaces = node.topic(settings.out_topic("surfaces"), POINT_CLOUD, latched=True)
        self._had_listeners: set[RosTopic] = set()

    def refresh(self, stamp: _Stamp) -> int:
        """As for the grid."""
        topics = (self._octomap, self._surfaces)
        listened, self._had_listeners = self._had_listeners, {t for t in topics if t.has_listeners}
        change = self.changes.take() if self._had_listeners else None
        if change:
            self._layer.update(change)
        due = self._had_listeners if change else self._had_listeners - listened
        if self._octomap in due:
            tree = maps.octomap(self._layer.leaves(), self._voxel_m, **stamp._asdict())
            self._octomap.put(tree)
        if self._surfaces in due:
            surface = self._layer.surface
            self._surfaces.put(maps.surface_cloud(surface.points, surface.sd, **stamp._asdict()))
        return len(due)

    def close(self) -> None:
        self._octomap.close()
        self._surfaces.close()
