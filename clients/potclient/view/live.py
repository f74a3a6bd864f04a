"""A picture of a map that follows it: what happens is shown at once, changed tiles one after the other."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Iterator

from potclient.cells import MapSource, Progress, bounds_of, grid_of, layer_of
from potclient.client import MapClient
from potclient.errors import UsageError
from potclient.view.layers import Picture, TileIndex, tile_box, tiles_between
from potclient.watched import WatchedCloud
from potschemas import messages

_Event = WatchedCloud | messages.Revision | messages.Receipt | messages.Stats
_WAIT_S = 0.2  # for something to happen, before the end is looked for again


class LiveView:
    """Draws a served map and goes on drawing what changes.

    Events are drawn before tiles, and tiles in the order in which they changed; a tile that changed twice meanwhile is fetched
    once.

    Args:
        client: Of the map.
        picture: That is drawn.
        resolution: m, edge of the cells that are asked for.
    """

    def __init__(self, client: MapClient, picture: Picture, resolution: float) -> None:
        self._client, self._picture, self._resolution = client, picture, resolution
        self._events: queue.SimpleQueue[_Event] = queue.SimpleQueue()
        self._dirty: dict[TileIndex, None] = {}  # in order
        self._size_m = 0.0
        self._layer_m: float | None = None
        self.n_tiles = 0  # drawn so far
        self.n_clouds = 0
        self.n_unplaced = 0  # clouds that did not say where they were taken
        self.revision = 0  # of the map, the newest that was heard of
        self.drawn_revision = 0  # every tile is shown as it was then, or later

    def run(self, end: threading.Event) -> None:
        """Draw until the end is set.

        Raises:
            PotclientError: the server does not answer.
        """
        with self._watching():
            info = self._client.info()
            self._size_m, self.revision = info.tile_size_m, info.map_revision
            if info.lower is not None and info.upper is not None:
                self._dirty |= dict.fromkeys(tiles_between(info.lower, info.upper, self._size_m))
            while not end.is_set():
                self._draw_events(wait=not self._dirty)
                if self._dirty:
                    self._draw_tile(next(iter(self._dirty)))
                    if not self._dirty:
                        self._picture.all_drawn()
                if not self._dirty:
                    self.drawn_revision = self.revision

    @contextlib.contextmanager
    def _watching(self) -> Iterator[None]:
        put = self._events.put
        with (
            self._client.watch_revisions(put),
            self._client.watch_clouds(put),
            self._client.watch_receipts(put),
            self._client.watch_stats(put),
        ):
            yield

    def _draw_events(self, *, wait: bool) -> None:
        with contextlib.suppress(queue.Empty):
            event = self._events.get(timeout=_WAIT_S) if wait else self._events.get_nowait()
            while True:
                self._draw(event)
                event = self._events.get_nowait()

    def _draw(self, event: _Event) -> None:
        if isinstance(event, messages.Revision):
            self._note_revision(event)
        elif isinstance(event, messages.Receipt):
            self._picture.draw_receipt(event)
        elif isinstance(event, messages.Stats):
            self._picture.at(event.stamp_ns)
            self._picture.draw_stats(event, self._client.keys.map_id)
        elif self._picture.draw_cloud(event):
            self.n_clouds += 1
        else:
            self.n_unplaced += 1

    def _note_revision(self, revision: messages.Revision) -> None:
        self.revision, self._size_m = revision.map_revision, revision.tile_size_m
        self._picture.at(revision.stamp_ns, revision.map_revision)
        if revision.n_kernels == 0:
            self._dirty.clear()
            self._picture.forget_tiles()
            return
        for x, y, z in revision.changed_tiles:
            self._dirty[(x, y, z)] = None

    def _draw_tile(self, tile: TileIndex) -> None:
        try:
            self._layer_m = layer_of(self._client)
        except UsageError:  # it was cleared meanwhile: the tick that says so is on its way
            self._dirty.clear()
            return
        box = tile_box(tile, self._size_m, self._resolution, self._layer_m)
        self._picture.draw_tile(tile, grid_of(self._client, box))
        del self._dirty[tile]
        self.n_tiles += 1


def draw_map(source: MapSource, picture: Picture, resolution: float, progress: Progress | None = None) -> int:
    """Draw a whole map as it is now; how many tiles it has.

    Raises:
        UsageError: the map is empty.
        PotclientError: see `MapClient.grid`.
    """
    layer_m, info = layer_of(source), source.info()
    tiles = tiles_between(*bounds_of(source), info.tile_size_m)
    for done, tile in enumerate(tiles, 1):
        picture.draw_tile(tile, grid_of(source, tile_box(tile, info.tile_size_m, resolution, layer_m)))
        if progress is not None:
            progress(done, len(tiles))
    picture.all_drawn()
    return len(tiles)
