"""Maps from what other programs know: labelled places become evidence, and kernels are solved on it as on a scan's."""

from __future__ import annotations

import numpy as np

from potschemas.lean import LeanTiles
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.tiles import CARRIED, MapKernels, Region, Tile, TiledMap, TileGrid
from potserver.domain.types import Bool, Float32, Float64, KernelSet
from potserver.errors import BadPointsError, EmptyError, SettingsError
from potserver.mapping.fusion import Moment, add_evidence, append
from potserver.mapping.service import MappingService
from potserver.mapping.surfaces import Samples
from potserver.numerics.evidence import Rows


def state_of_places(
    service: MappingService, points: Float64, occupied: Bool, weight: Float32, *, source: str, fine_m: float
) -> MapState:
    """The map that knows some places, and nothing else.

    Args:
        service: An empty one, whose settings count; it makes the map.
        points: (N, 3) m, map frame.
        occupied: (N,) labels; false = free.
        weight: (N,) in looks, a scan's hit is one.
        source: Whom the evidence is from: a robot's id.
        fine_m: Resolution wanted, m.
    Raises:
        EmptyError: no points. BadPointsError: NaN or infinite coordinates.
        SolverError: the solve ended without numbers.
    """
    if len(points) == 0:
        raise EmptyError("nothing is known in it: no map can be made")
    if not np.isfinite(points).all():
        raise BadPointsError("points have NaN or infinite coordinates")
    grid = TileGrid.of(service.settings.tile_size_m, fine_m)
    tiled, number = TiledMap.empty(grid).with_robot(source)
    tile = np.floor(points / grid.size_m).astype(np.int64)
    order = np.lexsort(tile.T)
    cuts = np.flatnonzero((np.diff(tile[order], axis=0) != 0).any(axis=1)) + 1
    for members in np.split(order, cuts):
        centre = (tile[members[0]] + 0.5) * grid.size_m
        region = Region.of(tiled, centre, centre)
        samples = Samples(
            points[members] - region.origin_m, occupied[members].astype(np.uint8), weight[members]
        )
        add_evidence(region, samples, number)
        # without kernels: nothing to index
        tiled = tiled._replace(tiles={**tiled.tiles, **region.tiles(centre, centre)})
    evidence_only = MapState(snapshot=KernelMap(KernelSet.empty()), tiled=tiled)
    service.merge(evidence_only, np.eye(4))
    return service.state


def state_of_kernels(service: MappingService, kernels: KernelSet, lean: LeanTiles | None = None) -> MapState:
    """The map that answers by these kernels, as they are; it has no evidence, so that only profile `paper` goes on from it.

    Args:
        service: An empty one, whose settings count; it makes the map.
        kernels: Map frame.
        lean: What their sums are added to.
    Raises:
        EmptyError: no kernels.
        SettingsError: the lean is of tiles of another size.
    """
    if len(kernels) == 0:
        raise EmptyError("there are no kernels in it: no map can be made")
    settings = service.settings
    tiled = TiledMap.empty(TileGrid.of(settings.tile_size_m, settings.resolution_m or 0.2))
    tiles = append(tiled, kernels, Moment(1, 0))
    if lean is not None:
        if lean.tile_size_m != settings.tile_size_m:
            raise SettingsError(
                f"the kernels lean on tiles of {lean.tile_size_m} m, mapping.tile_size_m is {settings.tile_size_m}:"
                " set it to theirs"
            )
        bare = Tile(Rows.empty(), MapKernels.new(KernelSet.empty(), CARRIED), revision=1)
        tiles |= {index: tiles.get(index, bare)._replace(lean=nodes) for index, nodes in lean.nodes.items()}
    tiled = tiled.with_tiles(tiles)
    empty = KernelMap(KernelSet.empty(), map_revision=1)
    service.restore(MapState(snapshot=empty, tiled=tiled))
    return service.state
