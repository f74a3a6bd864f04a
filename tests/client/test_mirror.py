"""The client's copy of a map: what it takes over, what it refuses, and that it is never half of something."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

import msgspec
import numpy as np
import pytest

from potclient.errors import BadReplyError, IncompleteReplyError, UsageError
from potclient.mirror import MapMirror
from potschemas.messages import MAX_PART_KERNELS, DType, Packed, TilesPart, TilesQuery
from potschemas.wire import pack_array
from potserver.asking.tile_codes import TileMemory
from potserver.domain.map_state import MapState
from potserver.domain.types import KernelSet
from tests.tiled_maps import asking, free_kernels, lattice_kernels, parts_about, tiled_state

Tiles = dict[tuple[int, int, int], tuple[KernelSet, int]]
TILES: Tiles = {
    (0, 0, 0): (lattice_kernels(300), 1),
    (1, 0, 0): (free_kernels(40), 1),
    (0, -1, 0): (lattice_kernels(9), 1),
}
POINTS = np.random.default_rng(0).uniform([-2, -10, -1], [18, 10, 9], (500, 3))


class Map:
    """A map that tests change; `mirror` asks about it."""

    def __init__(self, tiles: Tiles) -> None:
        self.tiles, self.epoch, self.revision = dict(tiles), 7, 1
        self.queries: list[TilesQuery] = []
        self.mirror = self.make_mirror()

    @property
    def state(self) -> MapState:
        return tiled_state(self.tiles, epoch=self.epoch, revision=self.revision)

    def make_mirror(self, *box: list[float], part_kernels: int = 20_000, **options: Any) -> MapMirror:
        answer = asking(lambda: self.state, part_kernels=part_kernels)

        def ask(query: TilesQuery) -> Any:
            self.queries.append(query)
            return answer(query)

        return MapMirror(ask, *box, **options)

    def put(self, index: tuple[int, int, int], kernels: KernelSet) -> None:
        self.revision += 1
        self.tiles[index] = (kernels, self.revision)

    def assert_mirrored(self, mirror: MapMirror | None = None) -> None:
        mirror = mirror or self.mirror
        says, expected = mirror.occupancy(POINTS), self.state.snapshot.occupancy(POINTS)
        assert mirror.revision == says.revision == self.revision
        np.testing.assert_allclose(says.mean, expected.mean, atol=1e-4)
        np.testing.assert_array_equal(says.observed, expected.observed)


@pytest.fixture
def map_() -> Map:
    return Map(TILES)


def test_an_empty_mirror_says_so(map_: Map) -> None:
    assert (map_.mirror.revision, map_.mirror.n_tiles) == (None, 0)
    with pytest.raises(UsageError, match="update"):
        map_.mirror.occupancy(POINTS)


def test_the_first_update_brings_all_and_the_next_ones_what_changed(map_: Map) -> None:
    first = map_.mirror.update()
    assert (first.is_whole, first.n_tiles, first.n_removed, first.revision) == (True, 3, 0, 1)
    assert first.n_kernels == len(map_.mirror.kernels) == sum(len(kernels) for kernels, _ in TILES.values())
    map_.assert_mirrored()

    still = map_.mirror.update()
    assert still.is_empty
    assert (still.is_whole, still.n_kernels) == (False, 0)
    assert still.n_bytes < 1000 < first.n_bytes

    map_.put((1, 0, 0), free_kernels(50, seed=5))
    map_.put((2, 0, 0), lattice_kernels(80, seed=6))
    del map_.tiles[(0, -1, 0)]
    changed = map_.mirror.update()
    assert (changed.is_whole, changed.n_tiles, changed.n_removed) == (False, 2, 1)
    assert changed.n_kernels == len(map_.tiles[(1, 0, 0)][0]) + len(map_.tiles[(2, 0, 0)][0])
    assert map_.mirror.n_tiles == 3
    map_.assert_mirrored()


def test_an_emptied_map_is_mirrored_too(map_: Map) -> None:
    map_.mirror.update()
    map_.tiles.clear()
    map_.revision += 1
    assert map_.mirror.update().n_removed == 3
    assert len(map_.mirror.kernels) == 0
    assert not map_.mirror.occupancy(POINTS).observed.any()


def test_in_another_epoch_everything_comes_anew(map_: Map) -> None:
    map_.mirror.update()
    map_.epoch, map_.tiles = 8, {(0, 0, 0): (free_kernels(20), 1), (4, 0, 0): (free_kernels(30), 1)}
    update = map_.mirror.update()
    assert (update.is_whole, update.epoch, update.n_tiles, update.n_removed) == (True, 8, 2, 2)
    map_.assert_mirrored()
    assert map_.mirror.update().is_empty


@pytest.mark.parametrize("part_kernels", [1, 13, 200])
def test_tiles_that_go_on_from_part_to_part_are_put_together(map_: Map, part_kernels: int) -> None:
    mirror, whole = map_.make_mirror(part_kernels=part_kernels), map_.mirror
    assert mirror.update().n_tiles == 3
    whole.update()
    for name in ("hinge_mean", "weight_mean", "gamma_rate"):
        np.testing.assert_array_equal(getattr(mirror.kernels, name), getattr(whole.kernels, name))


def test_parts_may_come_in_any_order(map_: Map) -> None:
    mirror = MapMirror(asking(lambda: map_.state, part_kernels=50, spoil=lambda parts: parts[::-1]))
    mirror.update()
    map_.assert_mirrored(mirror)


def test_a_box_and_the_step_are_asked_for(map_: Map) -> None:
    mirror = map_.make_mirror([8.5, 0.5, 0.5], [9.0, 1.0, 1.0], step=0.25)
    assert mirror.update().n_tiles == 1
    mirror.update()
    first, second = map_.queries
    assert (first.lower, first.upper, first.step, first.known) == (
        [8.5, 0.5, 0.5],
        [9.0, 1.0, 1.0],
        0.25,
        None,
    )
    assert second.epoch == map_.epoch
    assert second.known is not None
    assert second.known.shape == [4, 1]


# --- weights in steps ----------------------------------------------------------------------------------------------


def test_what_has_changed_of_a_tile_is_told_in_few_bytes(map_: Map) -> None:
    kernels = lattice_kernels(2000, seed=3)
    map_.put((0, 0, 0), kernels)
    mirror = map_.make_mirror(step=0.0625)
    whole = mirror.update()
    map_.put((0, 0, 0), kernels.take(slice(3, None)))
    fewer = mirror.update()
    assert fewer.n_bytes < 0.3 * whole.n_bytes
    assert len(mirror.kernels) == sum(len(kernels) for kernels, _ in map_.tiles.values())
    held = np.sort(np.rint(lattice_kernels(2000, seed=3).weight_mean[3:] / 0.0625) * 0.0625)
    here = mirror.kernels
    inside = ((here.hinge_mean > 0) & (here.hinge_mean < 8)).all(axis=1)
    np.testing.assert_array_equal(np.sort(here.weight_mean[inside]), held)


def test_of_a_tile_that_the_server_has_forgotten_all_comes(map_: Map) -> None:
    mirror = MapMirror(asking(lambda: map_.state, memory=TileMemory(0)), step=0.0625)
    mirror.update()
    map_.put((0, 0, 0), lattice_kernels(300))
    assert mirror.update().n_kernels == len(map_.tiles[(0, 0, 0)][0])
    assert len(mirror.kernels) == sum(len(kernels) for kernels, _ in map_.tiles.values())


def test_weights_that_no_data_touched_stay_what_they_are() -> None:
    kernels = lattice_kernels(50)
    untouched = kernels.replace(weight_var=np.full(len(kernels), 100.0, np.float32))
    mirror = MapMirror(asking(lambda: tiled_state({(0, 0, 0): (untouched, 1)})), step=0.3)
    mirror.update()
    assert (mirror.kernels.weight_var == 100.0).all()


# --- what is refused -----------------------------------------------------------------------------------------------

Spoil = Callable[[list[TilesPart]], Iterable[TilesPart]]


def changed(**fields: Any) -> Spoil:
    """The last part with other fields; those of its kernels as `kernels__name`."""

    def spoil(parts: list[TilesPart]) -> list[TilesPart]:
        last = parts[-1]
        inner = {name[9:]: value for name, value in fields.items() if name.startswith("kernels__")}
        outer = {name: value for name, value in fields.items() if not name.startswith("kernels__")}
        kernels = msgspec.structs.replace(last.kernels, **inner)
        return [*parts[:-1], msgspec.structs.replace(last, kernels=kernels, **outer)]

    return spoil


def i8(values: Any) -> Packed:
    return pack_array(np.array(values, np.int64))


def doubled(parts: list[TilesPart]) -> list[TilesPart]:
    """The same tile in two parts, but not one after the other."""
    return [msgspec.structs.replace(parts[0], part=i, n_parts=2) for i in range(2)]


N = sum(len(kernels) for kernels, _ in TILES.values())
TRUNCATED = Packed(dtype=DType.FLOAT32, shape=[N], deflated=pack_array(np.ones(N, np.float32)).deflated[:-5])
BOMB = Packed(
    dtype=DType.FLOAT32,
    shape=[MAX_PART_KERNELS + 1],
    deflated=pack_array(np.zeros(MAX_PART_KERNELS + 1, np.float32)).deflated,
)


@pytest.mark.parametrize(
    ("spoil", "error"),
    [
        (lambda parts: [], IncompleteReplyError),
        (changed(n_parts=2), IncompleteReplyError),
        (changed(n_parts=2**62), IncompleteReplyError),
        (changed(part=1), IncompleteReplyError),
        (changed(part=2**62, n_parts=2**63 - 1), IncompleteReplyError),
        (lambda parts: parts * 2, IncompleteReplyError),
        (doubled, BadReplyError),
        (changed(whole=False), BadReplyError),
        (changed(tile_size_m=1e308, tiles=i8([[-9, 0, 9], [0, 0, 0], [0, 0, 0], [1, 1, 1]])), BadReplyError),
        (changed(gone=i8([[0], [0], [0]])), BadReplyError),
        (changed(counts=i8([N])), BadReplyError),
        (changed(counts=i8([N - 1, 1, 1])), BadReplyError),
        (changed(counts=i8([N, 0, 0])), BadReplyError),
        (changed(counts=i8([N + 1, -1, 0])), BadReplyError),
        (changed(tiles=i8(np.zeros((4, 3)))), BadReplyError),
        (changed(tiles=i8(np.zeros((3, 3)))), BadReplyError),
        (changed(kernels__kind=i8(np.full(N, 99))), BadReplyError),
        (changed(kernels__kind=i8(np.full(N, -1))), BadReplyError),
        (changed(kernels__kind=None), BadReplyError),
        (changed(kernels__cells=i8(np.zeros((3, 1)))), BadReplyError),
        (changed(kernels__hinge_mean=pack_array(np.zeros((3, 1), np.float32))), BadReplyError),
        (changed(kernels__kinds=pack_array(np.zeros((5, 0), np.float32))), BadReplyError),
        (changed(kernels__lattices=pack_array(np.zeros((4, 1)))), BadReplyError),
        (changed(kernels__weight_var=TRUNCATED), BadReplyError),
        (changed(kernels__weight_var=pack_array(np.full(N, np.nan, np.float32))), BadReplyError),
        (changed(kernels__weight_var=pack_array(np.ones(N))), BadReplyError),
        (changed(kernels__weight_mean=BOMB), BadReplyError),
    ],
)
def test_a_reply_that_does_not_fit_is_refused_and_changes_nothing(
    map_: Map, spoil: Spoil, error: type[Exception]
) -> None:
    is_spoilt = False

    def maybe(parts: list[TilesPart]) -> Iterable[TilesPart]:
        return spoil(parts) if is_spoilt else parts

    mirror = MapMirror(asking(lambda: map_.state, spoil=maybe))
    mirror.update()
    kernels = mirror.kernels
    map_.epoch = 8  # the next reply is whole again
    is_spoilt = True
    with pytest.raises(error, match="tiles"):
        mirror.update()
    assert mirror.kernels is kernels
    is_spoilt = False
    assert mirror.update().is_whole
    map_.assert_mirrored(mirror)


def packed_i8(*values: int) -> Packed:
    return pack_array(np.array(values, np.int64))


def of_lattice(**fields: Any) -> Spoil:
    """The first lattice with other fields."""

    def spoil(parts: list[TilesPart]) -> list[TilesPart]:
        (part,) = parts
        lattices = [msgspec.structs.replace(part.changes.lattices[0], **fields), *part.changes.lattices[1:]]
        return [
            msgspec.structs.replace(part, changes=msgspec.structs.replace(part.changes, lattices=lattices))
        ]

    return spoil


def lattice_twice(parts: list[TilesPart]) -> list[TilesPart]:
    changes = parts[0].changes
    twice = msgspec.structs.replace(changes, lattices=[*changes.lattices, *changes.lattices])
    return [msgspec.structs.replace(parts[0], changes=twice)]


def of_what_is_not_held(parts: list[TilesPart]) -> list[TilesPart]:
    based = pack_array(np.ones(3, np.bool_))
    return [msgspec.structs.replace(parts[0], changes=msgspec.structs.replace(parts[0].changes, based=based))]


@pytest.mark.parametrize(
    "spoil",
    [
        of_lattice(toggled=packed_i8(0)),
        of_lattice(toggled=packed_i8(1, -1)),
        of_lattice(toggled=packed_i8(2**62, 2**62, 2**62)),
        of_lattice(toggled=packed_i8(1)),
        of_lattice(tiles=packed_i8(99)),
        of_lattice(tiles=packed_i8(1, 0)),
        of_lattice(cells=[2**40, 2**40, 2**40]),
        of_lattice(new_means=packed_i8(1)),
        of_lattice(mean_changes=packed_i8(1)),
        of_lattice(shape=pack_array(np.zeros(5, np.float32))),
        of_lattice(spacing=1e308),
        lattice_twice,
        of_what_is_not_held,
    ],
)
def test_changes_that_do_not_fit_are_refused_and_change_nothing(map_: Map, spoil: Spoil) -> None:
    mirror = MapMirror(asking(lambda: map_.state, spoil=spoil), step=0.0625)
    with pytest.raises(BadReplyError, match="tiles"):
        mirror.update()
    assert mirror.revision is None


def test_zero_widths_are_refused(map_: Map) -> None:
    (part,) = parts_about(map_.state, TilesQuery())
    n_kinds = part.kernels.kinds.shape[1]
    spoil = changed(kernels__kinds=pack_array(np.zeros((5, n_kinds), np.float32)))
    with pytest.raises(BadReplyError, match="not positive"):
        MapMirror(asking(lambda: map_.state, spoil=spoil)).update()


def test_a_rule_that_is_none_is_refused(map_: Map) -> None:
    mirror = MapMirror(asking(lambda: map_.state, spoil=changed(residual_var=-1.0)))
    with pytest.raises(BadReplyError, match="residual_var"):
        mirror.update()
    assert mirror.revision is None


@pytest.mark.parametrize("name", ["epoch", "map_revision", "tile_size_m", "prior_var"])
def test_parts_that_disagree_are_of_two_servers(map_: Map, name: str) -> None:
    def spoil(parts: list[TilesPart]) -> Iterable[TilesPart]:
        return [parts[0], *(msgspec.structs.replace(part, **{name: 99}) for part in parts[1:])]

    mirror = MapMirror(asking(lambda: map_.state, part_kernels=100, spoil=spoil))
    with pytest.raises(IncompleteReplyError, match="two servers"):
        mirror.update()
    assert mirror.revision is None


def test_those_who_ask_meanwhile_see_one_revision_or_the_next() -> None:
    """All tiles of a revision have its number as their weights."""

    def numbered(revision: int) -> Tiles:
        k = lattice_kernels(50)
        of_revision = k.replace(weight_mean=np.full(len(k), revision, np.float32))
        return {(x, 0, 0): (of_revision, revision) for x in range(6)}

    map_ = Map(numbered(1))
    map_.mirror.update()
    stop, mixed = threading.Event(), []

    def look() -> None:
        while not stop.is_set():
            kernels = map_.mirror.kernels
            mixed.append(set(kernels.weight_mean.tolist()) != {kernels.map_revision})

    thread = threading.Thread(target=look)
    thread.start()
    try:
        for revision in range(2, 30):
            map_.tiles, map_.revision = numbered(revision), revision
            map_.mirror.update()
    finally:
        stop.set()
        thread.join()
    assert mixed
    assert not any(mixed)
