"""A server's maps on the disk, over the wire: what is saved, loaded, cleared, and there after a restart."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from potschemas import messages, wire
from potschemas.messages import DType, ErrorCode
from potserver.config import load_settings
from potserver.errors import MapFileError, StorageError
from potserver.server import MapServer

from .conftest import Client, drain, make_cloud, points_query

Serve = Callable[..., tuple[MapServer, Client]]
HERE = points_query([[5.9, 0.0, 0.0], [1.0, 0.0, 0.5]])


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Starts servers with the real mapper on one store, each with a client."""
    with contextlib.ExitStack() as stack:

        def start(**changes: Any) -> tuple[MapServer, Client]:
            settings = load_settings(
                overrides={
                    "mapping.max_range_m": 15.0,
                    "mapping.beams_per_scan": 300,
                    "store.directory": str(tmp_path / "store"),
                    **{key.replace("__", "."): value for key, value in changes.items()},
                }
            )
            server = MapServer(settings, listen="tcp/127.0.0.1:0")
            server.start()
            stack.callback(server.stop)
            client = Client(server.endpoint)
            stack.callback(client.close)
            return server, client

        yield start


def wall_points() -> NDArray[np.float32]:
    """The points of a cloud."""
    return wire.decode_array(make_cloud().points, "points", dtypes=(DType.FLOAT32,), shape=(None, 3))


def named(name: str) -> messages.ControlRequest:
    return messages.ControlRequest(name=name)


def test_a_map_is_there_after_a_restart_and_old_clouds_are_known(serve: Serve) -> None:
    server, client = serve()
    assert client.one("info").durable is True
    for seq in (1, 2):
        client.one("integrate", make_cloud(seq=seq, robot="r1"))
    before = client.one("points", HERE)
    client.close()
    assert server.stop()
    _, client = serve()
    info = client.one("info")
    assert (info.n_scans, info.map_revision) == (2, 2)
    assert client.one("points", HERE).mean.data == before.mean.data, "the very same answers"
    assert client.error("integrate", make_cloud(seq=2, robot="r1")).code is ErrorCode.OLD_SEQ
    assert client.one("integrate", make_cloud(seq=3, robot="r1")).map_revision == 3


def test_save_load_and_clear_over_the_wire(serve: Serve) -> None:
    _, client = serve()
    ticks = client.listen(client.keys.revision)
    client.one("integrate", make_cloud(seq=1, robot="r1"))
    saved = client.one("points", HERE)
    assert "snapshot" in client.control("save").message
    assert "one.map" in client.control("save", named("one")).message
    client.one("integrate", make_cloud(seq=2, robot="r1"))
    assert client.control("clear").map_revision == 3
    unknown = client.control("load", named("two"))
    assert (unknown.code, "there are: one" in unknown.message) == (ErrorCode.UNKNOWN_MAP, True)
    reply = client.control("load", named("one"))
    assert (reply.verb, reply.map_revision) == ("load", 4)
    assert client.one("points", HERE).mean.data == saved.mean.data
    told = drain(ticks, 4)
    assert [tick.map_revision for tick in told] == [1, 2, 3, 4]
    assert len(told[3].changed_tiles) > 0
    assert told[3].n_kernels == client.one("info").n_kernels
    assert client.one("integrate", make_cloud(seq=2, robot="r1")).map_revision == 5, (
        "numbers are the saved map's"
    )
    assert client.error("integrate", make_cloud(seq=1, robot="r1")).code is ErrorCode.OLD_SEQ
    counters = client.stats().counters
    assert (counters["maps.loaded"], counters["control.load.unknown_map"]) == (1, 1)


def test_a_backup_by_save_is_complete_and_comes_back_on_another_server(serve: Serve, tmp_path: Path) -> None:
    server, client = serve()
    for seq in (1, 2):
        client.one("integrate", make_cloud(seq=seq, robot="r1"))
    client.control("save", named("nightly"))  # while it serves: complete as of this moment
    before = client.one("points", HERE)
    (file,) = (tmp_path / "store" / "saved").rglob("nightly.map")
    shutil.copy(file, tmp_path / "backup.map")
    client.one("integrate", make_cloud(seq=3, robot="r1"))
    client.close()
    assert server.stop()
    shutil.rmtree(tmp_path / "store")  # the disk is lost
    _, client = serve()
    client.control("save", named("nightly"))
    (place,) = (tmp_path / "store" / "saved").rglob("nightly.map")
    shutil.copy(tmp_path / "backup.map", place)
    client.control("load", named("nightly"))
    assert client.one("info").n_scans == 2
    assert client.one("points", HERE).mean.data == before.mean.data
    assert client.error("integrate", make_cloud(seq=2, robot="r1")).code is ErrorCode.OLD_SEQ
    client.one("integrate", make_cloud(seq=3, robot="r1"))  # the robot sends again what came after


def test_a_full_map_takes_no_cloud_until_there_is_room(serve: Serve) -> None:
    _, client = serve(limits__max_map_bytes=1)
    receipts = client.receipts("r2")
    client.one("integrate", make_cloud(seq=1, robot="r1"))
    client.put_cloud(make_cloud(seq=1), robot="r2")
    (refused,) = drain(receipts, 1)
    assert (refused.status.value, refused.reason) == ("rejected", "map_full")
    assert "limits.max_map_bytes" in refused.message
    client.control("clear")
    client.put_cloud(make_cloud(seq=2), robot="r2")
    (taken,) = drain(receipts, 1)
    assert taken.status.value == "accepted"


def test_copies_belong_to_their_map(serve: Serve, tmp_path: Path) -> None:
    server, ground = serve(maps=["ground", "roof"])
    ground.close()
    with contextlib.closing(Client(server.endpoint, map_id="ground")) as ground:
        ground.control("save", named("copy"))
    saved = tmp_path / "store" / "saved"
    assert [path.relative_to(saved).as_posix() for path in saved.rglob("*.map")] == ["ground/copy.map"]
    with contextlib.closing(Client(server.endpoint, map_id="roof")) as roof:
        assert roof.control("load", named("copy")).code is ErrorCode.UNKNOWN_MAP
        (saved / "ground" / "copy.map").rename(saved / "copy.map")  # where all maps had their copies before
        error = roof.control("load", named("copy"))
        assert error.code is ErrorCode.UNKNOWN_MAP
        assert f"move it to {saved / 'roof' / 'copy.map'}" in error.message


def test_names_where_they_belong_and_nowhere_else(serve: Serve) -> None:
    _, client = serve()
    assert client.control("load").code is ErrorCode.BAD_MESSAGE
    assert client.control("clear", named("x")).code is ErrorCode.BAD_MESSAGE
    assert client.control("merge").code is ErrorCode.BAD_MESSAGE
    assert client.control("forget").code is ErrorCode.BAD_MESSAGE
    assert client.control("forget", named("x")).code is ErrorCode.BAD_MESSAGE
    assert client.control("load", messages.ControlRequest(name="x", robot="r1")).code is ErrorCode.BAD_MESSAGE
    posed = messages.ControlRequest(name="x", T_map_saved=wire.encode_array(np.eye(4)))
    assert client.control("load", posed).code is ErrorCode.BAD_MESSAGE


def test_maps_merge_and_robots_are_forgotten_over_the_wire(serve: Serve) -> None:
    _, client = serve()
    client.one("integrate", make_cloud(seq=1, robot="r2"))
    client.control("save", named("theirs"))
    client.control("clear")
    client.one("integrate", make_cloud(seq=1, robot="r1"))
    alone = client.one("info")
    pose = np.eye(4)
    pose[0, 3] = 100.0
    ticks = client.listen(client.keys.revision)
    request = messages.ControlRequest(name="theirs", T_map_saved=wire.encode_array(pose))
    reply = client.control("merge", request)
    assert (reply.verb, reply.map_revision) == ("merge", alone.map_revision + 1)
    (tick,) = drain(ticks, 1)
    assert max(tile[0] for tile in tick.changed_tiles) >= 9
    merged = client.one("info")
    assert merged.n_scans == 2
    assert merged.n_kernels > 1.8 * alone.n_kernels
    there = points_query([[105.9, 0.0, 0.0]])
    assert client.one("points", there).observed.data == b"\x01"
    assert client.control("forget", messages.ControlRequest(robot="r2")).verb == "forget"
    assert client.one("points", there).observed.data == b"\x00"
    assert client.one("info").n_kernels == pytest.approx(alone.n_kernels, rel=0.02)
    assert client.control("forget", messages.ControlRequest(robot="r3")).code is ErrorCode.UNKNOWN_ROBOT
    assert client.control("merge", named("ours")).code is ErrorCode.UNKNOWN_MAP
    far = np.eye(4)
    far[1, 3] = 3e10
    beyond = messages.ControlRequest(name="theirs", T_map_saved=wire.encode_array(far))
    assert client.control("merge", beyond).code is ErrorCode.OUT_OF_RANGE
    skewed = messages.ControlRequest(name="theirs", T_map_saved=wire.encode_array(2.0 * pose))
    assert client.control("merge", skewed).code is ErrorCode.BAD_POSE
    counters = client.stats().counters
    assert (counters["maps.merged"], counters["maps.robots_forgotten"]) == (1, 1)


def test_what_was_merged_and_forgotten_is_so_after_a_restart(serve: Serve) -> None:
    server, client = serve()
    client.one("integrate", make_cloud(seq=1, robot="r1"))
    client.control("save", named("mine"))
    client.control("clear")
    client.one("integrate", make_cloud(seq=1, robot="r2"))
    client.control("merge", named("mine"))
    client.control("forget", messages.ControlRequest(robot="r2"))
    before = client.one("points", HERE)
    client.close()
    assert server.stop()
    _, client = serve()
    assert client.one("points", HERE).mean.data == before.mean.data
    again = client.control("forget", messages.ControlRequest(robot="r2"))
    assert (again.code, "scans from r1" in again.message) == (ErrorCode.UNKNOWN_ROBOT, True)


def test_a_cloud_that_the_disk_refuses_is_dropped_with_that_reason(serve: Serve) -> None:
    server, client = serve()
    receipts = client.receipts("r1")
    connection = server._stores["default"]._journal._connection
    pages = connection.execute("PRAGMA page_count").fetchone()[0]
    connection.execute(f"PRAGMA max_page_count = {pages}")  # what SQLite then says is what a full disk says
    points = wire.encode_array(np.tile(wall_points(), (10, 1)))  # more than what is left of the last page
    cloud = make_cloud(seq=1, robot="r1", points=points)
    refused = client.error("integrate", cloud)
    assert (refused.code, refused.retryable) == (ErrorCode.STORAGE, True)
    client.put_cloud(cloud)
    (receipt,) = drain(receipts, 1)
    assert (receipt.status.value, receipt.reason) == ("dropped", "storage")
    assert client.one("info").n_scans == 0
    assert client.stats().counters["clouds.dropped.storage"] == 2
    connection.execute("PRAGMA max_page_count = 1000000")
    assert client.one("integrate", cloud).map_revision == 1, "the same cloud, once there is room"


def test_two_servers_do_not_share_a_store(serve: Serve) -> None:
    serve()
    with pytest.raises(StorageError, match="another server"):
        serve()


def test_a_damaged_store_is_an_error_and_not_an_empty_map(serve: Serve, tmp_path: Path) -> None:
    server, client = serve()
    client.one("integrate", make_cloud(seq=1, robot="r1"))
    client.close()
    assert server.stop()
    file = tmp_path / "store" / "default" / "tiles.sqlite"
    content = bytearray(file.read_bytes())
    third = len(content) // 3
    content[third : 2 * third] = bytes(third)
    file.write_bytes(content)
    with pytest.raises(MapFileError, match="is damaged"):
        serve()


def test_a_read_only_server_answers_and_takes_nothing_in(serve: Serve) -> None:
    server, client = serve()
    client.one("integrate", make_cloud(seq=1, robot="r1"))
    client.control("save", named("one"))
    before = client.one("points", HERE)
    client.close()
    assert server.stop()
    server, client = serve(store__read_only=True, atoms__writable=True)
    receipts = client.receipts("r1")
    assert client.one("points", HERE).mean.data == before.mean.data
    assert client.one("info").durable is False
    assert client.error("integrate", make_cloud(seq=2, robot="r1")).code is ErrorCode.READ_ONLY
    client.put_cloud(make_cloud(seq=3, robot="r1"))
    (receipt,) = drain(receipts, 1)
    assert (receipt.status.value, receipt.reason) == ("rejected", "read_only")
    for verb, request in (
        ("clear", messages.ControlRequest()),
        ("save", messages.ControlRequest()),
        ("load", named("one")),
        ("atoms", messages.AtomsQuery(action=messages.AtomsAction.REMOVE, atom_id="any")),
    ):
        assert client.control(verb, request).code is ErrorCode.READ_ONLY
    assert client.one("points", HERE).mean.data == before.mean.data
    client.close()
    assert server.stop()


def test_in_memory_there_is_nothing_to_save(serve: Serve) -> None:
    _, client = serve(store__directory="")
    assert client.one("info").durable is False
    for verb in ("save", "load"):
        refused = client.control(verb, named("x"))
        assert (refused.code, "--store" in refused.message) == (ErrorCode.UNSUPPORTED, True)
