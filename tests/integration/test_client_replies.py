"""A `MapClient` and replies that a sound server does not send: errors, lies, garbage, parts that do not fit, silence."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from potclient.client import MapClient
from potclient.errors import (
    BadReplyError,
    IncompleteReplyError,
    InternalError,
    LostReplyError,
    NoServerError,
    OverloadedError,
    PotclientError,
    QueryTimeoutError,
    ReadOnlyError,
    TooLargeError,
)
from potclient.questions.control import CONTROL_TIMEOUT_S
from potschemas import messages
from potschemas.examples import examples
from potschemas.messages import ErrorCode
from potschemas.wire import decode, encode_array

from .conftest import DEADLINE_S
from .rooms import places, pose, room
from .scripted import HOLD, ScriptedServer

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES: dict[str, Any] = examples()
BOX = ([-2, -2, -2], [2, 1, 0.5], 0.5)  # 8 x 6 x 5 cells


@pytest.fixture
def server() -> Iterator[ScriptedServer]:
    with ScriptedServer() as server:
        yield server


@pytest.fixture
def client(server: ScriptedServer) -> Iterator[MapClient]:
    with MapClient(server.endpoint, timeout_s=DEADLINE_S) as client:
        client.wait_ready()
        yield client


def occupancy(values: Any, revision: int = 0) -> messages.Occupancy:
    """Observed points with these means."""
    mean = np.asarray(values, np.float32)
    others = {name: encode_array(np.ones_like(mean)) for name in ("var", "latent_mean", "latent_var")}
    return messages.Occupancy(
        mean=encode_array(mean),
        observed=encode_array(np.ones(len(mean), np.bool_)),
        map_revision=revision,
        **others,
    )


def points_answer(question: bytes) -> messages.Occupancy:
    """The mean is the point's x."""
    query = decode(question, messages.PointsQuery)
    return occupancy(np.frombuffer(query.points.data, "<f8").reshape(-1, 3)[:, 0])


def grid_parts(n_parts: int = 4) -> list[messages.GridPart]:
    """`BOX` in parts of equal size; the mean of a cell is its number."""
    n = 240 // n_parts
    return [
        messages.GridPart(
            part=i,
            n_parts=n_parts,
            shape=[8, 6, 5],
            first_cell=i * n,
            lower=[-2.0, -2.0, -2.0],
            resolution=0.5,
            occupancy=occupancy(np.arange(i * n, (i + 1) * n)),
        )
        for i in range(n_parts)
    ]


def params_parts() -> list[messages.ParamsPart]:
    """Two parts, with two kernels each."""
    kernels = EXAMPLES[messages.Kernels.schema]
    return [messages.ParamsPart(part=i, n_parts=2, map_revision=3, kernels=kernels) for i in range(2)]


def changed(message: Any, **fields: Any) -> Any:
    return msgspec.structs.replace(message, **fields)


# --- errors --------------------------------------------------------------------------------------------------------


def test_every_error_code_has_its_exception(server: ScriptedServer, client: MapClient) -> None:
    codes = list(ErrorCode)
    server.on("integrate", *codes)
    for code in codes:
        with pytest.raises(PotclientError) as caught:
            client.integrate(room(), pose())
        assert getattr(caught.value, "code", None) == code.value
        assert type(caught.value).__name__ != "MapServerError"
        assert (caught.value.retry_after_s == 0.01) == (code is ErrorCode.OVERLOADED)


def test_a_reason_travels_with_its_error(server: ScriptedServer, client: MapClient) -> None:
    server.on(
        "ctl/atoms",
        messages.ErrorReply(code=ErrorCode.READ_ONLY, message="no", reason="closed"),
        ErrorCode.READ_ONLY,
    )
    for reason in ("closed", None):
        with pytest.raises(ReadOnlyError) as caught:
            client.remove_atom("wall.1")
        assert caught.value.reason == reason


def test_a_single_question_to_an_overloaded_server_fails_at_once(
    server: ScriptedServer, client: MapClient
) -> None:
    server.on("points", ErrorCode.OVERLOADED)
    with pytest.raises(OverloadedError) as caught:
        client.occupancy(places(60))
    assert caught.value.retry_after_s == 0.01
    assert server.count("points") == 1


def test_an_overloaded_server_is_asked_again_for_a_part(server: ScriptedServer, client: MapClient) -> None:
    info = EXAMPLES[messages.Info.schema]
    limits = changed(info.limits, max_query_points=5000, max_query_bytes=1 << 20)
    server.on("info", changed(info, limits=limits))
    server.on("points", ErrorCode.OVERLOADED, points_answer)
    queries = places(22_001)
    np.testing.assert_allclose(client.occupancy(queries).mean, queries[:, 0], rtol=1e-6)
    assert server.count("points") == 6, "five parts, one of them asked again"


def test_rays_that_are_too_many_are_halved(server: ScriptedServer, client: MapClient) -> None:
    def answer(question: bytes) -> messages.Rays | ErrorCode:
        query = decode(question, messages.RaysQuery)
        n = query.origins.shape[0]
        if n > 2:
            return ErrorCode.TOO_LARGE
        x = np.frombuffer(query.origins.data, "<f8").reshape(-1, 3)[:, 0].astype(np.float32)
        return rays(x)

    server.on("rays", answer)
    origins = np.arange(30.0).reshape(10, 3)
    np.testing.assert_array_equal(client.rays(origins, np.ones((10, 3)), 10.0).mean_m, origins[:, 0])
    assert server.count("rays") == 2 + 5, "10, 5, then twos"


def test_one_ray_that_is_too_many_is_an_error(server: ScriptedServer, client: MapClient) -> None:
    server.on("rays", ErrorCode.TOO_LARGE)
    with pytest.raises(TooLargeError):
        client.rays(np.zeros((3, 3)), np.ones((3, 3)), 10.0)
    assert server.count("rays") == 2


def test_a_server_bug_is_an_internal_error(server: ScriptedServer, client: MapClient) -> None:
    server.on("grid", ErrorCode.INTERNAL)
    with pytest.raises(InternalError):
        client.grid(*BOX)


# --- parts ---------------------------------------------------------------------------------------------------------


def test_a_grid_is_assembled_from_parts_in_any_order(server: ScriptedServer, client: MapClient) -> None:
    server.on("grid", grid_parts()[::-1])
    progress: list[tuple[int, int]] = []
    grid = client.grid(*BOX, progress=lambda *part: progress.append(part))
    np.testing.assert_array_equal(grid.mean, np.arange(240).reshape(8, 6, 5))
    assert progress == [(i + 1, 4) for i in range(4)]


@pytest.mark.parametrize(
    ("lie", "error", "message"),
    [
        (lambda p: [*p[:1], *p[2:]], IncompleteReplyError, "3 of 4 parts"),
        (lambda p: [*p, p[1]], IncompleteReplyError, "part 1 of 4 came twice"),
        (lambda p: [*p[:3], changed(p[3], part=2**40)], IncompleteReplyError, "has no place"),
        (lambda p: [*p[:3], changed(p[3], n_parts=2**62)], IncompleteReplyError, "n_parts 4 and 4611"),
        (lambda p: [*p[:3], changed(p[3], lower=[0.0, 0.0, 0.0])], IncompleteReplyError, "lower"),
        (lambda p: [*p[:3], changed(p[3], first_cell=0)], IncompleteReplyError, "cells of part 3 came twice"),
        (
            lambda p: [*p[:3], changed(p[3], occupancy=occupancy(np.zeros(60), revision=1))],
            IncompleteReplyError,
            "map_revision 0 and 1",
        ),
        (
            lambda p: [*p[:3], changed(p[3], occupancy=occupancy(np.zeros(59)))],
            IncompleteReplyError,
            "1 cells are missing",
        ),
        (lambda p: [*p[:3], changed(p[3], first_cell=200)], BadReplyError, "ends at cell 260 of 240"),
        (lambda p: [changed(p[0], shape=[80, 60, 50])], BadReplyError, "asked for about"),
    ],
)
def test_a_grid_that_does_not_fit_is_an_error(
    server: ScriptedServer, client: MapClient, lie: Any, error: type[Exception], message: str
) -> None:
    server.on("grid", lie(grid_parts()))
    with pytest.raises(error, match=message):
        client.grid(*BOX)


def test_kernels_come_in_any_order(server: ScriptedServer, client: MapClient) -> None:
    server.on("params", params_parts()[::-1])
    assert [part for part, _, _ in client.params_parts()] == [1, 0]
    assert len(client.params()) == 4


@pytest.mark.parametrize(
    ("lie", "message"),
    [
        (lambda p: p[1:], "1 of 2 parts"),
        (lambda p: [p[1], p[1]], "came twice"),
        (lambda p: [p[0], changed(p[1], map_revision=4)], "map_revision 3 and 4"),
        (lambda p: [changed(part, n_parts=2**62) for part in p], "2 of 4611"),
    ],
)
def test_kernels_that_do_not_fit_are_an_error(
    server: ScriptedServer, client: MapClient, lie: Any, message: str
) -> None:
    server.on("params", lie(params_parts()))
    with pytest.raises(IncompleteReplyError, match=message):
        client.params()


# --- other replies ---------------------------------------------------------------------------------------------------


def rays(mean_m: Any) -> messages.Rays:
    one = np.ones(len(mean_m), np.float32)
    return messages.Rays(
        hit_probability=encode_array(one),
        mean_m=encode_array(np.asarray(mean_m, np.float32)),
        std_m=encode_array(one),
        quantile_m=encode_array(np.ones((len(mean_m), 3), np.float32)),
        unknown_range_m=encode_array(one),
        unknown_share=encode_array(one),
        step_m=0.1,
        map_revision=0,
    )


def test_an_answer_that_is_no_message(server: ScriptedServer, client: MapClient) -> None:
    for op in ("points", "grid"):
        server.on(op, b"\xc1garbage")
    with pytest.raises(BadReplyError):
        client.occupancy(places(60))
    with pytest.raises(BadReplyError):
        client.grid(*BOX)


def test_answers_of_the_wrong_size_are_refused(server: ScriptedServer, client: MapClient) -> None:
    server.on("points", occupancy(np.zeros(59)))
    server.on("rays", rays(np.zeros(0)))
    server.on("risk", EXAMPLES[messages.Risk.schema])
    with pytest.raises(BadReplyError, match="mean"):
        client.occupancy(places(60))
    with pytest.raises(BadReplyError, match=r"rays\."):
        client.rays([0, 0, 0], [[1, 0, 0]], 1.0)
    with pytest.raises(BadReplyError, match=r"risk\."):
        client.risk(np.tile(np.eye(4), (9, 1, 1)), [[0, 0, 0, 1]])


def test_a_server_that_knows_no_gradients_is_told_of(server: ScriptedServer, client: MapClient) -> None:
    server.on("points", points_answer)
    with pytest.raises(BadReplyError, match="older"):
        client.occupancy([[0.0, 0, 0]], with_gradient=True)


# --- silence -------------------------------------------------------------------------------------------------------


def test_a_question_that_is_not_offered(client: MapClient) -> None:
    with pytest.raises(LostReplyError, match="does not offer"):
        client.info()


def test_a_server_that_is_not_warm_yet() -> None:
    with ScriptedServer(ready=False) as server, MapClient(server.endpoint) as client:
        server.on("info", [])
        client.wait_for_match("info", DEADLINE_S)
        with pytest.raises(NoServerError, match="not ready"):
            client.info()
        server.declare_ready()
        assert client.wait_ready(DEADLINE_S) == "scripted"


def test_a_question_that_the_server_drops(server: ScriptedServer, client: MapClient) -> None:
    server.on("points", [])
    client.wait_for_match("points", DEADLINE_S)
    with pytest.raises(LostReplyError, match="access control"):
        client.occupancy(places(60))


def test_a_server_that_thinks_for_ever(server: ScriptedServer, client: MapClient) -> None:
    server.on("points", HOLD)
    with pytest.raises(QueryTimeoutError, match=r"within 0\.1 s") as caught:
        client.occupancy(places(60), timeout_s=0.1)
    assert isinstance(caught.value, TimeoutError)


def test_who_gave_up_on_a_change_of_the_map_is_told_that_it_may_come(
    server: ScriptedServer, client: MapClient
) -> None:
    server.on("merge", HOLD)
    with pytest.raises(QueryTimeoutError, match="look at the map's revision before you ask again"):
        client.merge("north", timeout_s=0.1)


def test_changes_of_the_map_are_waited_for_longer_than_answers(server: ScriptedServer) -> None:
    """A merge that was given up on and asked for again would count twice."""
    server.on("clear", messages.ControlReply(verb="clear", map_revision=1, message="cleared"))
    with MapClient(server.endpoint, timeout_s=0.5) as hasty:
        hasty.control("clear")
        hasty.control("clear", timeout_s=2.0)
    requests = [decode(question, messages.ControlRequest).timeout_s for _, question in server.asked]
    assert requests == [CONTROL_TIMEOUT_S, 2.0]
    assert CONTROL_TIMEOUT_S > 60.0


def test_a_server_that_is_killed_with_the_question_in_flight() -> None:
    program = """
import sys
from tests.integration.scripted import HOLD, ScriptedServer
server = ScriptedServer()
server.on("points", HOLD)
print(server.endpoint, flush=True)
while not server.count("points"):
    pass
print("asked", flush=True)
sys.stdin.read()
"""
    process = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdin is not None
    assert process.stdout is not None
    with process, MapClient(process.stdout.readline().strip(), timeout_s=DEADLINE_S) as client:
        client.wait_ready(DEADLINE_S)
        client.wait_for_match("points", DEADLINE_S)
        errors: list[PotclientError] = []

        def ask() -> None:
            try:
                client.occupancy(places(60))
            except PotclientError as error:
                errors.append(error)

        asking = threading.Thread(target=ask, daemon=True)
        asking.start()
        assert process.stdout.readline() == "asked\n"
        process.kill()
        asking.join(DEADLINE_S)
    assert [type(e) for e in errors] in ([NoServerError], [LostReplyError])
    assert errors[0].retryable
