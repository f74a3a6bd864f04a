"""One map for browsers: a client of our own server, so that a page sees what any client sees."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from potclient.cells import CellBox, bounds_of, grid_of, layer_of
from potclient.client import MapClient
from potclient.errors import UsageError
from potclient.mesh import Mesh, mesh_of
from potclient.occupancy import Grid, surface_var
from potclient.view.layers import TileIndex, tile_box, tiles_between
from potclient.watched import WatchedCloud
from potschemas import messages

RESOLUTION_M = 0.25
MAX_SLICE_CELLS = 1_000_000
_MAX_TILES = 4096  # that are kept as meshes
_READY_S = 5.0
_MAX_POSES, _STEP_SHARE = 1000, 0.5  # of a way, and of the ball's radius from one to the next


class MapFeed:
    """Follows one map: which tiles changed when, where its robots are, and what became of their clouds.

    Args:
        endpoint: Of the server.
        map_id: Of the map.
        root: Of its keys.
    Raises:
        PotclientError: the map is not served there.
    """

    def __init__(self, endpoint: str, map_id: str, root: str) -> None:
        self._lock = threading.Lock()
        self._tiles: dict[
            TileIndex, tuple[int, float]
        ] = {}  # revision and time of the last change that we know of
        self._meshes: dict[TileIndex, tuple[int, bytes]] = {}
        self._robots: dict[str, dict[str, Any]] = {}
        self._cleared_at = 0
        self.client = MapClient(endpoint, map=map_id, root=root, timeout_s=30.0)
        try:
            self.client.wait_ready(_READY_S)
            self.client.watch_revisions(self._note_revision)
            self.client.watch_clouds(self._note_cloud)
            self.client.watch_receipts(self._note_receipt)
            info = self.client.info()
            self._tile_m = info.tile_size_m
            if info.lower is not None and info.upper is not None:
                for tile in tiles_between(info.lower, info.upper, info.tile_size_m):
                    self._tiles.setdefault(tile, (info.map_revision, 0.0))
        except BaseException:
            self.client.close()
            raise

    def close(self) -> None:
        """Leave the server."""
        self.client.close()

    def state(self) -> dict[str, Any]:
        """The robots, the tiles with the revision of their last change, and when the map was last cleared."""
        with self._lock:
            return {
                "map": self.client.keys.map_id,
                "tile_m": self._tile_m,
                "cleared_at": self._cleared_at,
                "tiles": [[*tile, revision] for tile, (revision, _) in self._tiles.items()],
                "robots": self._robots.copy(),
            }

    def tile(self, tile: TileIndex) -> bytes:
        """The surface in a tile: counts of vertices and faces (uint32), vertices (float32), colours (uint8), faces (uint32)."""
        with self._lock:
            revision = self._tiles.get(tile, (0, 0.0))[0]
            held = self._meshes.get(tile)
        if held is not None and held[0] == revision:
            return held[1]
        layer_m = self._layer()
        grid = grid_of(self.client, tile_box(tile, self._tile_m, RESOLUTION_M, layer_m))
        encoded = _encode(mesh_of(grid) if layer_m is None else _flat(grid))
        with self._lock:
            while len(self._meshes) >= _MAX_TILES:
                del self._meshes[next(iter(self._meshes))]
            self._meshes[tile] = (revision, encoded)
        return encoded

    def slice(self, z: float) -> bytes:
        """A horizontal layer: columns and rows (uint32), x, y of its corner and its cell (float32), then RGBA a cell.

        Raises:
            UsageError: the map is empty.
        """
        lower, upper = bounds_of(self.client)
        area = float(np.prod(upper[:2] - lower[:2]))
        cell = max(RESOLUTION_M, float(np.sqrt(area / MAX_SLICE_CELLS)))
        box = CellBox.around([*lower[:2], z], [*upper[:2], z], cell)
        shape = (box.stop - box.first)[:2]
        colours = np.zeros((*shape, 4), np.uint8)
        for part in box.tiles():
            grid = grid_of(self.client, part)
            i, j = (
                slice(int(part.first[a] - box.first[a]), int(part.stop[a] - box.first[a])) for a in (0, 1)
            )
            colours[i, j] = _slice_colours(grid)
        head = np.array(shape, "<u4").tobytes() + np.array([*(box.first[:2] * cell), cell], "<f4").tobytes()
        return head + np.ascontiguousarray(colours.transpose(1, 0, 2)).tobytes()

    def point(self, place: list[float]) -> dict[str, Any]:
        """What the map says of a point (3,) m, and how long ago its tile changed, as far as we have watched."""
        answer = self.client.occupancy([place])
        tile = tuple(int(v) for v in np.floor(np.asarray(place) / self._tile_m))
        with self._lock:
            changed = self._tiles.get((tile[0], tile[1], tile[2]), (0, 0.0))[1]
        return {
            "point": place,
            "mean": float(answer.mean[0]),
            "sd": float(np.sqrt(answer.var[0])),
            "observed": bool(answer.observed[0]),
            "revision": answer.revision,
            "age_s": round(time.time() - changed, 1) if changed else None,
        }

    def ray(self, origin: list[float], toward: list[float]) -> dict[str, Any]:
        """Where a ray from one point (3,) m towards another first returns."""
        direction = np.asarray(toward) - np.asarray(origin)
        reach = float(np.linalg.norm(direction))
        answer = self.client.rays([origin], [direction], reach)
        return {
            "hit_probability": float(answer.hit_probability[0]),
            "mean_m": float(answer.mean_m[0]),
            "sd_m": float(answer.std_m[0]),
            "reach_m": reach,
            "unknown_share": float(answer.unknown_share[0]),
        }

    def risk(self, start: list[float], end: list[float], radius_m: float) -> dict[str, Any]:
        """How likely a ball touches something on the straight way from one point (3,) m to another."""
        length = float(np.linalg.norm(np.asarray(end) - np.asarray(start)))
        n_poses = min(_MAX_POSES, 2 + int(length / (_STEP_SHARE * radius_m)))
        way = np.tile(np.eye(4), (n_poses, 1, 1))
        way[:, :3, 3] = np.linspace(start, end, n_poses)
        answer = self.client.risk(way, [[0.0, 0.0, 0.0, radius_m]], unknown="prior")
        return {
            "max": answer.path_max_probability,
            "union": answer.path_union_probability,
            "unknown_share": answer.path_unknown_share,
            "length_m": length,
        }

    def _layer(self) -> float | None:
        try:
            return layer_of(self.client)
        except UsageError:
            return None  # empty: no surface either way

    def _note_revision(self, revision: messages.Revision) -> None:
        with self._lock:
            if revision.n_kernels == 0:
                self._tiles.clear()
                self._meshes.clear()
                self._cleared_at = revision.map_revision
            for x, y, z in revision.changed_tiles if revision.n_kernels else ():
                self._tiles[(x, y, z)] = (revision.map_revision, revision.stamp_ns / 1e9)

    def _note_cloud(self, cloud: WatchedCloud) -> None:
        if cloud.T_map_sensor is not None:
            with self._lock:
                robot = self._robots.setdefault(cloud.robot, {})
                robot["pose"] = [round(float(v), 4) for v in cloud.T_map_sensor[:3, :].ravel()]

    def _note_receipt(self, receipt: messages.Receipt) -> None:
        with self._lock:
            robot = self._robots.setdefault(receipt.robot, {})
            robot |= {
                "seq": receipt.seq,
                "status": receipt.status.value,
                "reason": receipt.reason,
                "integrate_ms": round(receipt.integrate_ms, 1),
            }


def _encode(mesh: Mesh) -> bytes:
    counts = np.array([len(mesh.vertices), len(mesh.faces)], "<u4").tobytes()
    colours = mesh.colours.tobytes()
    padding = b"\0" * (-len(colours) % 4)  # the faces begin at a multiple of four bytes
    return (
        counts
        + mesh.vertices.astype("<f4").tobytes()
        + colours
        + padding
        + mesh.faces.astype("<u4").tobytes()
    )


def _flat(grid: Grid) -> Mesh:
    """The occupied cells of a planar map, two triangles each."""
    cells = np.argwhere(grid.observed & (grid.mean >= 0.5))
    corner = np.asarray(grid.lower, np.float64) + cells * grid.resolution
    corner[:, 2] += grid.resolution / 2
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * grid.resolution
    vertices = (corner[:, None, :] + square).reshape(-1, 3).astype(np.float32)
    two = np.array([[0, 1, 2], [0, 2, 3]])
    faces = (4 * np.arange(len(cells))[:, None, None] + two).reshape(-1, 3)
    sd = np.sqrt(surface_var(grid, tuple(cells.T))).astype(np.float32)
    return Mesh(vertices, faces.astype(np.int64), np.repeat(sd, 4))


def _slice_colours(grid: Grid) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """(nx, ny, 4): white where free, black where occupied; the unknown is see-through."""
    mean, observed = grid.mean[:, :, 0], grid.observed[:, :, 0]
    shade = np.rint(255 * (1 - mean)).astype(np.uint8)
    colours = np.stack([shade, shade, shade, np.where(observed, 230, 0).astype(np.uint8)], axis=2)
    return np.asarray(colours, np.uint8)
