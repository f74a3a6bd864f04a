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
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Float32, Float64
from potclient.errors import UsageError
from potclient.extras import how_to_install
from potclient.mesh import Mesh
from potclient.occupancy import Grid
from potclient.view.layers import TileIndex, layers_of
from potclient.watched import WatchedCloud
from potschemas import messages

_LAYERS = ("surface", "free", "unknown")
_FREE_COLOUR, _UNKNOWN_COLOUR, _NO_ECHO_COLOUR = (110, 190, 110), (150, 150, 160), (90, 90, 90)
_ROBOT_COLOURS = ((230, 90, 60), (60, 130, 230), (190, 90, 210), (230, 170, 40), (40, 180, 170))
_POINT_M, _WAY_M = 0.03, 0.06  # radii


class MapPicture:
    """Rerun's recording of a map, a `Picture`. Not thread-safe.

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
        layers, radius = layers_of(grid), grid.resolution / 6
        if len(layers.mesh.faces):
            self._draw_mesh(f"map/surface/{name}", layers.mesh)
        else:
            self._draw_points(f"map/surface/{name}", layers.mesh.vertices, layers.mesh.colours, radius)
        for layer, points, colour in (
            ("free", layers.free, _FREE_COLOUR), ("unknown", layers.unknown, _UNKNOWN_COLOUR)
        ):  # fmt: skip
            self._draw_points(f"map/{layer}/{name}", points, np.array([colour], np.uint8), radius)

    def all_drawn(self) -> None:
        """Rerun has shown each tile by itself."""

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

    def _draw_mesh(self, entity: str, mesh: Mesh) -> None:
        self.recording.log(
            entity,
            self._rr.Mesh3D(
                vertex_positions=mesh.vertices, triangle_indices=mesh.faces, vertex_colors=mesh.colours
            ),
        )

    def _draw_points(
        self, entity: str, points: Float32 | Float64, colours: NDArray[np.uint8], radius: float
    ) -> None:
        """Points (N, 3), m, or nothing any more."""
        shown = self._rr.Points3D(points, colors=colours, radii=radius)
        self.recording.log(entity, shown if len(points) else self._rr.Clear(recursive=False))


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
