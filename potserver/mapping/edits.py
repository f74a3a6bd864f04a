"""Changes of a map that are not scans: another map is merged into it, or what one robot saw is taken out."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from potserver.domain.tiles import (
    CARRIED,
    FREE,
    MapKernels,
    Region,
    TiledMap,
    TileIndex,
    part_of,
    tiles_of_part,
)
from potserver.domain.types import Float64, check_rigid
from potserver.errors import UnknownRobotError, UnsupportedError
from potserver.mapping.fusion import (
    FitEffort,
    FusionOptions,
    Moment,
    add_evidence,
    add_kernels,
    refit,
)
from potserver.mapping.surfaces import Samples
from potserver.numerics import evidence
from potserver.numerics.geometry import rotated_diagonal

_SWEEPS = 3  # over the parts, each solved with those around it held
_EFFORT = FitEffort(
    newton_steps=6, most_newton_steps=18, enough=1e-5
)  # nobody waits for an edit as for a scan


def merge(
    ours: TiledMap,
    theirs: TiledMap,
    T_ours_theirs: Float64,
    options: FusionOptions,
    moment: Moment,
    *,
    threads: int,
) -> tuple[TiledMap, set[TileIndex]]:
    """The map that holds what both have seen, and the tiles that changed.

    Their evidence enters as weighted points, under the names of their robots, at the resolution of our map; kernels carried
    from atoms come as they are. Then all weights there are solved again. So the order of two merges does not matter, up to
    how far the solves went; two maps that saw the *same* scans must not be merged: those would count twice.

    Args:
        ours, theirs: Neither is changed.
        T_ours_theirs: (4, 4) rigid: p_ours = T_ours_theirs @ p_theirs.
        options: As for scans.
        moment: Of the change.
        threads: Threads of the solves.
    Raises:
        BadPoseError: the transform is not rigid.
        SolverError: a solve ended without numbers.
    """
    check_rigid(T_ours_theirs)
    R, t = T_ours_theirs[:3, :3], T_ours_theirs[:3, 3]
    numbers = []
    for source, robot_id in enumerate(theirs.robots):
        if robot_id != FREE:
            ours, number = ours.with_robot(robot_id)
            numbers.append((source, number))
    size, pad = theirs.grid.size_m, ours.grid.coarse_m
    touched: set[TileIndex] = set()
    for part in dict.fromkeys(part_of(index) for index in theirs.tiles):
        inside = [index for index in tiles_of_part(part) if index in theirs.tiles]
        corners = np.asarray(inside) * size
        origin = corners[0]
        rows = [evidence.decay(theirs.tiles[i].rows, moment.weight_of(theirs.tiles[i])) for i in inside]
        where = np.concatenate(
            [
                evidence.positions(r, theirs.grid.fine_m) + c
                for r, c in zip(rows, corners - origin, strict=True)
            ]
        )
        data = evidence.Rows.concatenate(rows).rescaled(theirs.grid.fine_m / ours.grid.fine_m)
        kernels = MapKernels.concatenate(
            [theirs.tiles[i].kernels.moved(c) for i, c in zip(inside, corners - origin, strict=True)]
        )
        carried = kernels.take(kernels.level == CARRIED)
        points = (where + origin) @ R.T + t
        hinge = (carried.kernels.hinge_mean + origin) @ R.T + t
        everything = np.concatenate([points, hinge])
        if len(everything) == 0:
            continue
        lower, upper = everything.min(axis=0) - pad, everything.max(axis=0) + pad
        region = Region.of(ours, lower - pad, upper + pad, moment.weight_of)
        carried = MapKernels(
            kernels=carried.kernels.replace(
                hinge_mean=hinge - region.origin_m, hinge_var=rotated_diagonal(carried.kernels.hinge_var, R)
            ),
            level=carried.level,
            prior_mean=carried.prior_mean,
            prior_var=carried.prior_var,
        )
        new = evidence.Rows.concatenate(
            [
                add_evidence(
                    region,
                    Samples(
                        points[data.source == source] - region.origin_m,
                        data.kind[data.source == source],
                        data.sums[data.source == source, 3],
                    ),
                    number,
                )
                for source, number in numbers
            ]
        )
        planar = len(where) > 0 and float(np.ptp(where[:, 2])) < 1e-4 * theirs.grid.fine_m
        add_kernels(region, new, carried, options, planar, threads)
        tiles = region.tiles(lower, upper, revision=moment.revision, stamp_ns=moment.stamp_ns)
        ours = ours._replace(tiles={**ours.tiles, **tiles})  # indexed once, when all is settled
        touched.update(tiles)
    return _settle(ours, touched, options, moment, threads)


def remove_robot(
    tiled: TiledMap, robot_id: str, options: FusionOptions, moment: Moment, *, threads: int
) -> tuple[TiledMap, set[TileIndex]]:
    """The map without what one robot has seen, and the tiles that changed; places that nobody else saw are unknown again.

    What the robot's scans took out of others' hits does not come back. The robot's number is free for another.

    Raises:
        UnknownRobotError: the map has nothing from this robot.
        UnsupportedError: the map keeps no evidence (profile `paper`), so that nobody's share can be told.
        SolverError: a solve ended without numbers.
    """
    if robot_id not in tiled.robots:
        known = ", ".join(filter(None, tiled.robots)) or "nobody"
        raise UnknownRobotError(f"the map has nothing from {robot_id!r}; it has scans from {known}")
    source = tiled.robots.index(robot_id)
    without = {
        index: tile._replace(rows=tile.rows.take(tile.rows.source != source))
        for index, tile in tiled.tiles.items()
        if (tile.rows.source == source).any()
    }
    if not without and tiled.tiles and not any(len(tile.rows.kind) for tile in tiled.tiles.values()):
        raise UnsupportedError("the map keeps no evidence, only kernels: nobody's share of it can be told")
    # kernels reach beyond their tile: those beside it lose data too
    around = {
        (x + dx, y + dy, z + dz)
        for x, y, z in without
        for dx in (-1, 0, 1)
        for dy in (-1, 0, 1)
        for dz in (-1, 0, 1)
    }
    # what was expected about its scans goes too, where nobody else has seen anything
    tiles = {**tiled.tiles, **without}
    bare = {i: t._replace(lean=None) for i, t in tiles.items() if t.lean is not None and not len(t.rows.kind)}
    left = tiled.without_robot(source)._replace(tiles=tiles | bare)
    return _settle(left, (around | bare.keys()) & left.tiles.keys(), options, moment, threads)


def _settle(
    tiled: TiledMap, changed: Iterable[TileIndex], options: FusionOptions, moment: Moment, threads: int
) -> tuple[TiledMap, set[TileIndex]]:
    """Solve all weights of the parts with changed tiles, until they agree with each other."""
    options = dataclasses.replace(options, effort=_EFFORT)
    parts = sorted({part_of(index) for index in changed})
    done: set[TileIndex] = set()
    for _ in range(_SWEEPS):
        for part in parts:
            tiles, _ = refit(tiled, part, options, moment, threads=threads)
            tiled = tiled._replace(tiles={**tiled.tiles, **tiles})
            done.update(tiles)
    done.update(changed)
    settled = {index: tiled.tiles[index] for index in done if index in tiled.tiles}
    return tiled.with_tiles(settled, threads=threads), done
