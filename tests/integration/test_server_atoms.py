"""The dictionary as a robot sees it: list, fetch, add, remove, over a real Zenoh session, while maps are built from it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from potclient import Atom, AtomRefusedError, MapClient, ReadOnlyError, UnknownAtomError
from potclient.errors import InternalError, MapServerError, ShapeError
from potserver.config import load_settings
from potserver.domain.dictionary import AtomDictionary
from potserver.mapping.novelty import FIRST
from potserver.server import MapServer

from .conftest import until

FAST = {"mapping.max_range_m": 15.0, "mapping.beams_per_scan": 600, "threads": 1, "atoms.writable": True}
ORIGIN = np.eye(4)

Serve = Callable[..., MapClient]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Starts servers with the real mapper, and gives a client of each; keywords are dotted settings with `__` for the dot."""
    with contextlib.ExitStack() as stack:

        def start(*, map_id: str = "default", **changes: Any) -> MapClient:
            overrides = FAST | {key.replace("__", "."): value for key, value in changes.items()}
            server = stack.enter_context(
                MapServer(load_settings(overrides=overrides), listen="tcp/127.0.0.1:0")
            )
            client = MapClient(server.endpoint, map=map_id, timeout_s=60.0)
            client.wait_ready()
            return stack.enter_context(client)

        yield start


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A dictionary file of four atoms."""
    path = tmp_path / "site.atoms"
    AtomDictionary(AtomDictionary.builtin().of_dims(3).atoms[:4]).save(path)
    return path


def room(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, 600)
    walls = [6 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-1, 2, 600)]
    return np.stack(walls, axis=1).astype(np.float32)


def names(client: MapClient) -> list[str]:
    return [info.atom_id for info in client.atoms()]


def on_disk(path: Path) -> list[str]:
    return [atom.atom_id for atom in AtomDictionary.load(path)]


def mirrored(atom: Atom, atom_id: str) -> Atom:
    """As sound as the original, and not a duplicate of it."""
    flip = np.array([1, -1, 1], np.float32)
    hinges = atom.kernels.hinge_mean * flip
    return Atom(
        info=msgspec.structs.replace(atom.info, atom_id=atom_id),
        hit_points=atom.hit_points * flip,
        free_points=atom.free_points * flip,
        kernels=type(atom.kernels)(
            **{
                name: getattr(atom.kernels, name)
                for name in atom.kernels.__dataclass_fields__
                if name != "hinge_mean"
            },
            hinge_mean=hinges,
        ),
    )


def test_an_atom_that_was_taken_out_can_be_put_back(serve: Serve, site: Path) -> None:
    client = serve(dictionary=str(site))
    before = names(client)
    assert len(before) == client.info().n_atoms == 4
    atom = client.atom(before[0])
    gone = client.remove_atom(before[0])
    assert (gone.atom_id, gone.n_atoms, gone.persisted) == (before[0], 3, False)
    with pytest.raises(UnknownAtomError):
        client.atom(before[0])
    with pytest.raises(UnknownAtomError):
        client.remove_atom(before[0])
    assert names(client) == before[1:]
    assert client.info().n_atoms == 3

    assert client.add_atom(atom).n_atoms == 4
    assert names(client) == [*before[1:], before[0]]
    back = client.atom(before[0])
    assert back.info == atom.info
    np.testing.assert_array_equal(back.hit_points, atom.hit_points)
    np.testing.assert_allclose(back.kernels.hinge_mean, atom.kernels.hinge_mean, atol=2e-6)
    counters = client.stats().counters
    assert (counters["atoms.added"], counters["atoms.removed"]) == (1, 1)
    assert counters["atoms.refused.unknown_atom"] == 1
    assert on_disk(site) == before, "changes stay in memory unless the operator says otherwise"


def test_a_refused_atom_changes_nothing_and_says_why(serve: Serve, site: Path) -> None:
    client = serve(dictionary=str(site))
    before = names(client)
    atom = client.atom(before[0])
    rename = msgspec.structs.replace
    again = Atom(
        info=rename(atom.info, atom_id="again"),
        hit_points=atom.hit_points,
        free_points=atom.free_points,
        kernels=atom.kernels,
    )
    for refused, reason in (
        (atom, "taken_id"),
        (again, "duplicate"),
        (mirrored(atom, "Not Legal"), "illegal_id"),
    ):
        with pytest.raises(AtomRefusedError) as caught:
            client.add_atom(refused)
        assert caught.value.reason == reason
        assert not caught.value.retryable
        assert client.stats().counters[f"atoms.refused.{reason}"] == 1
    miscounted = Atom(
        info=rename(atom.info, n_hits=7),
        hit_points=atom.hit_points,
        free_points=atom.free_points,
        kernels=atom.kernels,
    )
    with pytest.raises(ShapeError):
        client.add_atom(miscounted)
    assert names(client) == before
    assert client.add_atom(mirrored(atom, "mirrored")).n_atoms == len(before) + 1


def test_changes_of_the_dictionary_are_audit_lines(
    serve: Serve, site: Path, caplog: pytest.LogCaptureFixture
) -> None:
    client = serve(dictionary=str(site))
    name = names(client)[0]
    with caplog.at_level("INFO", logger="potserver.audit"):
        client.remove_atom(name)
        with pytest.raises(UnknownAtomError):
            client.remove_atom(name)
    done, refused = (record.msg for record in caplog.records if record.name == "potserver.audit")
    assert (done["what"], done["result"], done["atom_id"]) == ("control.atoms", "removed", name)
    assert (refused["what"], refused["reason"]) == ("control.atoms", "unknown_atom")
    assert done["who"] == refused["who"] != "unnamed"


def test_a_server_is_read_only_unless_it_is_told_otherwise(
    serve: Serve, site: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(FAST, "atoms.writable")
    client = serve(dictionary=str(site))
    before = names(client)
    atom = client.atom(before[0])
    with pytest.raises(ReadOnlyError):
        client.remove_atom(before[0])
    with pytest.raises(ReadOnlyError):
        client.add_atom(mirrored(atom, "mirrored"))
    assert names(client) == before
    assert client.stats().counters["atoms.refused.read_only"] == 2


def test_saved_changes_outlive_the_server(serve: Serve, site: Path) -> None:
    client = serve(dictionary=str(site), atoms__save=True)
    before = names(client)
    atom = client.atom(before[1])
    assert client.add_atom(mirrored(atom, "mirrored")).persisted
    assert on_disk(site) == [*before, "mirrored"], "on the disk before the reply came"
    assert client.remove_atom(before[0]).persisted
    expected = [*before[1:], "mirrored"]
    assert on_disk(site) == expected
    second = serve(dictionary=str(site))
    assert names(second) == expected
    np.testing.assert_array_equal(
        second.atom("mirrored").hit_points, atom.hit_points * np.array([1, -1, 1], np.float32)
    )


def test_a_disk_that_refuses_leaves_the_dictionary_as_it_was(serve: Serve, site: Path) -> None:
    client = serve(dictionary=str(site), atoms__save=True)
    before = names(client)
    site.with_name("site.atoms.partial").mkdir()  # where the new file would be written
    with pytest.raises(InternalError, match="cannot write"):
        client.remove_atom(before[0])
    assert names(client) == on_disk(site) == before


def test_all_maps_of_a_server_share_the_dictionary(site: Path) -> None:
    settings = load_settings(overrides=FAST | {"dictionary": str(site), "maps": ["one", "two"]})
    with (
        MapServer(settings, listen="tcp/127.0.0.1:0") as server,
        MapClient(server.endpoint, map="one", timeout_s=60.0) as client,
        MapClient(server.endpoint, map="two", timeout_s=60.0) as other,
    ):
        before = names(client)
        client.remove_atom(before[0])
        assert names(other) == before[1:]
        assert other.remove_atom(before[1]).n_atoms == 2
        assert names(client) == before[2:]


def test_changes_while_clouds_come_in_lose_nothing(serve: Serve, site: Path) -> None:
    """Two robots send, one operator adds and removes: every cloud is mapped, every change counts, scans use the new atoms."""
    client = serve(dictionary=str(site), atoms__save=True)
    before = names(client)
    originals = [client.atom(name) for name in before]
    changed = threading.Event()
    accepted: list[int] = []
    failures: list[BaseException] = []

    def send(robot: str) -> None:
        try:
            n = 0
            while not (changed.is_set() and n >= 3):
                accepted.append(client.integrate(room(n), ORIGIN, robot=robot).map_revision)
                n += 1
        except BaseException as error:
            failures.append(error)

    robots = [threading.Thread(target=send, args=(f"r{i}",)) for i in range(2)]
    for robot in robots:
        robot.start()
    try:
        for number, atom in enumerate(originals):
            client.add_atom(mirrored(atom, f"mirrored-{number}"))
        for name in before:
            client.remove_atom(name)
    finally:
        changed.set()
        for robot in robots:
            robot.join()
    assert failures == []
    expected = [f"mirrored-{i}" for i in range(len(originals))]
    assert names(client) == on_disk(site) == expected
    assert sorted(accepted) == list(range(1, len(accepted) + 1)), "each cloud made one revision of the map"
    counters = client.stats().counters
    assert counters["clouds.accepted"] == len(accepted)
    assert (counters["atoms.added"], counters["atoms.removed"]) == (4, 4)
    receipt = client.integrate(room(99), ORIGIN, robot="r0", params="transported")
    served = {sector.atom_id for sector in receipt.sectors} - {None}
    assert served
    assert served <= set(expected)
    assert sum(info.times_used for info in client.atoms()) > 0


def street(x_m: float) -> tuple[np.ndarray, np.ndarray]:
    """A scan of a made-up place that no dictionary knows: a level floor, and posts of 4 m on a lattice of 3 m; and its pose."""
    azimuth, elevation = np.meshgrid(
        np.linspace(-np.pi, np.pi, 360, endpoint=False), np.radians(np.arange(-30, 31, 2))
    )
    ways = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    along = np.arange(0.3, 14.0, 0.05)
    with np.errstate(divide="ignore"):
        floor_m = np.where(ways[:, 2] < 0, -1.2 / ways[:, 2], np.inf)
    places = ways[:, None, :2] * along[:, None] + [x_m, 1.5]
    in_post = (np.abs((places + 1.5) % 3.0 - 1.5) < 0.3).all(axis=2) & (ways[:, 2:] * along < 2.8)
    post_m = np.where(in_post.any(axis=1), along[in_post.argmax(axis=1)], np.inf)
    range_m = np.minimum(floor_m, post_m)
    seen = range_m < 14.0
    pose = np.eye(4)
    pose[0, 3] = x_m
    return (ways[seen] * range_m[seen, None]).astype(np.float32), pose


def test_a_server_learns_the_place_that_it_maps(serve: Serve, site: Path) -> None:
    client = serve(dictionary=str(site), atoms__save=True)
    assert client.places() == []
    with pytest.raises(AtomRefusedError) as refused:
        client.learn("yard")
    assert refused.value.reason == "too_few_scans"
    for number in range(8):
        points, pose = street(0.8 * number)
        client.integrate(points, pose, stamp_ns=number + 1)
    assert "yard learned from 8 scans, saved" in client.learn("yard").message
    (place,) = client.places()
    assert (place.name, place.times_used, place.provenance["newest_stamp_ns"]) == ("yard", 0, "8")
    points, pose = street(40.0)
    receipt = client.integrate(points, pose)
    assert receipt.kernels is not None
    assert client.places()[0].times_used == 1
    assert client.stats().counters["atoms.learned"] == 1
    assert [one.name for one in AtomDictionary.load(site).grown] == ["yard"]
    with pytest.raises(MapServerError, match="name"):
        client.control("learn")
    client.forget("r1")
    with pytest.raises(AtomRefusedError, match="too few"):
        client.learn("yard")
    client.remove_atom("yard")
    assert client.places() == []


def test_what_is_new_is_learned_without_being_asked(serve: Serve, site: Path) -> None:
    """A dictionary of atoms alone expects nothing, so that every scan is new to it."""
    client = serve(dictionary=str(site))
    for number in range(FIRST):
        client.integrate(*street(0.8 * number), stamp_ns=number + 1)
    until(lambda: client.stats().counters.get("atoms.learned") == 1, "what is new")
    assert client.stats().counters["atoms.proposed"] == 1
    (place,) = client.places()
    assert (place.name, place.provenance["scans"]) == ("default-1", str(FIRST))
    client.integrate(*street(40.0), stamp_ns=99)
    assert client.places()[0].times_used == 1
    for number in range(2 * FIRST):  # known now: nothing more is proposed
        client.integrate(*street(60.0 + 0.8 * number), stamp_ns=100 + number)
    assert client.stats().counters["atoms.proposed"] == 1
    assert not AtomDictionary.load(site).grown, "changes stay in memory unless the operator says otherwise"


def test_a_proposal_that_teaches_nothing_is_refused_and_counted(serve: Serve, site: Path) -> None:
    client = serve(dictionary=str(site))
    up = np.float32([[0, 0, 3.0]])
    for number in range(FIRST):  # no ground below the sensor
        points, pose = street(0.8 * number)
        client.integrate(np.abs(points) + up, pose, stamp_ns=number + 1)
    until(lambda: client.stats().counters.get("atoms.refused.too_few_scans") == 1, "the refusal")
    counters = client.stats().counters
    assert counters["atoms.proposed"] == 1
    assert "atoms.learned" not in counters
    assert client.places() == []


def test_a_server_that_takes_no_changes_learns_nothing(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(FAST, "atoms.writable")
    client = serve()
    with pytest.raises(ReadOnlyError):
        client.learn("yard")
