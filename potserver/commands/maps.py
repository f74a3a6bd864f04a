"""`potserver map`: kept maps without a server: what they hold, exported, imported, merged."""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potclient.commands import export_flags, pose_flag
from potclient.commands.output_files import file_in_new_folder
from potclient.octomap import DEPTH, KEY_ORIGIN, Leaves, read_bt
from potserver.commands import map_care
from potserver.commands.shared import (
    EXIT_OK,
    add_group,
    add_settings_flags,
    add_verb,
    file_errors,
    say,
    settings_of,
)
from potserver.errors import MapFileError, SettingsError

if TYPE_CHECKING:
    from potserver.config import Settings
    from potserver.domain.map_state import MapState
    from potserver.mapping.service import MakePipeline, MappingService
    from potserver.mapping.settings import MappingSettings
    from potserver.storage.map_file import Origin, SavedMap

_INFO = """\
What is in a saved map (*.map), in one map's folder, or in a whole store: read, checked and counted. Beside a running
server this is its last snapshot; `potclient map save` writes a newer one."""

_EXPORT = """\
Write a saved map as a file that other programs read, as `potclient export` does for a served one.

  ply, npz   kernels
  pgm        a picture of the plane and its YAML, for Nav2's map_server
  bt         a binary OctoMap"""

_EXPORT_EXAMPLES = """\
examples:
  potserver map export site.map -f ply -o kernels.ply
  potserver map export site.map -f pgm --resolution 0.05 --band 0.1 1.5 -o map.pgm"""

_IMPORT = """\
Make a *.map file. In the folder `saved/<map>` of a server's store, `potclient map load NAME` finds it.

  *.bt        a binary OctoMap: its voxels become evidence of a robot named after the file, and kernels are solved
              on it
  *.npz       kernels, as `potclient export npz` writes them. There is no evidence with them, so only servers of profile
              `paper` load them, and answer by that profile's rule
  DIR, *.map  the last snapshot of a map's folder, or a saved map, written anew"""

_IMPORT_EXAMPLES = """\
examples:
  potserver map import hall.bt -o ~/.local/state/potserver/potserver/saved/default/hall.map
  potclient map load hall"""

_MERGE = """\
Write one map that knows what two saved ones know, as if one server had been fed by both. Scans that both of them hold
would count twice. A running server takes in a saved map with `potclient map merge`."""

_MERGE_EXAMPLES = """\
examples:
  potserver map merge south.map north.map -o campus.map
  potserver map merge south.map north.map --pose 120 -35 0 40 -o campus.map
                                              north's origin lies there, turned by 40 degrees"""

_IN_USE = "a server runs on it; this is its last snapshot, `potclient map save` writes a newer one"
_ONE_MAP = "a *.map file, or a map's folder in a store"

# An OctoMap clamps its voxels. So many hits make one as occupied as it can get, ln(.971 / .029) / ln(.7 / .3), and so many
# misses as free, ln(.881 / .119) / ln(.6 / .4). A binary file says only on which side of 0.5 a voxel is.
_OCCUPIED_LOOKS = 4.1
_FREE_LOOKS = 4.9
# A scan spreads a beam's free evidence, one look in all, over its whole way: a voxel of free space gets a part of it. With this
# share an OctoMap of rooms or of an office comes back with 99 % of its occupied space, and with 96 or 89 % of its free space.
_FREE_SHARE = 1.0 / 3.0
_FINEST_M = 0.2
_MAX_PLACES = 20_000_000


def add(commands: Any) -> None:
    """Add the verb."""
    verbs = add_group(commands, "map", "see, check, upgrade, export, import and merge kept maps")

    info = add_verb(verbs, "info", _info, help="what saved maps or a store hold", description=_INFO)
    info.add_argument("path", type=Path, metavar="FILE|DIR")
    info.add_argument("--json", action="store_true", help="JSON in place of a table")

    export = add_verb(
        verbs, "export", _export, help="a saved map as a file of another program", description=_EXPORT,
        epilog=_EXPORT_EXAMPLES,
    )  # fmt: skip
    export.add_argument("path", type=Path, metavar="FILE", help=_ONE_MAP)
    export.add_argument("-f", "--format", dest="kind", choices=export_flags.EXPORT_KINDS, required=True)
    export_flags.add_export_flags(export)

    import_ = add_verb(
        verbs, "import", _import, help="a saved map of what another program, or an old store, knows", description=_IMPORT,
        epilog=_IMPORT_EXAMPLES,
    )  # fmt: skip
    import_.add_argument("path", type=Path, metavar="FILE|DIR")
    import_.add_argument(
        "--looks", type=float, default=1.0, metavar="X",
        help="bt: how much its voxels count, in what an OctoMap can count at most [1]",
    )  # fmt: skip

    merge = add_verb(
        verbs, "merge", _merge, help="one saved map of two", description=_MERGE, epilog=_MERGE_EXAMPLES
    )
    merge.add_argument("path", type=Path, metavar="FILE", help=_ONE_MAP)
    merge.add_argument("other", type=Path, metavar="OTHER", help="the one that is taken in")
    pose_flag.add_pose_flag(merge)

    map_care.add(verbs)
    for writes in (import_, merge):
        writes.add_argument(
            "-o",
            "--out",
            type=file_in_new_folder,
            required=True,
            metavar="FILE",
            help="the *.map file to write",
        )
        add_settings_flags(writes)


# --- info -------------------------------------------------------------------------------------------------------------


def _info(options: argparse.Namespace) -> int:
    found = [_described(path) for path in _map_files(options.path)]
    if options.json:
        say(json.dumps(found, indent=2))
        return EXIT_OK
    for number, each in enumerate(found):
        if number:
            say("")
        width = max(map(len, each))
        for key, value in each.items():
            text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
            say(f"{key.ljust(width)}  {text}")
    return EXIT_OK


def _map_files(path: Path) -> list[Path]:
    """The map files that a path means.

    Raises:
        MapFileError: there are none.
    """
    from potserver.storage.agreement import TILES
    from potserver.storage.map_store import SAVED

    if not path.is_dir():
        return [path]
    found = [path / TILES] if (path / TILES).exists() else sorted(path.glob(f"*/{TILES}"))
    found += sorted(path.glob("*.map")) + sorted(path.glob(f"{SAVED}/**/*.map"))
    if not found:
        raise MapFileError(f"no map in {path}: neither {TILES} nor *.map", reason="missing")
    return found


def _one_file(path: Path) -> Path:
    (file, *others) = _map_files(path)
    if others:
        raise SettingsError(f"{path} holds several maps; name one: {', '.join(map(str, [file, *others]))}")
    return file


def _described(path: Path) -> dict[str, Any]:
    from potserver.storage.agreement import JOURNAL, TILES
    from potserver.storage.journal import scans_after
    from potserver.storage.map_file import describe, read_map

    saved = read_map(path)
    r, table = saved.record, describe(saved)
    lines: dict[str, Any] = {
        "file": str(path),
        "map": r.map_id,
        "format": saved.version,
        "written": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(r.written_ns / 1e9)),
        "by": f"potserver {r.written_by}",
        "scans": r.n_scans,
        "revision": r.revision,
        "robots": [robot for robot in r.robots if robot],
        "tiles": r.n_tiles,
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
        in_journal = scans_after(path.with_name(JOURNAL), r.number)
        if in_journal is None:
            lines["in use"] = _IN_USE
        else:
            lines["scans in the journal"] = in_journal
    return lines


def _bytes_on_disk(path: Path) -> int:
    """Of a file, and of the log that SQLite keeps beside it until it is copied in: the newest tiles may be there alone."""
    log = path.with_name(f"{path.name}-wal")
    return path.stat().st_size + (log.stat().st_size if log.exists() else 0)


# --- export -----------------------------------------------------------------------------------------------------------


def _export(options: argparse.Namespace) -> int:
    from potserver.commands.unserved import UnservedMap

    export_flags.check_export_flags(options)
    saved, _ = _read_file(_one_file(options.path))
    return export_flags.export_map(UnservedMap(saved), options)


# --- import -----------------------------------------------------------------------------------------------------------


class Places(NamedTuple):
    """What an OctoMap knows, as samples."""

    points: NDArray[np.float64]  # (N, 3) m
    occupied: NDArray[np.bool_]  # (N,)
    weight: NDArray[np.float32]  # (N,) looks


def _import(options: argparse.Namespace) -> int:
    from potserver.storage.map_file import Origin, write_map

    settings, path = settings_of(options), options.path
    origin = Origin(settings.maps[0], True, {})
    if path.suffix == ".bt":
        state = _from_octomap(path, options.looks, settings)
    elif path.suffix == ".npz":
        state, origin = _from_kernels(path, settings), origin._replace(keeps_evidence=False)
    else:
        state, origin = _from_saved(_one_file(path))
    n_bytes = write_map(options.out, state, origin)
    say(f"wrote {options.out}: {len(state.snapshot)} kernels, {n_bytes} bytes")
    return EXIT_OK


def _from_saved(file: Path) -> tuple[MapState, Origin]:
    """The state in a map file, whose snapshot answers as the saved one did, and its `Origin`."""
    from potserver.storage.map_file import Origin

    saved, left = _read_file(file)
    r = saved.record
    if left:
        say(f"{left} scans of the journal are not in it: only a server integrates them")
    state = dataclasses.replace(saved.state(), snapshot=saved.kernel_map())
    return state, Origin(r.map_id, r.keeps_evidence, r.heard)


def _read_file(file: Path) -> tuple[SavedMap, int]:
    """The map in a file, and how many scans its journal has beyond it; says where a server writes both."""
    from potserver.storage.agreement import JOURNAL, TILES
    from potserver.storage.journal import scans_after
    from potserver.storage.map_file import read_map

    saved = read_map(file)
    if file.name != TILES:
        return saved, 0
    left = scans_after(file.with_name(JOURNAL), saved.record.number)
    if left is None:
        say(f"{file}: {_IN_USE}", sys.stderr)
    return saved, left or 0


def _from_octomap(path: Path, looks: float, settings: Settings) -> MapState:
    from potserver.mapping.imports import state_of_places

    with file_errors(f"read {path}"):
        leaves, resolution = read_bt(path)
    fine_m = settings.mapping.resolution_m or max(resolution, _FINEST_M)
    places = places_of(leaves, resolution, fine_m, looks)
    say(
        f"{len(leaves.depth)} voxels of {resolution:g} m, {int(leaves.occupied.sum())} occupied:"
        f" {len(places.points)} samples at a resolution of {fine_m:g} m"
    )
    robot = re.sub(r"[^a-z0-9_.-]", "-", path.stem.lower()).lstrip("_.-")[:63] or "octomap"
    service = _service(settings.mapping, settings)
    return state_of_places(service, *places, source=robot, fine_m=fine_m)


def places_of(leaves: Leaves, resolution: float, fine_m: float, looks: float = 1.0) -> Places:
    """Samples that say what voxels say.

    A voxel larger than the resolution wanted gives one sample for each of its parts of that size. Samples of smaller voxels
    meet in a voxel of the map, where they share what one sample of its size would weigh.

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
            f"its voxels make {total} samples, the limit is {_MAX_PLACES}: take a coarser map,"
            " --set mapping.resolution_m=METRES"
        )
    points, occupied, weight = [np.zeros((0, 3))], [np.zeros(0, bool)], [np.zeros(0)]
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
    return Places(np.concatenate(points), np.concatenate(occupied), np.concatenate(weight).astype(np.float32))


def _from_kernels(path: Path, settings: Settings) -> MapState:
    from potclient.kernels import KernelSet as ClientKernels
    from potserver.domain.types import KernelSet
    from potserver.mapping.imports import state_of_kernels
    from potserver.mapping.paper import PAPER, PotPipeline

    with file_errors(f"read {path}"):
        kernels = ClientKernels.load(path)
    service = _service(
        settings.mapping, settings, functools.partial(PotPipeline, method=PAPER._replace(rule=kernels.rule))
    )
    return state_of_kernels(service, KernelSet.of(kernels), kernels.lean)


def _service(
    mapping: MappingSettings, settings: Settings, make_pipeline: MakePipeline | None = None
) -> MappingService:
    """An empty map without atoms."""
    from potserver.domain.dictionary import AtomDictionary
    from potserver.mapping.service import MappingService, pipeline_of

    return MappingService(
        AtomDictionary(()), mapping, threads=settings.threads, make_pipeline=make_pipeline or pipeline_of
    )


# --- merge ------------------------------------------------------------------------------------------------------------


def _merge(options: argparse.Namespace) -> int:
    from potserver.domain.order import joined
    from potserver.domain.tiles import check_reach
    from potserver.storage.map_file import Origin, read_map, write_map

    settings = settings_of(options)
    ours, theirs = (read_map(_one_file(path)) for path in (options.path, options.other))
    if ours.record.keeps_evidence != theirs.record.keeps_evidence:
        raise MapFileError(
            "one map keeps evidence and the other kernels alone: they cannot be merged", reason="settings"
        )
    size_m = ours.record.grid[0] if ours.record.grid else settings.mapping.tile_size_m
    service = _service(dataclasses.replace(settings.mapping, tile_size_m=size_m), settings)
    service.restore(ours.state())
    pose = pose_flag.pose_of(*options.pose) if options.pose else np.eye(4)
    if (moved := theirs.state().tiled) is not None:
        check_reach(moved, pose, settings.limits.max_coordinate_m)
    say(f"merging {theirs.record.n_scans} scans into {ours.record.n_scans}: some seconds for a street")
    change = service.merge(theirs.state(), pose)
    heard = joined(ours.record.heard, theirs.record.heard)
    origin = Origin(ours.record.map_id, ours.record.keeps_evidence, heard)
    n_bytes = write_map(options.out, service.state, origin)
    say(
        f"wrote {options.out}: {len(service.snapshot)} kernels, {len(change.tiles)} tiles changed, {n_bytes} bytes"
    )
    return EXIT_OK
