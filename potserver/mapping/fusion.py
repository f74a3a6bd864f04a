"""A scan enters the overall map: its samples become evidence, kernels are put where they are missing, and weights follow.

Evidence ages where a half-life is set: a tile's rows weigh less the longer ago they were looked at, in the map's own time.
Tiles around a scan age as it comes; of the others one part a scan, the stalest first, so that they drift back to unknown.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from potschemas.answers import PRIOR_VAR
from potschemas.lean import Bytes
from potserver.domain.tiles import (
    CARRIED,
    COARSE,
    MapKernels,
    Region,
    Tile,
    TiledMap,
    TileGrid,
    TileIndex,
    level_of,
    part_of,
    scale_of,
    tiles_of_part,
)
from potserver.domain.types import Bool, Float32, Float64, KernelSet
from potserver.errors import SolverError
from potserver.mapping.news import due
from potserver.mapping.placing import activation, gamma_of_spacing, kernels_at
from potserver.mapping.refinement import FEATURE_CUT
from potserver.mapping.settings import MappingSettings
from potserver.mapping.support import support_of
from potserver.mapping.surfaces import FACE_SAMPLES, FaceSamples, Samples, hits_of, surface_samples
from potserver.numerics import evidence
from potserver.numerics.beams import Beams, LabelledPoints, beam_weights
from potserver.numerics.evidence import FREE, HIT, kind_of
from potserver.numerics.feature_blocks import feature_blocks
from potserver.numerics.geometry import bounds, inside_box
from potserver.numerics.lattice_nodes import new_nodes
from potserver.numerics.warm_fit import Prior, Solver, warm_fit

_FINEST_M, _COARSEST_M, _FINE_PER_RANGE = 0.2, 0.4, 1.0 / 20.0
_DETAIL_M = 0.1  # the finest kernels, about hits that lie closely
_COARSE_REACH = 0.7  # spacings: nearer coarse nodes than this get a kernel, see lattice_nodes.new_nodes
_FINE_REACH = 0.9  # the same for fine nodes about hits, so that faces have nodes on both sides
_EXPLAINED = 1.0  # activation by carried kernels at which the lattice adds none
_LONGEST_STEP = 4.0  # Newton steps
_UNSUPPORTED = 1e-5  # of a kernel's curvature: what no row within its reach leaves
_STALE = 0.125  # half-lives after which a tile that no scan touches is fitted again
_MEMORY = 200.0  # looks that one place remembers; older ones give way
_SATURATION = 20.0  # looks at one place that count in a solve; further ones repeat them
_CHEAP_VALUES = 60_000_000  # features that a solve may touch for more Newton steps than it must take


class FitEffort(NamedTuple):
    """Steps of one solve, from where the map is."""

    newton_steps: int = 3
    most_newton_steps: int = 6  # where the map is small and steps are cheap
    gradient_steps: int = 6  # conjugate-gradient steps for each Newton step
    # Relative gain of the objective below which steps end, where they are not cheap: the next scan goes on.
    enough: float = 0.02


SCAN_EFFORT = FitEffort()


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FusionOptions:
    """How scans enter the overall map; the settings of the same names say more."""

    gone_odds: float
    max_kernels_per_tile: int
    detail_m: float  # spacing of the finest kernels
    effort: FitEffort = SCAN_EFFORT
    faces: FaceSamples = FACE_SAMPLES

    @staticmethod
    def of(
        settings: MappingSettings, effort: FitEffort = SCAN_EFFORT, faces: FaceSamples = FACE_SAMPLES
    ) -> FusionOptions:
        """What fusion needs of the settings."""
        return FusionOptions(
            gone_odds=settings.gone_odds,
            max_kernels_per_tile=settings.max_kernels_per_tile,
            detail_m=settings.resolution_m or _DETAIL_M,
            effort=effort,
            faces=faces,
        )

    def scales_of(self, grid: TileGrid) -> int:
        """How many scales a map of this grid has: its resolution is halved as long as it stays at `detail_m` or above."""
        return int(np.clip(1 + np.floor(np.log2(grid.fine_m / self.detail_m) + 1e-6), 1, evidence.SCALES))


class Look(NamedTuple):
    """One scan, as the overall map learns from it."""

    labelled: LabelledPoints  # map frame
    beams: Beams  # relative to `origin`
    origin: Float64  # (3,) m, map frame
    source: int  # the robot's number in the map
    is_planar: bool  # kernels stay in the plane of the points
    rng: np.random.Generator  # of the samples next to faces
    leans: Mapping[TileIndex, Bytes]  # of tiles that take one now


class Moment(NamedTuple):
    """The change that is being made: what its tiles are marked with, and what older evidence weighs by now."""

    revision: int  # of the map, afterwards
    stamp_ns: int  # map time
    half_life_s: float = 0.0  # 0: evidence does not age

    def weight_of(self, tile: Tile) -> float:
        """What a tile's evidence still weighs."""
        if not self.half_life_s:
            return 1.0
        return float(0.5 ** (max(self.stamp_ns - tile.stamp_ns, 0) / 1e9 / self.half_life_s))


class Fused(NamedTuple):
    """What a scan makes of the map."""

    tiles: dict[TileIndex, Tile]  # those that are new or other than before
    n_added: int
    n_transported: int  # of those added
    converged: bool


def grid_for(beams: Beams, tile_size_m: float, resolution_m: float = 0.0) -> TileGrid:
    """The grid of a map that starts with these beams: far looks are spread thinly and need wider kernels.

    Args:
        beams: Of the first scan.
        tile_size_m: Edge of a tile.
        resolution_m: The one wanted; 0 takes a 20th of the median range, between 0.2 and 0.4 m.
    """
    if not resolution_m:
        length = np.linalg.norm(beams.ends[beams.is_return] if beams.is_return.any() else beams.ends, axis=1)
        resolution_m = float(np.clip(_FINE_PER_RANGE * np.median(length), _FINEST_M, _COARSEST_M))
    return TileGrid.of(tile_size_m, resolution_m)


def fuse(
    tiled: TiledMap,
    look: Look,
    options: FusionOptions,
    moment: Moment,
    *,
    threads: int,
) -> Fused:
    """Add a scan to the tiles around it, and solve all weights near it jointly on all evidence there.

    Args:
        tiled: The map; it is not changed.
        look: The scan.
        options: How.
        moment: Of the change.
        threads: Threads of the solve.
    Raises:
        SolverError: the solve ended without numbers.
        SettingsError: the scan is too wide for the resolution.
    """
    grid = tiled.grid
    pad = grid.coarse_m
    lower, upper = bounds(look.labelled.points)
    lower, upper = lower - pad, upper + pad
    region = Region.of(tiled, lower - 4 * pad, upper + 4 * pad, moment.weight_of)
    inside = lower - region.origin_m, upper - region.origin_m  # of tiles that are stored again
    region.lean |= look.leans
    samples = _samples_of(look, region, options, threads)
    new_rows = add_evidence(region, samples, look.source, within=inside, turn=moment.revision)
    none = MapKernels.new(KernelSet.empty(), CARRIED)
    added = add_kernels(region, new_rows, none, options, look.is_planar, threads)
    fitted = _fit_news(region, *inside, added, options, moment, threads)
    tiles = region.tiles(lower, upper, revision=moment.revision, stamp_ns=moment.stamp_ns)
    return Fused(tiles, len(added), n_transported=0, converged=fitted)


def _samples_of(look: Look, region: Region, options: FusionOptions, threads: int) -> Samples:
    """All that a scan says; rows of hits that have left, as its beams see through their place, are emptied in place."""
    grid, start = region.grid, look.origin - region.origin_m
    labelled, beams = look.labelled, look.beams
    known = region.rows.take(region.rows.occupied & evidence.is_alive(region.rows))
    where = evidence.positions(known, grid.fine_m)
    hits = hits_of(beams, start, where, grid.fine_m, options.scales_of(grid), planar=look.is_planar)
    scale = np.zeros(len(beams.ends), np.uint8)
    scale[beams.is_return] = hits.scale
    kind = np.where(labelled.occupied, kind_of(HIT, scale[labelled.beam]), np.uint8(FREE))
    parts = [Samples(labelled.points - region.origin_m, kind, beam_weights(labelled))]
    if options.gone_odds:
        seen = evidence.see_through(
            region.rows, beams, hits.faces, start, fine_m=grid.fine_m, odds=options.gone_odds,
            beside_weight=options.faces.beside_weight, threads=threads,
        )  # fmt: skip
        parts.append(Samples(*seen))
    parts.append(surface_samples(hits, start, options.faces, look.rng))
    return Samples.concatenate(parts)


def append(tiled: TiledMap, carried: KernelSet, moment: Moment) -> dict[TileIndex, Tile]:
    """The tiles of a map that takes transported kernels as they are and learns nothing (the paper's POT).

    Args:
        tiled: The map; it is not changed.
        carried: In the map frame.
        moment: Of the change.
    """
    size = tiled.grid.size_m
    tile_of = np.floor(carried.hinge_mean / size).astype(np.int64)
    found, member = np.unique(tile_of, axis=0, return_inverse=True)
    out = {}
    for number, corner in enumerate(found):
        index = (int(corner[0]), int(corner[1]), int(corner[2]))
        new = carried.take(np.flatnonzero(member.reshape(-1) == number)).moved(-corner * size)
        former = tiled.tiles.get(index)
        kernels = [former.kernels] if former else []
        out[index] = Tile(
            evidence.Rows.empty(),
            MapKernels.concatenate([*kernels, MapKernels.new(new, CARRIED)]),
            moment.revision,
            moment.stamp_ns,
        )
    return out


def refit(
    tiled: TiledMap, part: TileIndex, options: FusionOptions, moment: Moment, *, threads: int
) -> tuple[dict[TileIndex, Tile], bool]:
    """Solve the weights of one part's kernels again, those around it held; its tiles, and whether the solve went well.

    Raises:
        SolverError: the solve ended without numbers.
    """
    grid = tiled.grid
    corner = np.asarray(tiles_of_part(part)[0]) * grid.size_m
    edge = (np.asarray(tiles_of_part(part)[-1]) + 1) * grid.size_m - corner
    pad = 4 * grid.coarse_m
    region = Region.of(tiled, corner - pad, corner + edge + pad, moment.weight_of)
    start = corner - region.origin_m
    fitted = _fit(region, start, start + edge, options, threads)
    inner = corner + 1e-3 * grid.fine_m, corner + edge - 1e-3 * grid.fine_m
    tiles = region.tiles(*inner, revision=moment.revision, stamp_ns=moment.stamp_ns)
    return {index: tile for index, tile in tiles.items() if index in tiled.tiles}, fitted


def stalest_part(tiled: TiledMap, moment: Moment) -> TileIndex | None:
    """The part with the tile that has waited longest to age; none if all are fresh enough, or nothing ages."""
    if not moment.half_life_s or not tiled.tiles:
        return None
    oldest = min(tiled.tiles, key=lambda index: tiled.tiles[index].stamp_ns)
    return part_of(oldest) if moment.weight_of(tiled.tiles[oldest]) < 0.5**_STALE else None


def add_evidence(
    region: Region,
    samples: Samples,
    source: int,
    *,
    within: tuple[Float64, Float64] | None = None,
    turn: int = 0,
) -> evidence.Rows:
    """Put samples into a region's rows; the rows of hits and free samples that are new.

    Within a box, old rows that say little join others: see `evidence.add_sparing`.
    """
    fine_m = region.grid.fine_m
    rows, gained, n_old, cells = evidence.add_sparing(
        region.rows, *samples, fine_m, source, within=within, turn=turn
    )
    evidence.clip(rows, _MEMORY)
    evidence.forget(rows, gained, cells, _MEMORY)
    region.rows, region.cells, region.gained = rows, cells, gained
    new = rows.take(slice(n_old, None))
    return new.take(new.sort <= evidence.HIT)


def add_kernels(
    region: Region,
    new_rows: evidence.Rows,
    taken: MapKernels,
    options: FusionOptions,
    planar: bool,
    threads: int,
) -> MapKernels:
    """Put kernels where new rows ask for them, beside those that are taken as they are; all that were added."""
    grid, present = region.grid, region.kernels
    asking = evidence.positions(new_rows, grid.fine_m)
    parts = [taken]
    from_atoms = KernelSet.concatenate([present.kernels.take(present.level == CARRIED), taken.kernels])
    lattices = [(COARSE, grid.coarse_m, asking, _COARSE_REACH)]
    for scale in range(evidence.SCALES):  # finer kernels stand on those of the scale below
        hits = asking[new_rows.occupied & (new_rows.scale >= scale)]
        lattices.append((level_of(scale), grid.fine_m / 2**scale, hits, _FINE_REACH))
    for level, spacing, asked, within in lattices:
        there = present.kernels.hinge_mean[present.level == level]
        nodes = new_nodes(asked, there, spacing, within=within, planar=planar)
        same_scale = from_atoms.take(_is_fine(from_atoms, grid) == (level != COARSE))
        if len(same_scale) and len(nodes):
            nodes = nodes[activation(same_scale, nodes, threads=threads) < _EXPLAINED]
        parts.append(MapKernels.new(kernels_at(nodes, spacing, PRIOR_VAR), level))
    added = MapKernels.concatenate(parts)
    added = added.take(
        _fits_budget(present.kernels.hinge_mean, added.kernels.hinge_mean, grid, options.max_kernels_per_tile)
    )
    region.kernels = MapKernels.concatenate([present, added])
    return added


def _is_fine(kernels: KernelSet, grid: TileGrid) -> Bool:
    """(K,) which kernels are nearer to the fine lattice's width than to the coarse one's, by ratio."""
    return kernels.gamma > np.sqrt(gamma_of_spacing(grid.coarse_m) * gamma_of_spacing(grid.fine_m))


def _fits_budget(present: Float64, added: Float64, grid: TileGrid, limit: int) -> Bool:
    """(A,) which added kernels their tile has room for, in their order."""
    tile = np.floor(np.concatenate([present, added]) / grid.size_m).astype(np.int64)
    tile -= tile.min(axis=0, initial=0)
    size = tile.max(axis=0, initial=0) + 1
    number = np.ravel_multi_index(tuple(tile.T), tuple(size))
    order = np.argsort(number, kind="stable")
    first = np.searchsorted(number[order], number[order])
    place = np.empty(len(number), np.int64)
    place[order] = np.arange(len(number)) - first
    return place[len(present) :] < limit


def _fit_news(
    region: Region,
    lower: Float64,
    upper: Float64,
    added: MapKernels,
    options: FusionOptions,
    moment: Moment,
    threads: int,
) -> bool:
    """Solve the weights where a scan brought news, in a box, those around it held; whether the solve went well.

    Where evidence ages, all of it changes with each scan.
    """
    grid, hinge = region.grid, region.kernels.kernels.hinge_mean
    where, counts = _counted(region)
    now = due(region, where, counts, added, _SATURATION, all_of_it=moment.half_life_s > 0.0)
    free = inside_box(hinge, lower, upper) & now.around(hinge, 0)
    moved = np.concatenate([hinge[free], added.kernels.hinge_mean])
    region.still = np.ones(tuple(region.size), bool)
    region.still[tuple(np.clip(np.floor(moved / grid.size_m).astype(np.int64), 0, region.size - 1).T)] = False
    if not free.any():
        return True
    reach = 2 * grid.coarse_m  # as far as a block
    seen = inside_box(where, lower - reach, upper + reach) & now.around(where, 1) & (counts > 0.0)
    near = inside_box(hinge, lower - 2 * reach, upper + 2 * reach) & now.around(hinge, 2)
    return _solve(region, Part(where, counts, seen, near, free), options, threads)


def _fit(region: Region, lower: Float64, upper: Float64, options: FusionOptions, threads: int) -> bool:
    """Solve the weights of the kernels in a box, those around it held; whether the solve went well."""
    hinge, reach = region.kernels.kernels.hinge_mean, 2 * region.grid.coarse_m
    where, counts = _counted(region)
    seen = inside_box(where, lower - reach, upper + reach) & (counts > 0.0)
    near = inside_box(hinge, lower - 2 * reach, upper + 2 * reach)
    return _solve(region, Part(where, counts, seen, near, inside_box(hinge, lower, upper)), options, threads)


def _counted(region: Region) -> tuple[Float64, Float32]:
    """(R, 3) m, where rows stand, and (R,) what they count."""
    counts = evidence.counts(region.rows, region.cells or evidence.cells(region.rows), _SATURATION)
    counts[~evidence.is_alive(region.rows)] = 0.0
    return evidence.positions(region.rows, region.grid.fine_m), counts


class Part(NamedTuple):
    """What of a region is solved; rows and kernels beyond the reach of that are left out."""

    where: Float64  # (R, 3) m, of all rows
    counts: Float32  # (R,) of all rows
    seen: Bool  # (R,) which rows it is solved on
    near: Bool  # (K,) which kernels reach them
    free: Bool  # (K,) which kernels are solved, of those


def _solve(region: Region, part: Part, options: FusionOptions, threads: int) -> bool:
    grid, kernels = region.grid, region.kernels.kernels
    rows, local = np.flatnonzero(part.seen), np.flatnonzero(part.near)
    where, counts = part.where[rows], part.counts[rows]
    hinge, free = kernels.hinge_mean[local], part.free[local]
    blocks = feature_blocks(
        where,
        hinge,
        kernels.gamma[local],
        edge_m=grid.coarse_m,
        cut=FEATURE_CUT,
        bytes_a_value=1,
        threads=threads,
    )
    effort = options.effort
    per_step = blocks.n_values * (2 + 2 * effort.gradient_steps)
    cheap = _CHEAP_VALUES // max(per_step, 1)
    n_newton = int(np.clip(cheap, effort.newton_steps, effort.most_newton_steps))
    solver = Solver(n_newton, effort.gradient_steps, _LONGEST_STEP)
    if n_newton == effort.newton_steps:
        solver = solver._replace(enough=effort.enough)
    prior = Prior(
        region.kernels.prior_mean[local],
        region.kernels.prior_var[local],
        region.lean_at(where, threads),
    )
    fit = warm_fit(
        blocks, evidence.LABELS[region.rows.sort[rows]], counts, prior, kernels.weight_mean[local],
        solver, free=free, threads=threads,
    )  # fmt: skip
    if not (np.isfinite(fit.weights).all() and np.isfinite(fit.var).all()):
        raise SolverError(f"the weights of {len(local)} kernels on {len(rows)} rows came out NaN or infinite")
    mean, var = kernels.weight_mean.copy(), kernels.weight_var.copy()
    solved = local[free]
    scale = scale_of(region.kernels.level[local])
    support = support_of(blocks, region.rows.kind[rows], counts, threads, scale)
    mean[solved] = fit.weights[free]
    var[solved] = support.variance(region.kernels.prior_var[local])[free]
    keep = np.ones(len(kernels), bool)
    keep[local[free & (fit.support < _UNSUPPORTED)]] = False
    region.kernels = MapKernels(
        kernels=kernels.replace(weight_mean=mean, weight_var=var),
        level=region.kernels.level,
        prior_mean=region.kernels.prior_mean,
        prior_var=region.kernels.prior_var,
    ).take(keep)
    return fit.converged
