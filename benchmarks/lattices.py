"""What questions cost when kernels on lattices are asked as bricks of nodes, beside an index that looks for each kernel.

    python benchmarks/lattices.py [DATASET] [--every 3] [--kernels 100000 1000000] [--threads 2] [--rounds 7] [--json FILE]

The map is that of a dataset's scans, or made-up streets of so many kernels. Both ways are asked in turn in one process. Times
are of the processor, all threads together, because other work on the machine moves them least; the clock's are in the file.
"""

from __future__ import annotations

import argparse
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.shared import keep, parser_of
from potclient.datasets import open_dataset
from potserver.asking.grid import Grid
from potserver.asking.rays import Rays
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_part import MapPart
from potserver.domain.tiles import COARSE, FINE, MapKernels, Tile, TiledMap, TileGrid
from potserver.domain.types import KernelSet, Scan
from potserver.limits import Limits
from potserver.mapping.pipeline import DEFAULT_RULE
from potserver.mapping.placing import kernels_at
from potserver.mapping.service import MappingService
from potserver.numerics.evidence import Rows
from potserver.numerics.threads import default_threads

_LIMITS = Limits()
_STREET_M, _HIGH_M = 40.0, 6.0
_GRID = TileGrid.of(10.0, 0.4)
_RANGE_M = 25.0


class Work(NamedTuple):
    """A kind of question, and how many items it asks about."""

    name: str
    n: int
    ask: Callable[[KernelMap], Any]


def main() -> int:
    options = _options()
    found: dict[str, Any] = {
        "machine": _machine(),
        "commit": _commit(),
        "threads": options.threads,
        "maps": {},
    }
    for name, tiled in _maps(options):
        found["maps"][name] = _compare(name, tiled, options)
    keep(options, found)
    return 0


def _options() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument("dataset", metavar="DATASET", nargs="?")
    parser.add_argument("--every", type=int, default=3, help="take every so many scans [3]")
    parser.add_argument("--kernels", type=int, nargs="*", default=[], metavar="K", help="of made-up streets")
    parser.add_argument("--threads", type=int, default=default_threads(), metavar="N")
    parser.add_argument("--rounds", type=int, default=7, metavar="N")
    return parser.parse_args()


def _maps(options: argparse.Namespace) -> Iterator[tuple[str, TiledMap]]:
    if options.dataset:
        yield options.dataset, _map_of(options.dataset, options.every)
    for n in options.kernels or ([] if options.dataset else [100_000]):
        yield f"streets of {n:,} kernels", _streets(n)


def _map_of(dataset: str, every: int) -> TiledMap:
    service = MappingService(AtomDictionary([]))
    recording = open_dataset(dataset, max_range_m=_RANGE_M)
    for k in range(0, len(recording), every):
        scan = recording[k]
        service.integrate(Scan(points=scan.points, T_map_sensor=scan.T_map_sensor, is_return=scan.is_return))
    assert service.state.tiled is not None
    return service.state.tiled


def _streets(n: int) -> TiledMap:
    """A street along x: coarse nodes everywhere in it, fine ones on the ground and on the fronts of houses."""
    per_metre = _STREET_M * _HIGH_M / _GRID.coarse_m**3 + (_STREET_M + 2 * _HIGH_M) / _GRID.fine_m**2
    rng = np.random.default_rng(0)
    members = {}
    for x in range(round(n / per_metre / _GRID.size_m)):
        for y in range(round(_STREET_M / _GRID.size_m)):
            coarse = _nodes(_GRID.coarse_m, _HIGH_M)
            fine = _nodes(_GRID.fine_m, _HIGH_M)
            front = {0: fine[:, 1] < _GRID.fine_m, 3: fine[:, 1] > _GRID.size_m - _GRID.fine_m}.get(y, False)
            fine = fine[(fine[:, 2] < _GRID.fine_m) | front]
            sets = [
                MapKernels.new(_weighed(kernels_at(hinge, spacing, 1.0), rng), level)
                for hinge, spacing, level in ((coarse, _GRID.coarse_m, COARSE), (fine, _GRID.fine_m, FINE))
            ]
            members[(x, y, 0)] = Tile(Rows.empty(), MapKernels.concatenate(sets), 1)
    return TiledMap.empty(_GRID).with_tiles(members)


def _nodes(spacing_m: float, high_m: float) -> np.ndarray:
    along, up = (np.arange(round(m / spacing_m)) for m in (_GRID.size_m, high_m))
    return (np.stack(np.meshgrid(along, along, up), axis=-1).reshape(-1, 3) + 0.5) * spacing_m


def _weighed(kernels: KernelSet, rng: np.random.Generator) -> KernelSet:
    n = len(kernels)
    weights = {"weight_mean": rng.normal(-2, 3, n), "weight_var": rng.gamma(2.0, 2.0, n)}
    return kernels.replace(**{name: values.astype(np.float32) for name, values in weights.items()})


def _compare(name: str, tiled: TiledMap, options: argparse.Namespace) -> dict[str, Any]:
    parts, threads = list(tiled.parts.values()), options.threads
    of_all = [part.kernels for part in parts]
    bricks = KernelMap(parts, rule=DEFAULT_RULE, threads=threads)
    index = KernelMap([MapPart.of(kernels) for kernels in of_all], rule=DEFAULT_RULE, threads=threads)
    some = bricks.kernels.hinge_mean[np.random.default_rng(1).integers(0, len(bricks), 20_000)]
    one, other = bricks.occupancy(some), index.occupancy(some)
    found: dict[str, Any] = {
        "kernels": len(bricks),
        "off_lattice": bricks.n_off_lattice,
        "largest_difference": float(np.abs(one.mean - other.mean).max()),
        "brick_bytes": sum(b.rows.nbytes + b.row_of.nbytes for part in parts for b in part.bricks),
    }
    print(
        f"{name}: {len(bricks):,} kernels ({bricks.n_off_lattice} on no lattice), {threads} threads, {_machine()}"
    )
    print(
        f"p differs by {found['largest_difference']:.1e} at most; {found['brick_bytes'] / len(bricks):.0f} bytes a kernel"
    )
    print(f"{'':>22} {'index, us':>24} {'bricks, us':>24} {'ratio':>6} {'M/s, clock':>10}")
    rows = {
        work.name: (work.n, lambda m=index, w=work: w.ask(m), lambda m=bricks, w=work: w.ask(m))
        for work in _works(bricks)
    }
    rows["make all, a kernel"] = (
        len(bricks),
        lambda: KernelMap([MapPart.of(kernels) for kernels in of_all], rule=DEFAULT_RULE),
        lambda: KernelMap(
            list(TiledMap.empty(tiled.grid).with_tiles(tiled.tiles).parts.values()), rule=DEFAULT_RULE
        ),
    )
    for kind, (n, slow, quick) in rows.items():
        found[kind] = _measure(kind, n, slow, quick, options.rounds)
    return found


def _works(kernels: KernelMap) -> list[Work]:
    rng = np.random.default_rng(0)
    hinge = kernels.kernels.hinge_mean
    lower, upper = hinge.min(axis=0), hinge.max(axis=0)
    middle = np.median(hinge, axis=0)
    low, high = np.maximum(lower, middle - 20.0), np.minimum(upper, middle + 20.0)

    def near(n: int) -> np.ndarray:
        return hinge[rng.integers(0, len(hinge), n)] + rng.normal(0, 0.5, (n, 3))

    directions = rng.normal(0, 1, (500, 3)) * [1.0, 1.0, 0.1]
    rays = Rays(np.tile(middle + np.array([0.0, 0.0, 1.5]), (500, 1)), directions, max_range_m=30.0)
    grid = Grid(low, high, 0.2)
    around = hinge[(np.abs(hinge - middle) < 10.0).all(axis=1)]
    few = around[rng.integers(0, len(around), 1_000)] + rng.normal(0, 0.5, (1_000, 3))
    many, steep = near(100_000), near(10_000)
    return [
        Work("1,000 points in 20 m", 1_000, lambda m: m.occupancy(few)),
        Work("100,000 all over", 100_000, lambda m: m.occupancy(many)),
        Work("10,000 gradients", 10_000, lambda m: m.occupancy_with_gradient(steep)),
        Work("500 rays of 30 m", 500, lambda m: list(rays.plan(m, _LIMITS).parts())),
        Work("cells of .2 m", grid.plan(kernels, _LIMITS).n_items, lambda m: list(grid.plan(m, _LIMITS).parts())),
    ]  # fmt: skip


def _measure(
    kind: str, n: int, slow: Callable[[], Any], quick: Callable[[], Any], rounds: int
) -> dict[str, Any]:
    """Both in turn, after a first time that is not counted; microseconds an item."""
    taken: dict[str, list[tuple[float, float]]] = {"index": [], "bricks": []}
    for k in range(rounds + 1):
        for name, work in (("index", slow), ("bricks", quick)):
            clock, processor = time.perf_counter(), time.process_time()
            work()
            if k:
                taken[name].append(
                    (1e6 * (time.process_time() - processor) / n, 1e6 * (time.perf_counter() - clock) / n)
                )
    cpu = {name: np.array(times)[:, 0] for name, times in taken.items()}
    ratio = np.median(cpu["bricks"] / cpu["index"])
    spread = {name: f"{np.median(t):.3g} [{t.min():.3g}-{t.max():.3g}]" for name, t in cpu.items()}
    clock = np.median(np.array(taken["bricks"])[:, 1])
    print(f"{kind:>22} {spread['index']:>24} {spread['bricks']:>24} {ratio:>6.3f} {1 / clock:>10.3g}")
    return {"n": n, "ratio_cpu": float(ratio), **taken}


def _machine() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0] if names else platform.processor()}"


def _commit() -> str:
    asked = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    return asked.stdout.strip() or "unknown"


if __name__ == "__main__":
    sys.exit(main())
