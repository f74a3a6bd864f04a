"""A store under faults: its process is stopped, or its disk refuses, at every single write.

Every child process runs the same steps on a store of its own and tells which were acknowledged. What the store then holds
must be what a map without faults holds after just those steps; the step in work at the end may be in it or not.
"""

from __future__ import annotations

import ctypes
import dataclasses
import errno
import functools
import hashlib
import json
import os
import random
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from enum import IntEnum
from pathlib import Path

import numpy as np

from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.order import CloudOrder
from potserver.domain.types import KernelSet, Scan, yaw_pose
from potserver.errors import PotserverError
from potserver.health import Health
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.storage.map_store import MapStore
from potserver.storage.tile_codec import encode_tile

SOURCE = Path(__file__).with_name("faults.c")
SETTINGS = MappingSettings(max_range_m=15.0, beams_per_scan=100)
_SNAPSHOT_SCANS = 3  # few: faults meet snapshots
KEPT = "kept"
_PAGE = 4096  # bytes that a disk writes at once
# t: a scan; s: a snapshot; k: a saved map; c: clear; l: load what was saved
STEPS = "ttskttcttlt"


class Fault(IntEnum):
    """What happens at the Nth call; `faults.c` has the same."""

    NONE = 0
    KILLED = 1  # before it
    TORN = 2  # in the middle of it
    REFUSED_ONCE = 3  # an I/O error
    REFUSED_FROM = 4  # it and all that follow: no space left


@dataclasses.dataclass
class Outcomes:
    """What became of many faults of one kind."""

    name: str
    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    wrong: list[str] = dataclasses.field(default_factory=list)

    @property
    def n(self) -> int:
        """How many there were."""
        return self.counts.total()


# --- steps ------------------------------------------------------------------------------------------------------------


@functools.cache
def make_scan(number: int) -> Scan:
    """A small room, seen from somewhere in it."""
    rng = np.random.default_rng(number)
    angle = rng.uniform(-np.pi, np.pi, 100)
    walls = np.stack([6 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-1, 2, 100)], axis=1)
    pose = yaw_pose(0.5 * number, 0.2, 0.1 * number)
    return Scan(points=walls.astype(np.float32), T_map_sensor=pose, robot_id=f"r{number % 2}", seq=number)


class Driven:
    """A map and its store, driven as a server's writer does."""

    def __init__(self, folder: Path) -> None:
        self.mapper, self.order = MappingService(settings=SETTINGS, threads=1), CloudOrder()
        self.store = MapStore(
            folder,
            "default",
            keeps_evidence=True,
            health=Health(),
            snapshot_scans=_SNAPSHOT_SCANS,
            max_resident_bytes=1,  # everything goes to pages, and the disk may refuse those too
        )
        try:
            self.order.replace(self.store.restore(self.mapper).heard)
        except BaseException:
            self.store.drop()
            raise

    def do(self, number: int) -> None:
        """One of the steps."""
        kind = STEPS[number]
        if kind == "t":
            scan = make_scan(number)
            self.order.check(scan.robot_id, scan.session, scan.seq)
            with self.store.keeping(scan) as commit:
                self.mapper.integrate(scan, commit=commit)
            self.order.remember(scan.robot_id, scan.session, scan.seq)
            self.store.relieve(self.mapper)
            self.store.advance(self.mapper, self.order.heard)
        elif kind == "c":
            self.mapper.clear(commit=lambda state: self.store.replace(state, {}))
            self.order.replace({})
        elif kind == "l":
            state, heard = self.store.load(KEPT, self.mapper)
            self.mapper.restore(state, commit=lambda new: self.store.replace(new, heard))
            self.order.replace(heard)
        else:
            self.store.save(KEPT if kind == "k" else None, self.mapper, self.order.heard)


@functools.cache
def wanted(steps: tuple[int, ...]) -> str:
    """Digest of the map after just these steps, without a store and without faults."""
    mapper = MappingService(settings=SETTINGS, threads=1)
    kept = mapper.state
    for number in steps:
        kind = STEPS[number]
        if kind == "t":
            mapper.integrate(make_scan(number))
        elif kind == "c":
            mapper.clear()
        elif kind == "k":
            kept = mapper.state
        elif kind == "l":
            revision = max(mapper.state.map_revision, kept.map_revision) + 1
            empty = KernelMap(KernelSet.empty(), map_revision=revision)
            mapper.restore(dataclasses.replace(kept, snapshot=empty, epoch=secrets.randbits(62)))
    return digest(mapper.state)


def digest(state: MapState) -> str:
    """Of everything that a map says, but for its epoch."""
    found = hashlib.blake2b(f"{state.map_revision} {state.n_scans} {state.stamp_ns}".encode(), digest_size=8)
    if state.tiled is not None:
        found.update(repr(state.tiled.robots).encode())
        for index, tile in sorted(state.tiled.tiles.items()):
            found.update(encode_tile(index, tile))
    return found.hexdigest()


# --- faults of calls --------------------------------------------------------------------------------------------------


def build_shim(folder: Path) -> Path:
    """Compile `faults.c`.

    Raises:
        FileNotFoundError: there is no C compiler.
    """
    shim = folder / "faults.so"
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", shim, SOURCE, "-ldl"], check=True)
    return shim


def torture_calls(every: int, show: Callable[[str], None]) -> list[Outcomes]:
    """Run the steps with a fault at every `every`th call. The process must have been started with the shim preloaded."""
    shim = ctypes.CDLL(os.environ["LD_PRELOAD"])
    shim.faults_count.restype = ctypes.c_long
    wanted(tuple(range(len(STEPS))))  # compiled, before there are children
    with tempfile.TemporaryDirectory() as scratch:
        n_calls = int(_in_child(lambda: _count(shim, Path(scratch) / "count")))
        outcomes = []
        for fault in (Fault.KILLED, Fault.TORN, Fault.REFUSED_ONCE, Fault.REFUSED_FROM):
            outcome = Outcomes(fault.name.lower().replace("_", " "))
            for at in range(1, n_calls + 1, every):
                folder = Path(scratch) / f"{fault.name}-{at}"
                outcome.counts[_one(shim, folder, fault, at, outcome.wrong)] += 1
                shutil.rmtree(folder, ignore_errors=True)
                show(f"{outcome.name}: call {at} of {n_calls}, {len(outcome.wrong)} wrong")
            outcomes.append(outcome)
        outcomes += _torture_power(shim, Path(scratch), range(1, n_calls + 1, every), show)
    return outcomes


def _torture_power(
    shim: ctypes.CDLL, scratch: Path, calls: Sequence[int], show: Callable[[str], None]
) -> list[Outcomes]:
    """The power fails before a call: of what was not synced nothing is on the disk, or any of its pages are."""
    outcomes = [
        Outcomes(f"power cut, {what}") for what in ("all lost that was not synced", "any of its pages lost")
    ]
    for at in calls:
        folder, synced = scratch / f"power-{at}", scratch / f"synced-{at}"
        shim.faults_shadow(str(synced).encode())
        told = _in_child(lambda: _run(shim, folder, Fault.KILLED, at), partial=True)  # noqa: B023
        shim.faults_shadow(b"")
        for outcome, share in zip(outcomes, (0.0, 0.5), strict=True):
            disk = _disk_after(folder, synced, scratch / f"disk-{at}", share, random.Random(at))
            outcome.counts[_judged(told, disk, f"{outcome.name} at call {at}", outcome.wrong)] += 1
            shutil.rmtree(disk, ignore_errors=True)
        for used in (folder, synced):
            shutil.rmtree(used, ignore_errors=True)
        show(f"power cut: call {at}, {sum(len(outcome.wrong) for outcome in outcomes)} wrong")
    return outcomes


def _disk_after(written: Path, synced: Path, to: Path, share: float, rng: random.Random) -> Path:
    """What a disk holds after a power cut: files as they were synced last, and of what came after a share of the pages."""
    to.mkdir()
    for file in (path for path in written.rglob("*") if path.is_file() and not path.name.endswith("-shm")):
        now, before = file.read_bytes(), b""
        if (synced / file.relative_to(written)).exists():
            before = (synced / file.relative_to(written)).read_bytes()
        elif rng.random() >= share:
            continue  # not even its name
        pages = []
        for start in range(0, max(len(now), len(before)), _PAGE):
            cut = slice(start, start + _PAGE)
            reached = rng.random() < share
            # a page that did not reach the disk and was never there before reads as zeros below the file's new end
            pages.append(now[cut] if reached else before[cut] or bytes(len(now[cut])))
        end = len(now) if rng.random() < share else len(before)
        place = to / file.relative_to(written)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(b"".join(pages)[:end])
    return to


def _count(shim: ctypes.CDLL, folder: Path) -> str:
    shim.faults_arm(str(folder).encode(), 0, Fault.NONE, 0)
    driven = Driven(folder)
    for number in range(len(STEPS)):
        driven.do(number)
    driven.store.close()
    return str(shim.faults_count())


def _one(shim: ctypes.CDLL, folder: Path, fault: Fault, at: int, wrong: list[str]) -> str:
    """One child with one fault, and a second one that opens what it left."""
    told = _in_child(lambda: _run(shim, folder, fault, at), partial=True)
    return _judged(told, folder, f"{fault.name} at call {at}", wrong)


def _judged(told: str, folder: Path, what: str, wrong: list[str]) -> str:
    """Whether a store holds what a child was told that it holds, in words."""
    words = told.split()
    done = tuple(int(word[1:]) for word in words if word[0] == "+")
    refused = [int(word[1:]) for word in words if word[0] == "-"]
    began = int(words[-1][1:]) if words and words[-1][0] == "?" else None  # in work when it ended
    maybe = [*refused, *([] if began is None else [began])]
    found = _in_child(lambda: reopened(folder))
    allowed = {wanted(done): "all acknowledged, nothing else"}
    for extra in maybe:  # what was not acknowledged may be there or not
        allowed.setdefault(wanted(tuple(sorted((*done, extra)))), "all acknowledged, and a step that was not")
    if found not in allowed:
        wrong.append(f"{what}: acknowledged {done}, refused {refused}; found {found}")
    return allowed.get(found, "wrong")


def _run(shim: ctypes.CDLL, folder: Path, fault: Fault, at: int) -> str:
    """The steps, with a fault; each is told to the parent when it begins and when it is acknowledged."""
    number_of = {Fault.REFUSED_ONCE: errno.EIO, Fault.REFUSED_FROM: errno.ENOSPC}
    shim.faults_arm(str(folder).encode(), at, fault, number_of.get(fault, 0))
    try:
        driven = Driven(folder)
    except PotserverError:
        return ""
    for number in range(len(STEPS)):
        os.write(_pipe, f"?{number} ".encode())
        try:
            driven.do(number)
            os.write(_pipe, f"+{number} ".encode())
        except PotserverError:
            os.write(_pipe, f"-{number} ".encode())
    driven.store.close()
    return ""


def reopened(folder: Path) -> str:
    """Digest of the map that a store holds, or how it was refused."""
    try:
        driven = Driven(folder)
    except PotserverError as error:
        return f"refused: {error}"
    except Exception as error:
        return f"crashed: {error!r}"
    driven.store.drop()
    return digest(driven.mapper.state)


_pipe = -1  # of a child, to its parent


def _in_child(work: Callable[[], str], *, partial: bool = False) -> str:
    """What a forked child returns, or what it had written to its pipe when it was killed."""
    global _pipe
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        _pipe = write_end
        try:
            os.write(write_end, work().encode())
        except BaseException as error:
            os.write(write_end, f"crashed:{error!r}".replace(" ", "_").encode())
        os._exit(0)
    os.close(write_end)
    with os.fdopen(read_end) as stream:
        told = stream.read()
    _, status = os.waitpid(child, 0)
    if not partial and status:
        return f"ended with status {status}"
    return told


def main(arguments: Sequence[str]) -> int:
    """In a process with the shim preloaded: `EVERY`; prints the outcomes as JSON."""
    outcomes = torture_calls(int(arguments[0]), lambda line: print(f"\r{line}   ", end="", file=sys.stderr))
    print(json.dumps([{"name": o.name, "counts": dict(o.counts), "wrong": o.wrong} for o in outcomes]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
