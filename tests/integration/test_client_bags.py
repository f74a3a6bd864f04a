"""`export mcap` and `view --save *.mcap`: strangers' libraries read the messages, and what was recorded plays again."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from potclient.client import MapClient
from potclient.datasets.bags import open_bag
from potclient.ros.point_clouds import read_point_cloud
from potclient.view.bag import FREE, GRID, SURFACES, UNKNOWN, BagPicture
from potclient.view.live import LiveView
from potschemas.answers import occupancy_var
from potserver.server import MapServer
from tests.map_server import FREE as FREE_PIXEL
from tests.map_server import OCCUPIED, load_map

from .conftest import Run, until
from .rooms import pose, room


def messages_of(file: Path) -> dict[str, list[Any]]:
    """What the libraries mcap and mcap-ros2-support find in a file, by topic."""
    found: dict[str, list[Any]] = {}
    with file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            found.setdefault(channel.topic, []).append(message)
    return found


def rows(message: Any, *names: str) -> np.ndarray[Any, Any]:
    """The float fields of a PointCloud2 by numpy alone."""
    kinds = {field.name: ("<f4", field.offset) for field in message.fields}
    dtype = np.dtype({
        "names": list(names), "formats": [kinds[n][0] for n in names], "offsets": [kinds[n][1] for n in names],
        "itemsize": message.point_step,
    })  # fmt: skip
    table = np.frombuffer(bytes(message.data), dtype)
    return np.stack([table[name] for name in names], axis=1)


def test_an_exported_map_is_read_by_strangers(
    run_at: Run, map_server: MapServer, map_client: MapClient, tmp_path: Path
) -> None:
    words = ("export", "mcap", "--resolution", "0.25", "-o", str(tmp_path / "map.mcap"))
    status, _, err = run_at(map_server.endpoint, *words)
    assert status == 2
    assert "the map is empty" in err
    map_client.integrate(room(), pose())
    heights = ("--band", "-0.5", "1.0")
    status, out, _ = run_at(map_server.endpoint, *words, *heights)
    assert status == 0
    assert f"revision {map_client.info().map_revision}" in out
    assert [path.name for path in tmp_path.iterdir()] == ["map.mcap"], "nothing else is left"
    found = messages_of(tmp_path / "map.mcap")
    assert {topic: len(messages) for topic, messages in found.items()} == dict.fromkeys(
        (SURFACES, FREE, UNKNOWN, GRID), 1
    )
    surface = rows(found[SURFACES][0], "x", "y", "z", "sd")
    assert len(surface) > 500
    answer = map_client.occupancy(surface[:, :3])
    assert np.median(np.abs(answer.mean - 0.5)) < 0.1
    sd = np.sqrt(occupancy_var(answer.mean.astype(np.float64), answer.latent_var))
    assert np.median(np.abs(surface[:, 3] - sd)) < 0.05, "between cells it is interpolated"
    free = map_client.occupancy(rows(found[FREE][0], "x", "y", "z"))
    assert free.observed.all()
    assert free.mean.max() < 0.25 + 1e-4
    assert not map_client.occupancy(rows(found[UNKNOWN][0], "x", "y", "z")).observed.any()
    run_at(
        map_server.endpoint,
        "export",
        "pgm",
        "--resolution",
        "0.25",
        "-o",
        str(tmp_path / "map.pgm"),
        *heights,
    )
    pixels, grid = load_map(tmp_path / "map.yaml").data, found[GRID][0]
    percent = np.array(grid.data).reshape(grid.info.height, grid.info.width)
    assert pixels.shape == percent.shape
    assert (percent[pixels == OCCUPIED] >= 65).all()
    assert ((percent[pixels == FREE_PIXEL] >= 0) & (percent[pixels == FREE_PIXEL] <= 25)).all()
    assert (percent == -1).any()


def test_a_planar_map_needs_no_heights(
    run_at: Run, map_server: MapServer, map_client: MapClient, tmp_path: Path
) -> None:
    angle = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    reach = np.minimum(
        3.0 / np.maximum(np.abs(np.cos(angle)), 1e-9), 3.0 / np.maximum(np.abs(np.sin(angle)), 1e-9)
    )
    ring = np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=1).astype(np.float32)
    map_client.integrate(ring, np.eye(4))
    words = ("export", "mcap", "--resolution", "0.1", "-o", str(tmp_path / "map.mcap"))
    assert run_at(map_server.endpoint, *words)[0] == 0
    found = messages_of(tmp_path / "map.mcap")
    walls = rows(found[SURFACES][0], "x", "y", "z")
    assert np.abs(np.abs(walls[:, :2]).max(axis=1) - 3.0).max() < 0.3
    assert max(found[GRID][0].data) > 90


def test_what_a_view_records_plays_again(
    map_server: MapServer, map_client: MapClient, tmp_path: Path
) -> None:
    """A robot's cloud, seen on its way, comes out of the file as a recording with its pose and stamp."""
    map_client.integrate(room(), pose())
    picture, end = BagPicture(tmp_path / "drive.mcap"), threading.Event()
    points, is_return = room(), np.ones(len(room()), np.bool_)
    is_return[::7] = False
    with MapClient(map_server.endpoint) as watching:
        watching.wait_ready()
        view = LiveView(watching, picture, 0.5)
        thread = threading.Thread(target=view.run, args=(end,))
        thread.start()
        try:
            first = map_client.info().map_revision
            until(lambda: view.drawn_revision == first, "the map that was there before")
            for x in (20.0, 21.0):
                map_client.publish(points, pose(x), robot="7-of.9", is_return=is_return, wait=True)
            map_client.flush()
            until(lambda: view.drawn_revision == first + 2, "what the clouds changed")
        finally:
            end.set()
            thread.join()
    picture.close()
    found = messages_of(tmp_path / "drive.mcap")
    assert len(found["/r7_of_9/points"]) == len(found["/tf"]) == 2
    assert found[SURFACES][-1].width > found[SURFACES][0].width > 0
    played = open_bag(tmp_path / "drive.mcap", topic="/r7_of_9/points")
    assert played.notes == ("topic /r7_of_9/points", "poses in 'map' from /tf, /tf_static")
    assert [scan.T_map_sensor[0, 3] for scan in played] == [20.0, 21.0]
    np.testing.assert_array_equal(played[1].points, points[is_return])


def test_clearing_is_written_and_clouds_without_a_pose_are_not(tmp_path: Path) -> None:
    from potclient.watched import WatchedCloud

    picture = BagPicture(tmp_path / "a.mcap")
    cloud = WatchedCloud("r1", 0, 5, np.ones((3, 3), np.float32), np.ones(3, np.bool_), None)
    assert not picture.draw_cloud(cloud)
    picture.at(7 * 10**9)
    picture.forget_tiles()
    picture.close()
    found = messages_of(tmp_path / "a.mcap")
    assert set(found) == {SURFACES, FREE, UNKNOWN}
    assert all(m.width == 0 and m.header.stamp.sec == 7 for (m,) in found.values())
    assert len(read_point_cloud(found[SURFACES][0]).points) == 0


def test_a_file_that_was_not_finished_leaves_nothing(tmp_path: Path) -> None:
    BagPicture(tmp_path / "a.mcap").discard()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("export", "mcap", "-o", "x.bag", "--resolution", "1"), "writes .mcap"),
        (("export", "mcap", "-o", "x.mcap", "--resolution", "1", "--upper", "0", "0", "0"), "whole tiles"),
        (("export", "mcap", "-o", "x.mcap"), "--resolution"),
    ],
)
def test_mistakes_are_said(run_at: Run, map_server: MapServer, words: tuple[str, ...], message: str) -> None:
    status, _, err = run_at(map_server.endpoint, *words)
    assert status == 2
    assert message in err
