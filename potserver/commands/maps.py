"""`potserver map info | export | import | merge`: kept maps without a server."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient import UsageError, results
from potclient.commands import export_flags, pose_flag
from potclient.kernels import KernelSet as ClientKernels
from potclient.octomap import DEPTH, KEY_ORIGIN, Leaves, read_bt
from potschemas import messages, wire
from potserver.adapters import codec
from potserver.asking.service import GridPlan
from potserver.config import Settings
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.types import KernelSet
from potserver.errors import MapFileError, SettingsError
from potserver.limits import Limits
from potserver.mapping.imports import state_of_kernels, state_of_places
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.storage.journal import scans_after
from potserver.storage.map_file import FORMAT, Origin, SavedMap, describe, read_map, write_map
from potserver.storage.map_store import JOURNAL, SAVED, TILES

Say = Callable[[str], None]

# What an OctoMap's own limits stand for: that many hits make a voxel as occupied as it can get, ln(.971 / .029) / ln(.7 / .3),
# and that many misses as free, ln(.881 / .119) / ln(.6 / .4). A binary file says only on which side of 0.5 a voxel is.
_OCCUPIED_LOOKS = 4.1
_FREE_LOOKS = 4.9
# A scan spreads a beam's free evidence, one look in all, over its whole way, so a voxel of free space gets but a part of it.
# Chosen on two OctoMaps, of rooms and of an office: 99 % of the occupied space and 96 and 89 % of the free come back as they
# were; with 1/10 it was 100, 94 and 85 %, with all of it 97, 97 and 92 %.
_FREE_SHARE = 1.0 / 3.0
_FINEST_M = 0.2
_MAX_PLACES = 20_000_000


def run(options: argparse.Namespace, settings: Settings, say: Say) -> int:
    """Carry out one of the commands.

    Args:
        options: The flags; `options.map_command` says which one.
        settings: Of the maps that are made.
        say: Prints a line.
    Raises:
        MapFileError, SettingsError, StorageError: the file, the flags, or the disk.
    """
    commands = {"info": _info, "export": _export, "import": _import, "merge": _merge}
    try:
        return commands[options.map_command](options, settings, say)
    except UsageError as error:
        raise SettingsError(str(error)) from error


# --- info -------------------------------------------------------------------------------------------------------------


def _info(options: argparse.Namespace, _settings: Settings, say: Say) -> int:
    found = [_described(path) for path in _map_files(options.path)]
    if options.json:
        say(json.dumps(found, indent=2))
        return 0
    for number, each in enumerate(found):
        if number:
            say("")
        width = max(map(len, each))
        for key, value in each.items():
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            say(f"{key.ljust(width)}  {text}")
    return 0


def _map_files(path: Path) -> list[Path]:
    """The map files that a path means.

    Raises:
        MapFileError: there are none.
    """
    if not path.is_dir():
        return [path]
    found = [path / TILES] if (path / TILES).exists() else sorted(path.glob(f"*/{TILES}"))
    found += sorted(path.glob("*.map")) + sorted(path.glob(f"{SAVED}/*.map"))
    if not found:
        raise MapFileError(f"no map in {path}: neither {TILES} nor *.map", reason="missing")
    return found


def _described(path: Path) -> dict[str, Any]:
    saved = read_map(path)
    r, table = saved.record, describe(saved, path)
    n_tiles = 0 if saved.tiled is None else len(saved.tiled.tiles)
    lines: dict[str, Any] = {
        "file": str(path),
        "map": r.map_id,
        "format": FORMAT,
        "written": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(r.written_ns / 1e9)),
        "by": f"potserver {r.written_by}",
        "scans": r.n_scans,
        "revision": r.revision,
        "robots": r.robots,
        "tiles": n_tiles,
        "kernels": table.n_kernels,
        "rows": table.n_rows,
        "bytes": _bytes_on_disk(path),
        "bytes of tiles": table.n_bytes,
    }
    if r.grid is not None:
        lines |= {"tile m": r.grid[0], "resolution m": round(r.grid[1], 6)}
    if not r.keeps_evidence:
        lines["evidence"] = "none: a map of profile paper, or of kernels alone"
    if path.name == TILES:
        lines["scans in the journal"] = scans_after(path.with_name(JOURNAL), r.number)
    return lines


def _bytes_on_disk(path: Path) -> int:
    """Of a file and of what SQLite keeps beside it until it is copied in: a store's newest tiles may be there alone."""
    log = path.with_name(f"{path.name}-wal")
    return path.stat().st_size + (log.stat().st_size if log.exists() else 0)


# --- export -----------------------------------------------------------------------------------------------------------


class UnservedMap:
    """A saved map that answers like a `MapClient`, as far as exports ask."""

    def __init__(self, saved: SavedMap) -> None:
        self._record = saved.record
        self._parts = [] if saved.tiled is None else [part.kernels for part in saved.tiled.parts.values()]
        indexed = [] if saved.tiled is None else list(saved.tiled.parts.values())
        self._map = KernelMap(
            indexed, **saved.record.answer_rule._asdict(), map_revision=saved.record.revision
        )

    def info(self) -> messages.Info:
        """What the map is."""
        r = self._record
        encoded = codec.encode_info(
            server_id="unserved",
            version=r.written_by,
            map_id=r.map_id,
            maps=[r.map_id],
            profile="default" if r.keeps_evidence else "paper",
            snapshot=self._map,
            n_atoms=0,
            n_scans=r.n_scans,
            tile_size_m=r.grid[0] if r.grid else MappingSettings().tile_size_m,
            max_range_m=0.0,
            limits=Limits(),
            started_ns=r.written_ns,
            durable=True,
        )
        return wire.decode(encoded.payload, messages.Info)

    def params_parts(
        self, lower: ArrayLike | None = None, upper: ArrayLike | None = None
    ) -> Iterator[tuple[int, int, ClientKernels]]:
        """Kernels, part by part; those in a box (m, map frame) if there is one."""
        low = np.full(3, -np.inf) if lower is None else np.asarray(lower, np.float64)
        high = np.full(3, np.inf) if upper is None else np.asarray(upper, np.float64)
        for number, kernels in enumerate(self._parts):
            hinge = kernels.hinge_mean
            inside = np.flatnonzero(((hinge >= low) & (hinge <= high)).all(axis=1))
            message = codec.encode_kernels(kernels.take(inside), self._map.rule)
            yield (
                number,
                len(self._parts),
                ClientKernels.from_message(message, map_revision=self._map.map_revision),
            )

    def grid(self, lower: ArrayLike, upper: ArrayLike, resolution: float) -> results.Grid:
        """Occupancy at the cell centres of a box, m, map frame."""
        low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        nx, ny, nz = (int(n) for n in np.ceil((high - low) / resolution - 1e-6))
        plan = GridPlan(self._map, low, resolution, (nx, ny, nz), part_cells=nx * ny * nz)
        _, o = plan.part(0)

        def cells(array: NDArray[Any]) -> NDArray[np.float32]:
            return array.astype(np.float32).reshape(nx, ny, nz)

        return results.Grid(
            lower=low,
            resolution=resolution,
            mean=cells(o.mean),
            var=cells(o.var),
            latent_mean=cells(o.latent_mean),
            latent_var=cells(o.latent_var),
            observed=o.observed.reshape(nx, ny, nz),
            revision=self._map.map_revision,
        )


def _export(options: argparse.Namespace, _settings: Settings, _say: Say) -> int:
    export_flags.check_export_flags(options)
    return export_flags.export_map(UnservedMap(read_map(_one_file(options.path))), options)


# --- import -----------------------------------------------------------------------------------------------------------


class Places(NamedTuple):
    """What an OctoMap knows, as samples."""

    points: NDArray[np.float64]  # (N, 3) m
    occupied: NDArray[np.bool_]  # (N,)
    weight: NDArray[np.float32]  # (N,) looks


def _import(options: argparse.Namespace, settings: Settings, say: Say) -> int:
    path: Path = options.path
    if path.suffix == ".bt":
        state, keeps_evidence = _from_octomap(path, options.looks, settings, say), True
        stamps: dict[str, int] = {}
        map_id = settings.maps[0]
    elif path.suffix == ".npz":
        state, keeps_evidence = _from_kernels(path, settings), False
        stamps, map_id = {}, settings.maps[0]
    else:
        file = _one_file(path)
        saved = read_map(file)
        state, keeps_evidence = _with_rule(saved), saved.record.keeps_evidence
        stamps, map_id = saved.record.stamps, saved.record.map_id
        left = scans_after(file.with_name(JOURNAL), saved.record.number) if file.name == TILES else 0
        if left:
            say(f"{left} scans of the journal are not in it: only a server integrates them")
    n_bytes = write_map(options.out, state, Origin(map_id, keeps_evidence, stamps))
    say(f"wrote {options.out}: {len(state.snapshot)} kernels, {n_bytes} bytes")
    return 0


def _with_rule(saved: SavedMap) -> MapState:
    """The state whose snapshot answers as the saved one did."""
    parts = [] if saved.tiled is None else list(saved.tiled.parts.values())
    state = saved.state()
    snapshot = KernelMap(parts, **saved.record.answer_rule._asdict(), map_revision=saved.record.revision)
    return dataclasses.replace(state, snapshot=snapshot)


def _from_octomap(path: Path, looks: float, settings: Settings, say: Say) -> MapState:
    leaves, resolution = _read(lambda: read_bt(path), path)
    fine_m = settings.mapping.fine_m or max(resolution, _FINEST_M)
    places = places_of(leaves, resolution, fine_m, looks)
    say(
        f"{len(leaves.depth)} voxels of {resolution:g} m, {int(leaves.occupied.sum())} occupied:"
        f" {len(places.points)} samples at a resolution of {fine_m:g} m"
    )
    service = MappingService(AtomDictionary(()), settings.mapping, threads=settings.threads)
    robot = re.sub(r"[^a-z0-9_.-]", "-", path.stem.lower()).lstrip("_.-")[:63] or "octomap"
    return state_of_places(service, *places, source=robot, fine_m=fine_m)


def places_of(leaves: Leaves, resolution: float, fine_m: float, looks: float = 1.0) -> Places:
    """Samples that say what voxels say.

    A voxel larger than the resolution wanted gives one sample for each of its parts of that size; the samples of those that are
    smaller meet in the map's own voxels, where they share what one of them would weigh.

    Args:
        leaves: Of an OctoMap.
        resolution: m, edge of its finest voxel.
        fine_m: m, resolution of the map to be.
        looks: How much the voxels count, in what OctoMap itself could have counted.
    Raises:
        SettingsError: too many samples, or a weight that is not positive.
    """
    if not 0.0 < looks < np.inf:
        raise SettingsError(f"--looks {looks}: need a positive number")
    spans = 2 ** (DEPTH - leaves.depth)  # finest voxels along the edge
    per_edge = np.maximum(1, np.round(spans * resolution / fine_m)).astype(np.int64)
    total = int((per_edge**3).sum())
    if total > _MAX_PLACES:
        raise SettingsError(
            f"its voxels make {total} samples, the limit is {_MAX_PLACES}: take a coarser map, --set mapping.fine_m=METRES"
        )
    points, occupied, weight = [], [], []
    for n in np.unique(per_edge):
        members = np.flatnonzero(per_edge == n)
        steps = (np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / n
        corner = (leaves.keys[members] - KEY_ORIGIN)[:, None, :].astype(np.float64)
        where = (corner + steps[None] * spans[members, None, None]) * resolution
        points.append(where.reshape(-1, 3))
        state = np.repeat(leaves.occupied[members], n**3)
        occupied.append(state)
        edge = np.repeat(spans[members] * resolution / n, n**3)
        # what a voxel of the map gets in all, whatever the size of the samples in it: hits are kept in half voxels
        hits = _OCCUPIED_LOOKS * np.minimum(1.0, (edge / (0.5 * fine_m)) ** 2)
        free = _FREE_LOOKS * _FREE_SHARE * np.minimum(1.0, (edge / fine_m) ** 3)
        weight.append(looks * np.where(state, hits, free))
    return Places(
        np.concatenate([np.zeros((0, 3)), *points]),
        np.concatenate([np.zeros(0, bool), *occupied]),
        np.concatenate([np.zeros(0), *weight]).astype(np.float32),
    )


def _from_kernels(path: Path, settings: Settings) -> MapState:
    kernels = _read(lambda: ClientKernels.load(path), path)
    rule = {
        "observed_activation": kernels.observed_activation,
        "prior_var": kernels.prior_var,
        "residual_var": kernels.residual_var,
        "mean_moderation": kernels.mean_moderation,
    }
    mapping = dataclasses.replace(settings.mapping, refine=False, calibrate=False, **rule)
    service = MappingService(AtomDictionary(()), mapping, threads=settings.threads)
    arrays = {f.name: getattr(kernels, f.name) for f in dataclasses.fields(KernelSet)}
    return state_of_kernels(service, KernelSet(**arrays))


def _read(read: Callable[[], Any], path: Path) -> Any:
    try:
        return read()
    except OSError as error:
        raise MapFileError(f"cannot read {path}: {error.strerror or error}", reason="missing") from error


# --- merge ------------------------------------------------------------------------------------------------------------


def _merge(options: argparse.Namespace, settings: Settings, say: Say) -> int:
    ours, theirs = (read_map(_one_file(path)) for path in (options.path, options.other))
    if ours.record.keeps_evidence != theirs.record.keeps_evidence:
        raise MapFileError(
            "one map keeps evidence and the other kernels alone: they cannot be merged", reason="settings"
        )
    size_m = ours.record.grid[0] if ours.record.grid else settings.mapping.tile_size_m
    mapping = dataclasses.replace(settings.mapping, tile_size_m=size_m)
    service = MappingService(AtomDictionary(()), mapping, threads=settings.threads)
    service.restore(ours.state())
    say(f"merging {theirs.record.n_scans} scans into {ours.record.n_scans}: some seconds for a street")
    change = service.merge(theirs.state(), pose_flag.pose_of(*options.pose) if options.pose else np.eye(4))
    stamps = dict(ours.record.stamps)
    for robot_id, stamp_ns in theirs.record.stamps.items():
        stamps[robot_id] = max(stamp_ns, stamps.get(robot_id, 0))
    n_bytes = write_map(
        options.out, service.state, Origin(ours.record.map_id, ours.record.keeps_evidence, stamps)
    )
    say(
        f"wrote {options.out}: {len(service.snapshot)} kernels, {len(change.tiles)} tiles changed, {n_bytes} bytes"
    )
    return 0


def _one_file(path: Path) -> Path:
    (file, *others) = _map_files(path)
    if others:
        raise SettingsError(f"{path} holds several maps; name one: {', '.join(map(str, [file, *others]))}")
    return file
