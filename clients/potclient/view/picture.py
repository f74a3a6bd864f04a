"""What Rerun is told of a map: its surfaces, free space and the edge of the unknown, robots, and numbers over time.

Entities:
  map/surface/<tile>   where the probability is one half, coloured by its standard deviation; of a planar map the occupied cells
  map/free/<tile>      centres of free cells
  map/unknown/<tile>   centres of unknown cells beside free ones: the edge of what is known
  robots/<robot>       the last scan, and the way so far
  scores, latency, queues, robots_ms   time series
  events               receipts that say no
"""

from __future__ import annotations

import math
import urllib.parse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Bool, Float64
from potclient.cells import CellBox
from potclient.errors import UsageError
from potclient.extras import how_to_install
from potclient.mesh import mesh_of, sd_colours
from potclient.occupancy import Grid
from potclient.watched import WatchedCloud
from potschemas import messages

TileIndex = tuple[int, int, int]

_FREE_BELOW = 0.25
_LAYERS = ("surface", "free", "unknown")
_FREE_COLOUR, _UNKNOWN_COLOUR, _NO_ECHO_COLOUR = (110, 190, 110), (150, 150, 160), (90, 90, 90)
_ROBOT_COLOURS = ((230, 90, 60), (60, 130, 230), (190, 90, 210), (230, 170, 40), (40, 180, 170))
_POINT_M, _WAY_M = 0.03, 0.06  # radii


class MapPicture:
    """Rerun's recording of a map. Not thread-safe.

    Args:
        name: Of the recording, for people.
    Raises:
        UsageError: rerun-sdk is missing.
    """

    def __init__(self, name: str) -> None:
        try:
            import rerun
        except ImportError as error:
            raise UsageError(f"the view needs the package rerun-sdk: {how_to_install('view')}") from error
        self._rr: Any = rerun
        self.recording: Any = rerun.RecordingStream("potclient", send_properties=True)
        self.recording.send_recording_name(name)
        self._ways: dict[str, list[Float64]] = {}
        self.recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    # --- where it goes -----------------------------------------------------------------------------------------------

    def save(self, path: Path) -> None:
        """Write everything from now on to a file that `rerun FILE` opens."""
        self.recording.save(path, default_blueprint=_blueprint())

    def show(self) -> None:
        """Open Rerun's viewer on this machine."""
        self.recording.spawn(default_blueprint=_blueprint())

    def serve(self, web_port: int, stream_port: int) -> str:
        """Serve Rerun's viewer for browsers, and the stream that it reads; the address to open."""
        uri = self.recording.serve_grpc(grpc_port=stream_port, default_blueprint=_blueprint())
        self._rr.serve_web_viewer(web_port=web_port, open_browser=False, connect_to=uri)
        return f"http://127.0.0.1:{web_port}/?url={urllib.parse.quote(uri, safe='')}"

    def close(self) -> None:
        """Write what is left."""
        self.recording.flush()
        self.recording.disconnect()

    # --- what it shows -----------------------------------------------------------------------------------------------

    def at(self, stamp_ns: int, revision: int | None = None) -> None:
        """What is told from now on happened then."""
        self.recording.set_time("time", timestamp=np.datetime64(stamp_ns, "ns"))
        if revision is not None:
            self.recording.set_time("revision", sequence=revision)

    def draw_tile(self, tile: TileIndex, grid: Grid) -> None:
        """Show a tile as it is now, in the place of what was shown of it.

        Args:
            tile: Its number.
            grid: Its cells, and one more along each axis so that surfaces of neighbours meet.
        """
        name = "_".join(map(str, tile))
        is_planar = grid.shape[2] == 1
        if is_planar:
            self._draw_cells(f"map/surface/{name}", grid, grid.observed & (grid.mean >= 0.5), None)
        else:
            self._draw_mesh(f"map/surface/{name}", grid)
        free = grid.observed & (grid.mean < _FREE_BELOW)
        self._draw_cells(f"map/free/{name}", grid, free, _FREE_COLOUR)
        self._draw_cells(f"map/unknown/{name}", grid, ~grid.observed & _beside(free), _UNKNOWN_COLOUR)

    def forget_tiles(self) -> None:
        """Show no tiles any more: the map was cleared or replaced."""
        for layer in _LAYERS:
            self.recording.log(f"map/{layer}", self._rr.Clear(recursive=True))

    def draw_cloud(self, cloud: WatchedCloud) -> bool:
        """Show a robot's scan and go on with its way; False if the cloud does not say where it was taken."""
        if cloud.T_map_sensor is None:
            return False
        pose, rr = cloud.T_map_sensor, self._rr
        root = f"robots/{cloud.robot}"
        way = self._ways.setdefault(cloud.robot, [])
        way.append(pose[:3, 3])
        colour = _ROBOT_COLOURS[sorted(self._ways).index(cloud.robot) % len(_ROBOT_COLOURS)]
        self.recording.log(
            f"{root}/scan", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]), rr.Points3D(
                cloud.points,
                colors=np.where(cloud.is_return[:, None], colour, _NO_ECHO_COLOUR).astype(np.uint8),
                radii=_POINT_M,
            ),
        )  # fmt: skip
        self.recording.log(f"{root}/way", rr.LineStrips3D([np.stack(way)], colors=[colour], radii=_WAY_M))
        return True

    def draw_receipt(self, receipt: messages.Receipt) -> None:
        """Plot how long a cloud took; tell why it was not taken."""
        if receipt.status is messages.ReceiptStatus.ACCEPTED:
            self._plot({f"robots_ms/{receipt.robot}": receipt.integrate_ms})
            return
        text = f"{receipt.robot} #{receipt.seq} {receipt.status.value}: {receipt.reason} ({receipt.message})"
        self.recording.log("events", self._rr.TextLog(text, level=self._rr.TextLogLevel.WARN))

    def draw_stats(self, stats: messages.Stats, map_id: str) -> None:
        """Plot a server's own scores, latencies, and queues."""
        values: dict[str, float] = {
            f"queues/{name}": float(n) for name, n in stats.queues.items() if "bytes" not in name
        }
        for kind, latency in stats.latencies.items():
            values |= {f"latency/{kind}/p50_ms": latency.p50_ms, f"latency/{kind}/p95_ms": latency.p95_ms}
        scores = (stats.map_scores or {}).get(map_id)
        if scores is not None:
            values |= {"scores/nll": scores.nll, "scores/brier": scores.brier, "scores/ece": scores.ece}
        self._plot(values)

    def _plot(self, values: dict[str, float]) -> None:
        for name, value in values.items():
            if math.isfinite(value):
                self.recording.log(name, self._rr.Scalars(value))

    def _draw_mesh(self, entity: str, grid: Grid) -> None:
        mesh = mesh_of(grid)
        if not len(mesh.faces):
            self.recording.log(entity, self._rr.Clear(recursive=False))
            return
        self.recording.log(
            entity,
            self._rr.Mesh3D(
                vertex_positions=mesh.vertices, triangle_indices=mesh.faces, vertex_colors=mesh.colours
            ),
        )

    def _draw_cells(self, entity: str, grid: Grid, cells: Bool, colour: tuple[int, int, int] | None) -> None:
        """Points at the centres of cells, in a colour or in that of their standard deviation."""
        places = np.argwhere(cells)
        if not len(places):
            self.recording.log(entity, self._rr.Clear(recursive=False))
            return
        points = np.asarray(grid.lower, np.float64) + (places + 0.5) * grid.resolution
        colours: NDArray[Any] = np.array([colour]) if colour else sd_colours(np.sqrt(grid.var[cells]))
        self.recording.log(entity, self._rr.Points3D(points, colors=colours, radii=grid.resolution / 6))


def tile_box(tile: TileIndex, size_m: float, resolution: float, layer_m: float | None) -> CellBox:
    """The cells of a tile and one more along each axis; of a planar map, those of its layer."""
    low = np.asarray(tile, np.float64) * size_m
    box = CellBox.around(low, low + size_m, resolution)
    if layer_m is None:
        return box._replace(stop=box.stop + 1)
    flat = CellBox.around([0, 0, layer_m], [0, 0, layer_m], resolution)
    first, stop = box.first.copy(), box.stop.copy()
    first[2], stop[2] = flat.first[2], flat.stop[2]
    return box._replace(first=first, stop=stop, raised_m=flat.raised_m)


def tiles_between(lower: Iterable[float], upper: Iterable[float], size_m: float) -> list[TileIndex]:
    """The numbers of all tiles that a box (m, map frame) meets."""
    spans = [
        range(math.floor(a / size_m), math.floor(b / size_m) + 1) for a, b in zip(lower, upper, strict=True)
    ]
    return [(x, y, z) for x in spans[0] for y in spans[1] for z in spans[2]]


def _beside(cells: Bool) -> Bool:
    """Which cells share a face with one of these."""
    grown = np.zeros_like(cells)
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        grown[tuple(ahead)] |= cells[tuple(behind)]
        grown[tuple(behind)] |= cells[tuple(ahead)]
    return grown


def _blueprint() -> Any:
    """The panels: the map beside its numbers; free and unknown space wait to be switched on."""
    import rerun.blueprint as rrb

    hidden = rrb.EntityBehavior(visible=False)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(
                name="map",
                contents=["/map/**", "/robots/**"],
                overrides={"/map/free": hidden, "/map/unknown": hidden},
            ),
            rrb.Vertical(
                rrb.TimeSeriesView(name="the map's own scores", origin="/scores"),
                rrb.TimeSeriesView(name="ms a cloud", origin="/robots_ms"),
                rrb.TimeSeriesView(name="ms an answer", origin="/latency"),
                rrb.TimeSeriesView(name="waiting", origin="/queues"),
                rrb.TextLogView(name="not accepted", origin="/events"),
            ),
            column_shares=[3, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="time", play_state="following"),
        rrb.SelectionPanel(state="collapsed"),
    )
