"""A mirror of a real server's map: what changed is all that travels, and the copy says what the server says."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from potclient import KernelSet, MapClient
from potclient.cli import main
from potclient.datasets import open_dataset
from potclient.errors import NoServerError, UsageError
from potschemas import messages, wire
from potschemas.messages import ErrorCode
from potserver.asking.tiles import Tiles
from potserver.config import load_settings
from potserver.server import MapServer

from .conftest import Client, make_cloud, until
from .scripted import free_port

POINTS = np.random.default_rng(0).uniform([-8, -7, -2], [38, 7, 3], (400, 3))
SETTINGS = {
    "mapping.max_range_m": 12.0,
    "mapping.beams_per_scan": 600,
}


class Site:
    """A server that may be restarted at its endpoint, and a client of it."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.server = self.start()
        self.client = stack.enter_context(MapClient(self.endpoint, timeout_s=30.0))
        self.client.wait_ready(30.0)
        self._n = 0

    def start(self) -> MapServer:
        server = MapServer(load_settings(overrides=SETTINGS), listen=self.endpoint)
        server.start()
        self._stack.callback(server.stop)
        return server

    def scan(self, x_m: float = 0.0) -> None:
        """A small room around a place on the x axis enters the map."""
        cloud = make_cloud()
        pose = np.eye(4)
        pose[0, 3] = x_m
        points = wire.decode_array(cloud.points, "points", dtypes=(messages.DType.FLOAT32,), shape=(None, 3))
        self._n += 1
        self.client.integrate(points, pose, stamp_ns=self._n * 1_000_000_000)

    def tiles(self) -> dict[tuple[int, int, int], int]:
        """The revision of each tile, as the server has it."""
        mapper: Any = self.server.mapper("default")
        tiled = mapper.state.tiled
        return {} if tiled is None else {i: t.revision for i, t in tiled.tiles.items()}

    def lean_bytes(self, among: Iterable[tuple[int, int, int]]) -> int:
        """What the leans of some tiles take; each travels as it is."""
        mapper: Any = self.server.mapper("default")
        leans = [mapper.state.tiled.tiles[index].lean for index in among]
        return sum(lean.nbytes for lean in leans if lean is not None)


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setitem(
        Tiles.plan.__kwdefaults__, "part_kernels", 300
    )  # so that updates come in several parts
    with ExitStack() as stack:
        yield Site(stack)


def assert_says_what_the_server_says(mirror: Any, client: MapClient, points: Any = POINTS) -> None:
    here, there = mirror.occupancy(points), client.occupancy(points)
    assert here.revision == there.revision
    np.testing.assert_allclose(here.mean, there.mean, atol=1e-4)
    np.testing.assert_allclose(here.var, there.var, atol=1e-4)
    assert (
        here.observed != there.observed
    ).mean() < 0.01  # the server leaves out what is far below the threshold


def test_updates_carry_the_tiles_that_changed_and_no_others(site: Site) -> None:
    mirror = site.client.mirror(step=None)
    assert mirror.update().n_kernels == 0
    site.scan()
    first = mirror.update()
    assert (first.n_tiles, first.revision) == (len(site.tiles()), 1)
    assert len(mirror.kernels) == first.n_kernels > 300, "in several parts"
    assert_says_what_the_server_says(mirror, site.client)
    before = site.tiles()

    site.scan(30.0)  # 30 m away: another room, of other tiles
    second = mirror.update()
    changed = {index for index, revision in site.tiles().items() if before.get(index) != revision}
    assert second.n_tiles == len(changed) < len(site.tiles())
    assert second.n_kernels < len(mirror.kernels)
    assert second.n_bytes - site.lean_bytes(changed) < 20 * second.n_kernels
    assert_says_what_the_server_says(mirror, site.client)
    assert mirror.update().is_empty

    whole = site.client.params()
    order, same = (np.lexsort(kernels.hinge_mean.round(4).T) for kernels in (whole, mirror.kernels))
    for name in ("gamma_shape", "gamma_rate", "hinge_var", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(getattr(whole, name)[order], getattr(mirror.kernels, name)[same])


def test_a_map_that_leans_is_mirrored_with_its_lean(site: Site) -> None:
    rng = np.random.default_rng(4)
    ground = np.column_stack([rng.uniform(-9, 9, (500, 2)), np.full(500, -1.6)]).astype(np.float32)
    mirror, short = site.client.mirror(step=None), site.client.mirror()
    for n, x in enumerate((0.0, 0.5, 40.0, 40.5)):
        pose = np.eye(4)
        pose[0, 3] = x
        site.client.integrate(ground, pose, stamp_ns=(n + 1) * 10**9)
        mirror.update()
        points = rng.uniform([x - 9, -9, -2], [x + 9, 9, 3], (500, 3))
        assert_says_what_the_server_says(mirror, site.client, points)
        there = site.client.occupancy(points, with_gradient=True)
        short.update()  # leans that it has come no more
        brief = short.occupancy(points)
        assert (np.abs(brief.borrowed - there.borrowed) < 0.05).mean() > 0.97
        here = mirror.occupancy(points, gradient=True)
        assert (there.borrowed > 0.5).mean() > 0.1
        assert np.abs(there.mean - 0.5)[~there.observed].max() > 0.02
        alike = np.abs(there.borrowed - here.borrowed) < 1e-3
        assert alike.mean() > 0.98
        np.testing.assert_allclose(here.gradient[alike], there.gradient[alike], atol=2e-3)
        own = site.client.occupancy(points, evidence_only=True)
        assert not own.borrowed.any()
        assert (own.mean[~own.observed] == 0.5).all()
        np.testing.assert_allclose(mirror.occupancy(points, evidence_only=True).mean, own.mean, atol=0.02)
        for alone in (False, True):
            rays = site.client.rays(pose[:3, 3], points - pose[:3, 3], 9.0, evidence_only=alone)
            risk = site.client.risk(pose, [0, 0, 0, 2.0], unknown="prior", evidence_only=alone)
            assert rays.borrowed_share.any() != alone
            assert (risk.path_borrowed_share > 0.0) != alone
            assert risk.borrowed_share[0] == pytest.approx(risk.path_borrowed_share, abs=1e-6)
    assert mirror.update().is_empty
    assert "not_leaning.no_ground" not in site.client.stats().counters
    wall = np.column_stack([np.full(500, 6.0), rng.uniform(-6, 6, 500), rng.uniform(1, 5, 500)])
    site.client.integrate(wall.astype(np.float32), pose, stamp_ns=9 * 10**9)
    assert site.client.stats().counters["not_leaning.no_ground"] == 1
    mirror.update()
    whole = site.client.params()
    np.testing.assert_allclose(whole.occupancy(points).mean, mirror.occupancy(points).mean, atol=1e-5)
    cells = site.client.grid([30, -4, -2], [34, 4, 0], 0.5)
    asked = site.client.occupancy(cells.centers().reshape(-1, 3))
    np.testing.assert_allclose(cells.mean.ravel(), asked.mean, atol=1e-5)
    np.testing.assert_allclose(cells.borrowed.ravel(), asked.borrowed, atol=1e-4)
    bare = site.client.grid([30, -4, -2], [34, 4, 0], 0.5, evidence_only=True)
    assert not bare.borrowed.any()


def test_tiles_that_only_leant_get_their_kernels_later(site: Site) -> None:
    """Of such a tile the asker holds no nodes that could change."""
    mirror, drive = site.client.mirror(), open_dataset("town:terraces", max_range_m=25.0)
    mapper: Any = site.server.mapper("default")
    only_leant: set[tuple[int, int, int]] = set()
    grew = 0
    for k in range(0, 100, 20):
        scan = drive[k]
        site.client.integrate(scan.points, scan.T_map_sensor, is_return=scan.is_return)
        mirror.update()
        tiles = mapper.state.tiled.tiles
        grew += sum(len(tiles[index].kernels) > 0 for index in only_leant)
        only_leant = {index for index, tile in tiles.items() if not len(tile.kernels)}
    assert grew > 0
    assert len(mirror.kernels) == sum(len(tile.kernels) for tile in tiles.values())


def test_a_box_is_mirrored_so_that_answers_in_it_are_the_map_s(site: Site) -> None:
    site.scan()
    site.scan(30.0)
    mirror = site.client.mirror([-4, -4, -1], [4, 4, 2], step=None)
    assert mirror.update().n_tiles < len(site.tiles())
    inside = np.random.default_rng(1).uniform([-4, -4, -1], [4, 4, 2], (300, 3))
    assert_says_what_the_server_says(mirror, site.client, inside)
    assert not mirror.occupancy([[30.0, 6.0, 0.0]]).observed.any()


def test_weights_in_steps_take_few_bytes_and_say_nearly_the_same(site: Site) -> None:
    site.scan()
    exact, short = site.client.mirror(step=None), site.client.mirror()
    leans = site.lean_bytes(site.tiles())
    assert short.update().n_bytes - leans < 0.5 * (exact.update().n_bytes - leans)
    site.scan(0.5)  # most nodes stay, and their weights change a little
    assert short.update().n_bytes < 0.4 * exact.update().n_bytes
    here, there = short.occupancy(POINTS), site.client.occupancy(POINTS)
    both = here.observed & there.observed
    change = np.abs(here.mean - there.mean)[both]
    assert 0 < change.max() < 0.02
    np.testing.assert_allclose(here.var[both], there.var[both], atol=0.02)
    assert (here.observed != there.observed).mean() < 0.01


def test_clear_and_restart_begin_another_epoch(site: Site) -> None:
    site.scan()
    mirror = site.client.mirror(step=None)
    first = mirror.update()
    site.client.control("clear")
    cleared = mirror.update()
    assert (cleared.is_whole, cleared.n_removed, len(mirror.kernels)) == (True, first.n_tiles, 0)
    site.scan()
    assert not mirror.update().is_whole

    site.server.stop()
    held = mirror.kernels
    with pytest.raises(NoServerError):
        mirror.update()
    assert mirror.kernels is held, "it answers on while the server is away"
    site.server = site.start()
    site.client.wait_ready(30.0)
    restarted = mirror.update()
    assert restarted.is_whole
    assert len({first.epoch, cleared.epoch, restarted.epoch}) == 3
    assert restarted.revision == 0
    site.scan()
    mirror.update()
    assert_says_what_the_server_says(mirror, site.client)


def test_an_update_while_the_map_changes_is_of_one_revision(site: Site) -> None:
    """What is sent of a tile is what that revision had, whatever the writer does meanwhile."""
    mapper: Any = site.server.mapper("default")
    states = {}
    site.scan()
    states[1] = mapper.state
    done = threading.Event()

    def drive() -> None:
        for step in range(1, 6):
            site.scan(3.0 * step)
            states[step + 1] = mapper.state
        done.set()

    thread = threading.Thread(target=drive)
    thread.start()
    mirror = site.client.mirror(step=None)
    seen: dict[int, KernelSet] = {}
    is_last = False
    while not is_last:
        is_last = done.is_set()
        update = mirror.update()
        seen[update.revision] = mirror.kernels
    thread.join()
    assert len(seen) >= 2
    for revision, kernels in seen.items():
        expected = np.sort(states[revision].snapshot.kernels.weight_mean)
        np.testing.assert_array_equal(np.sort(kernels.weight_mean), expected)


@pytest.mark.parametrize(
    ("query", "code"),
    [
        (messages.TilesQuery(known=wire.pack_array(np.zeros((4, 1), np.int64))), ErrorCode.BAD_MESSAGE),
        (
            messages.TilesQuery(epoch=1, known=wire.pack_array(np.zeros((4, 100_001), np.int64))),
            ErrorCode.TOO_LARGE,
        ),
        (
            messages.TilesQuery(epoch=1, known=wire.pack_array(np.zeros((3, 1), np.int64))),
            ErrorCode.BAD_ARRAY,
        ),
        (messages.TilesQuery(epoch=1, known=wire.pack_array(np.zeros((4, 1)))), ErrorCode.BAD_ARRAY),
        (
            messages.TilesQuery(
                epoch=1,
                known=messages.Packed(dtype=messages.DType.INT64, shape=[4, 2], deflated=b"\x78\x9c\x00"),
            ),
            ErrorCode.BAD_ARRAY,
        ),
        (messages.TilesQuery(lower=[1e9, 0.0, 0.0]), ErrorCode.OUT_OF_RANGE),
        (messages.TilesQuery(step=0.0), ErrorCode.BAD_MESSAGE),
        (messages.TilesQuery(deadline_ms=1e-6), ErrorCode.DEADLINE),
    ],
)
def test_bad_questions_are_refused(real_client: Client, query: messages.TilesQuery, code: ErrorCode) -> None:
    error = real_client.error("tiles", query)
    assert error.code is code
    assert error.message


def test_the_limit_of_known_tiles_is_told(real_client: Client) -> None:
    assert real_client.one("info").limits.max_query_tiles == 100_000


def test_the_client_refuses_what_makes_no_sense(site: Site) -> None:
    for arguments in ({"lower": [0, 0, 0]}, {"margin_m": -1.0}, {"step": 11.0}):
        with pytest.raises(UsageError):
            site.client.mirror(**arguments)


# --- the command ---------------------------------------------------------------------------------------------------


@pytest.fixture
def run(site: Site, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def command(*words: str) -> tuple[int, str, str]:
        status = main(["mirror", *words, "-e", site.endpoint])
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return command


def test_mirror_once_saves_the_map(site: Site, run: Any, tmp_path: Path) -> None:
    site.scan()
    status, out, err = run("--once", "-o", str(tmp_path / "map.npz"))
    saved = KernelSet.load(tmp_path / "map.npz")
    assert status == 0
    assert f"{len(saved)} kernels" in out
    assert "all anew" in out
    assert "wrote" in err
    assert saved.map_revision == 1
    assert len(saved) == len(site.client.params())


def test_mirror_follows_the_map(site: Site, run: Any) -> None:
    site.scan()

    def drive() -> None:
        until(lambda: site.client.stats().counters.get("queries.tiles.ok"), "the first update")
        site.scan(30.0)

    thread = threading.Thread(target=drive)
    thread.start()
    status, out, _ = run("--updates", "2", "--json", "--seconds", "60")
    thread.join()
    first, second = map(json.loads, out.splitlines())
    assert status == 0
    assert (first["revision"], first["is_whole"], first["n_kernels"]) == (1, True, first["held_kernels"])
    assert (second["revision"], second["is_whole"]) == (2, False)
    assert 0 < second["n_kernels"] < second["held_kernels"]
    assert second["ms"] > 0


def test_mirror_without_a_server_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mirror", "--once", "-e", f"tcp/127.0.0.1:{free_port()}"]) == 1
    assert "no" in capsys.readouterr().err
