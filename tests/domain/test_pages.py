"""Pages: what lies on them is the same to the bit, and their places are used again."""

from __future__ import annotations

import gc
import mmap
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from potserver.domain.pages import PageFile, Pages
from potserver.domain.tiles import TiledMap, part_of
from potserver.domain.types import Scan, yaw_pose
from potserver.errors import MapDamagedError
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.storage.tile_codec import encode_tile

SETTINGS = MappingSettings(max_range_m=12.0, beams_per_scan=300)
QUESTIONS = np.random.default_rng(7).uniform([-10, -8, -1], [250, 8, 2], (4000, 3))


def scan_at(x_m: float, seq: int) -> Scan:
    """A small room, seen from its middle."""
    rng = np.random.default_rng(seq)
    angle = rng.uniform(-np.pi, np.pi, 300)
    points = np.stack([6 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-1, 2, 300)], axis=1)
    return Scan(
        points=points.astype(np.float32), T_map_sensor=yaw_pose(x_m, 0.0, 0.0), robot_id="r1", seq=seq
    )


def bytes_of(tiled: TiledMap | None) -> dict[tuple[int, int, int], bytes]:
    assert tiled is not None
    return {index: encode_tile(index, tile) for index, tile in tiled.tiles.items()}


def test_arrays_on_pages_are_the_same_and_as_writeable_as_before(tmp_path: Path) -> None:
    file = PageFile(tmp_path)
    one, other = np.arange(5000.0), np.arange(3000, dtype=np.int16).reshape(-1, 3)[:, ::-1]
    other.flags.writeable = False
    moved = file.put([one, other])
    np.testing.assert_array_equal(moved[id(one)], one)
    np.testing.assert_array_equal(moved[id(other)], other)
    assert (moved[id(one)].flags.writeable, moved[id(other)].flags.writeable) == (True, False)
    assert list(tmp_path.iterdir()) == [], "the file has no name"
    file.close()
    np.testing.assert_array_equal(moved[id(one)], one)


def test_the_place_of_what_was_dropped_is_used_again(tmp_path: Path) -> None:
    file = PageFile(tmp_path)
    array = np.ones(100_000)
    kept = [file.put([array]) for _ in range(3)]
    in_use = file.n_bytes
    assert in_use >= 3 * array.nbytes
    for _ in range(2000):  # ten times the first segment
        file.put([array])
    gc.collect()
    assert file.n_bytes == in_use
    del kept
    gc.collect()
    assert file.n_bytes == 0
    again = file.put([array])
    np.testing.assert_array_equal(next(iter(again.values())), array)


def test_a_map_on_pages_answers_to_the_bit_and_goes_on_as_one_in_memory(tmp_path: Path) -> None:
    in_memory, paged = (MappingService(settings=SETTINGS, threads=1) for _ in range(2))
    pages = Pages(tmp_path, 1)
    for seq, x_m in enumerate((0.0, 60.0, 120.0, 180.0, 240.0, 3.0, 62.0)):
        for mapper in (in_memory, paged):
            mapper.integrate(scan_at(x_m, seq))
        before = paged.snapshot
        paged.relieve(pages)
        assert paged.snapshot is not before
        wanted = in_memory.snapshot.occupancy_with_gradient(QUESTIONS)
        for answer in (before, paged.snapshot):  # who still has the old snapshot is answered too
            got = answer.occupancy_with_gradient(QUESTIONS)
            for name in ("mean", "var", "latent_mean", "latent_var", "observed", "gradient"):
                np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))
        assert paged.snapshot.map_revision == in_memory.snapshot.map_revision
    assert bytes_of(paged.state.tiled) == bytes_of(in_memory.state.tiled)
    for mapper in (in_memory, paged):
        mapper.merge(mapper.state, yaw_pose(0.0, 40.0, 0.0))
        mapper.integrate(scan_at(10.0, 8))
        mapper.integrate(
            Scan(points=scan_at(0.0, 9).points, T_map_sensor=yaw_pose(1.0, 0.0, 0.0), robot_id="r2", seq=9)
        )
        paged.relieve(pages)
        mapper.remove_robot("r2")
    assert bytes_of(paged.state.tiled) == bytes_of(in_memory.state.tiled)


def test_the_coldest_parts_leave_memory_first(tmp_path: Path) -> None:
    mapper = MappingService(settings=SETTINGS, threads=1)
    pages = Pages(tmp_path, 10**9)
    for seq, x_m in enumerate((0.0, 120.0, 240.0, 0.0)):
        mapper.integrate(scan_at(x_m, seq))
        mapper.relieve(pages)
    assert pages.file.n_bytes == 0, "there is room for all"
    assert mapper.state.tiled is not None
    order = [number[0] for number in pages._resident]
    where = [
        part_of(mapper.state.tiled.grid.index_of(np.array([x, 0.0, 0.0])))[0] for x in (120.0, 240.0, 0.0)
    ]
    assert [x for x in order if x in where][-1] == where[-1], "what was changed last leaves last"
    assert order.index(where[0]) < order.index(where[1]) < order.index(where[2])
    before = sum(part.n_bytes for part in pages._resident.values())
    pages.max_resident_bytes = 1
    mapper.relieve(pages)
    assert pages._resident == {}
    assert before <= pages.file.n_bytes < 1.5 * before


def test_what_scans_leave_alone_goes_to_pages_though_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def use(**values: int) -> None:
        for name, value in values.items():
            monkeypatch.setattr(f"potserver.domain.pages.{name}", value)

    in_memory, mapper = (MappingService(settings=SETTINGS, threads=1) for _ in range(2))
    pages = Pages(tmp_path, 10**9)

    def drive(*places_m: float) -> set[float]:
        """Those of three places that are in memory, the parts about their middle."""
        for seq, x_m in enumerate(places_m):
            for each in (in_memory, mapper):
                each.integrate(scan_at(x_m, seq))
            mapper.relieve(pages)
        tiled = mapper.state.tiled
        assert tiled is not None
        middles = {part_of(tiled.grid.index_of(np.array([x, 0.0, 0.0]))): x for x in (0.0, 120.0, 240.0)}
        return {middles[number] for number in pages._resident if number in middles}

    use(_COLD_SCANS=20, _SMALL_BYTES=1, _AT_ONCE=1)
    assert drive(0.0, 120.0, 240.0) == {0.0, 120.0, 240.0}, "scans were there just now"
    assert drive(*[0.0] * 40) == {0.0}
    assert drive(240.0) == {0.0, 240.0}
    assert bytes_of(mapper.state.tiled) == bytes_of(in_memory.state.tiled)
    for there_is_little in ({"_AT_ONCE": 10**9}, {"_SMALL_BYTES": 10**9}):
        use(_COLD_SCANS=0, _AT_ONCE=1, _SMALL_BYTES=1)
        use(**there_is_little)
        assert drive(0.0, 120.0) == {0.0, 120.0, 240.0}


@pytest.mark.skipif(sys.platform != "linux", reason="/proc tells it")
def test_what_was_read_leaves_memory_and_comes_back(tmp_path: Path) -> None:
    def in_memory() -> int:
        fields, of_file = [], False
        for line in Path("/proc/self/smaps").read_text().splitlines():
            if "-" in line.split()[0]:
                of_file = str(tmp_path) in line
            elif of_file and line.startswith("Rss:"):
                fields.append(int(line.split()[1]))
        return sum(fields)

    file = PageFile(tmp_path)
    array = np.random.default_rng(0).normal(size=200_000)
    kept = next(iter(file.put([array]).values()))
    assert in_memory() == 0, "nobody has read it"
    for _ in range(2):
        np.testing.assert_array_equal(kept, array)
        assert in_memory() > 1000
        file.let_go()
        assert in_memory() == 0
    file.check()


def test_what_the_disk_does_not_read_back_is_told(tmp_path: Path) -> None:
    file, other = PageFile(tmp_path), PageFile(tmp_path)
    array = np.ones(100_000)
    (paged,), (sound,) = (list(f.put([array]).values()) for f in (file, other))
    file.check()
    os.ftruncate(file._fd, 2 * mmap.PAGESIZE)  # as unreadable as a sector that has gone bad
    with pytest.raises(MapDamagedError, match="restart the server"):  # before anybody meets it
        file.check()
    os.ftruncate(file._fd, file._end)
    file.check()
    os.ftruncate(file._fd, 2 * mmap.PAGESIZE)
    assert paged.sum() == 2 * mmap.PAGESIZE / 8, "zeros, and the process lives"
    os.ftruncate(file._fd, file._end)
    with pytest.raises(MapDamagedError, match="restart the server"):
        file.check()
    file.close()
    with pytest.raises(MapDamagedError, match="restart the server"):
        file.check()
    other.check()
    assert sound.sum() == len(array)


def flip(file: PageFile, place: int) -> None:
    (byte,) = os.pread(file._fd, 1, place)
    os.pwrite(file._fd, bytes([byte ^ 1 << place % 8]), place)


def test_a_bit_that_flips_anywhere_is_found_when_the_turn_comes(tmp_path: Path) -> None:
    file = PageFile(tmp_path)
    kept = [file.put([np.random.default_rng(i).normal(size=900)]) for i in range(3)]
    end = file.n_bytes
    for place in range(0, end, 64):
        flip(file, place)
        for _ in kept:
            file.scrub()
        with pytest.raises(MapDamagedError):
            file.check()
        flip(file, place)
        file._is_damaged = False
    for _ in kept:
        file.scrub()
    file.check()


def test_a_scan_on_damaged_pages_is_kept_nowhere(tmp_path: Path) -> None:
    mapper, pages = MappingService(settings=SETTINGS, threads=1), Pages(tmp_path, 1)
    for seq, x_m in enumerate((0.0, 120.0, 240.0)):
        mapper.integrate(scan_at(x_m, seq))
        mapper.relieve(pages)
    before = mapper.state.tiled
    assert before is not None
    end = pages.file.n_bytes
    mapper.integrate(scan_at(1.0, 3))
    assert mapper.state.tiled is not None
    pages.verify(mapper.state.tiled)
    pages.file.check()
    n_found = 0
    for place in range(0, end, 4096):
        flip(pages.file, place)
        pages.verify(mapper.state.tiled)
        n_found += pages.file._is_damaged
        flip(pages.file, place)
        pages.file._is_damaged = False
    changed = {id(part) for part in before.parts.values()} - {
        id(part) for part in mapper.state.tiled.parts.values()
    }
    assert 0 < len(changed) < len(before.parts)
    assert 0.1 < n_found / (end / 4096) < 0.6, (
        "of the room that was seen again; of the others nothing was taken"
    )


def test_a_bus_error_elsewhere_is_not_ours(tmp_path: Path) -> None:
    """Neither before nor after one that is."""
    code = f"""
import mmap, os, sys
from pathlib import Path
import numpy as np
from potserver.domain.pages import PageFile
file = PageFile(Path({str(tmp_path)!r}))
(paged,) = file.put([np.ones(100_000)]).values()
os.ftruncate(file._fd, 0)
print(paged.sum(), flush=True)
with open({str(tmp_path / "foreign")!r}, "w+b") as foreign:
    foreign.truncate(mmap.PAGESIZE)
    mapped = mmap.mmap(foreign.fileno(), mmap.PAGESIZE)
    foreign.truncate(0)
    mapped[0]
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (run.stdout, run.returncode) == ("0.0\n", -signal.SIGBUS), run.stderr


def test_a_disk_that_refuses_leaves_the_map_in_memory(tmp_path: Path) -> None:
    mapper = MappingService(settings=SETTINGS, threads=1)
    mapper.integrate(scan_at(0.0, 0))
    state = mapper.state
    with pytest.raises(OSError, match="No such file"):
        mapper.relieve(Pages(tmp_path / "gone", 1))
    assert mapper.state is state
