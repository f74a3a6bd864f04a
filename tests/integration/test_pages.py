"""A server whose map lies on pages says what one says that has it in memory, to the bit, and keeps as much."""

from __future__ import annotations

import os
import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient import MapClient, MapDamagedError
from potschemas import messages, wire
from potserver.config import load_settings
from potserver.server import MapServer

from .conftest import Client, drain, make_cloud, until

POINTS = np.random.default_rng(0).uniform([-8, -7, -2], [128, 7, 3], (500, 3))
PLACES_M = (0.0, 40.0, 80.0, 120.0, 1.0, 41.0)
ROOM = wire.decode_array(make_cloud().points, "points", dtypes=(messages.DType.FLOAT32,), shape=(None, 3))


class Site:
    """A server and its client."""

    def __init__(self, stack: ExitStack, folder: Path | str, **changes: Any) -> None:
        settings = {
            "mapping.max_range_m": 12.0,
            "mapping.beams_per_scan": 600,
            "threads": 1,
            "store.directory": str(folder),
            **{key.replace("__", "."): value for key, value in changes.items()},
        }
        self.server = MapServer(load_settings(overrides=settings), listen="tcp/127.0.0.1:0")
        self.server.start()
        stack.callback(self.server.stop)
        self.client = stack.enter_context(MapClient(self.server.endpoint, timeout_s=60.0))

    def drive(self, robot: str = "r1", y_m: float = 0.0) -> None:
        """One room after another enters the map, and some twice."""
        for seq, x_m in enumerate(PLACES_M):
            pose = np.eye(4)
            pose[:2, 3] = x_m, y_m
            self.client.integrate(ROOM, pose, robot=robot, stamp_ns=(seq + 1) * 1_000_000_000)

    def says(self) -> dict[str, Any]:
        """All kinds of answers about the map."""
        points = self.client.occupancy(POINTS)
        grid = self.client.grid([-8, -7, 0], [48, 7, 1], resolution=0.5)
        rays = self.client.rays(np.zeros((8, 3)), np.eye(3)[np.arange(8) % 3], 60.0)
        mirror = self.client.mirror()
        mirror.update()
        mirrored = mirror.occupancy(POINTS)
        kernels = self.client.params()
        return {
            "points": (points.mean, points.var, points.latent_mean, points.latent_var, points.observed),
            "grid": (grid.mean, grid.var),
            "rays": (rays.mean_m,),
            "mirror": (mirrored.mean, mirrored.var),
            "params": (kernels.hinge_mean, kernels.weight_mean, kernels.weight_var),
        }


def assert_same(one: dict[str, Any], other: dict[str, Any]) -> None:
    for question, arrays in one.items():
        for a, b in zip(arrays, other[question], strict=True):
            np.testing.assert_array_equal(a, b, err_msg=question)


def test_pages_change_no_answer_and_survive_what_a_store_survives(tmp_path: Path) -> None:
    with ExitStack() as stack:
        memory = Site(stack, "")
        paged = Site(stack, tmp_path / "store", limits__max_resident_bytes=1)
        for site in (memory, paged):
            site.drive()
        file = paged.server._stores["default"]._pages.file  # type: ignore[union-attr]
        assert file.n_bytes > 1_000_000
        wanted = memory.says()
        assert_same(wanted, paged.says())
        paged.client.save("kept")
        shutil.copytree(tmp_path / "store", tmp_path / "killed")  # as a kill would leave it now
        for site in (memory, paged):
            site.drive("r2", y_m=3.0)
        with_both = memory.says()
        assert_same(with_both, paged.says())
        for site in (memory, paged):
            site.client.forget("r2")
        assert_same(memory.says(), paged.says())
        paged.client.load("kept")
        assert_same(wanted, paged.says())
        paged.drive("r2", y_m=3.0)
        assert_same(with_both, paged.says())
    for folder, found in ((tmp_path / "killed", wanted), (tmp_path / "store", with_both)):
        with ExitStack() as stack:
            again = Site(stack, folder, limits__max_resident_bytes=1)
            assert again.server._stores["default"]._pages.file.n_bytes > 1_000_000  # type: ignore[union-attr]
            assert_same(found, again.says())
        with ExitStack() as stack:
            assert_same(
                found, Site(stack, folder, store__read_only=True, limits__max_resident_bytes=1).says()
            )


def test_pages_that_the_disk_refuses_stay_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> int:
        raise OSError(28, "No space left on device")

    with ExitStack() as stack:
        site = Site(stack, tmp_path / "store", limits__max_resident_bytes=1)
        monkeypatch.setattr("potserver.domain.pages.os.pwrite", refuse)
        site.drive()
        until(  # a scan's receipt is sent before its pages
            lambda: site.client.stats().counters["store.pages_failed"] == len(PLACES_M), "refused pages"
        )
        assert site.client.info().n_scans == len(PLACES_M)
        monkeypatch.undo()
        answer = site.client.occupancy(POINTS)
        site.drive("r2", y_m=3.0)
        assert site.server._stores["default"]._pages.file.n_bytes > 1_000_000  # type: ignore[union-attr]
        assert answer.observed.any()


def test_a_map_that_cannot_be_read_back_is_never_answered_from(tmp_path: Path) -> None:
    """Not a question, not a cloud, not a verb; and a restart has all that was acknowledged."""
    with ExitStack() as stack:
        site = Site(stack, tmp_path / "store", limits__max_resident_bytes=1)
        site.drive()
        wanted = site.says()
        file = site.server._stores["default"]._pages.file  # type: ignore[union-attr]
        os.ftruncate(file._fd, 0)
        ask = site.client
        for refused in (
            lambda: ask.occupancy(POINTS),
            lambda: ask.grid([-8, -7, 0], [48, 7, 1], resolution=0.5),
            lambda: ask.rays(np.zeros((8, 3)), np.eye(3)[np.arange(8) % 3], 60.0),
            ask.params,
            lambda: ask.mirror().update(),
            lambda: ask.integrate(ROOM, np.eye(4), robot="r1"),
            lambda: ask.save("bad"),
            lambda: ask.forget("r1"),
        ):
            with pytest.raises(MapDamagedError, match="restart the server"):
                refused()
        counters = ask.stats().counters
        assert counters["queries.points.map_damaged"] == 1
        assert counters["clouds.dropped.map_damaged"] == 1
        assert counters["control.save.map_damaged"] == 1
        assert (ask.stats().state, ask.info().n_scans) == ("damaged", len(PLACES_M))
    assert not (tmp_path / "store" / "saved" / "default" / "bad.map").exists()
    with ExitStack() as stack:
        again = Site(stack, tmp_path / "store")
        assert again.server.state == "serving"
        assert_same(wanted, again.says())


def test_a_robot_with_its_share_of_the_map_is_refused_and_no_other(tmp_path: Path) -> None:
    with ExitStack() as stack:
        site = Site(stack, "", limits__max_robot_bytes=1)
        client = Client(site.server.endpoint)
        stack.callback(client.close)
        receipts = client.receipts("*")
        client.one("integrate", make_cloud(seq=1, robot="r1"))
        client.put_cloud(make_cloud(seq=2), robot="r1")
        client.put_cloud(make_cloud(seq=1), robot="r2")
        refused, taken = sorted(drain(receipts, 2), key=lambda r: r.seq, reverse=True)
        assert (refused.status.value, refused.reason) == ("rejected", "map_full")
        assert "from r1, the limit is 1 (limits.max_robot_bytes)" in refused.message
        assert taken.status.value == "accepted"
        counters = client.stats().counters
        assert (counters["maps.shares_full"], counters["clouds.rejected.map_full"]) == (1, 1)
        client.control("forget", messages.ControlRequest(robot="r1"))
        client.put_cloud(make_cloud(seq=3), robot="r1")
        assert drain(receipts, 1)[0].status.value == "accepted"
