"""Every kind of bad input: a typed error or receipt with its reason, a counter, and the map as it was."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgpack
import numpy as np
import pytest

from potclient.kernels import KernelSet
from potschemas import messages, wire
from potschemas.messages import ErrorCode, ReceiptStatus

from .conftest import Client, make_cloud, points_query

PROBES = points_query(np.random.default_rng(1).uniform(-7, 7, (50, 3)))
CLOUD = wire.encoding_of(messages.Cloud)


def _array(array: Any, dtype: Any = np.float32) -> messages.Array:
    return wire.encode_array(np.asarray(array, dtype))


def _points(value: float) -> messages.Array:
    points = np.ones((20, 3), np.float32)
    points[7, 1] = value
    return wire.encode_array(points)


def _pose(change: Callable[[np.ndarray[Any, Any]], None]) -> messages.Array:
    pose = np.eye(4)
    change(pose)
    return wire.encode_array(pose)


def _set(index: Any, value: Any) -> Callable[[np.ndarray[Any, Any]], None]:
    def change(pose: np.ndarray[Any, Any]) -> None:
        pose[index] = value

    return change


def _scale(pose: np.ndarray[Any, Any]) -> None:
    pose[:3, :3] *= 1.1


def _with(**changes: Any) -> bytes:
    return wire.encode(make_cloud(robot="r1", **changes))


def _without(field: str) -> bytes:
    tree = msgpack.unpackb(_with())
    del tree[field]
    return bytes(msgpack.packb(tree))


def _instead(**changes: Any) -> bytes:
    return bytes(msgpack.packb(msgpack.unpackb(_with()) | changes))


def _nested(depth: int) -> bytes:
    return b"\x81\xa3seq" + b"\x91" * depth + b"\x01"


def _short(array: messages.Array) -> messages.Array:
    return messages.Array(dtype=array.dtype, shape=array.shape, data=array.data[:-4])


BAD_CLOUDS: dict[str, tuple[bytes, ErrorCode]] = {
    "nan points": (_with(points=_points(np.nan)), ErrorCode.BAD_POINTS),
    "infinite points": (_with(points=_points(-np.inf)), ErrorCode.BAD_POINTS),
    "no points": (_with(points=_array(np.zeros((0, 3)))), ErrorCode.EMPTY),
    "no points in range": (_with(points=_array(np.full((5, 3), 1e-3))), ErrorCode.EMPTY),
    "too many points": (_with(points=_array(np.ones((5001, 3)))), ErrorCode.TOO_LARGE),
    "too many bytes": (_with(points=_array(np.ones((20_000, 3)))), ErrorCode.TOO_LARGE),
    "far points": (_with(points=_points(2e6)), ErrorCode.OUT_OF_RANGE),
    "points beyond float32": (
        _with(points=_array([[1e300, 0, 0]] * 9, np.float64)),
        ErrorCode.OUT_OF_RANGE,
    ),
    "far pose": (_with(T_map_sensor=_pose(_set((0, 3), 2e6))), ErrorCode.OUT_OF_RANGE),
    "far after the pose": (
        _with(T_map_sensor=_pose(_set((1, 3), 999_900)), points=_points(900)),
        ErrorCode.OUT_OF_RANGE,
    ),
    "integer points": (_with(points=_array(np.ones((9, 3)), np.int64)), ErrorCode.BAD_ARRAY),
    "four columns": (_with(points=_array(np.ones((9, 4)))), ErrorCode.BAD_ARRAY),
    "flat points": (_with(points=_array(np.ones(9))), ErrorCode.BAD_ARRAY),
    "missing bytes": (_with(points=_short(_array(np.ones((9, 3))))), ErrorCode.BAD_ARRAY),
    "is_return of another length": (_with(is_return=_array(np.ones(3), bool)), ErrorCode.BAD_ARRAY),
    "is_return as numbers": (_with(is_return=_array(np.ones(600), np.uint8)), ErrorCode.BAD_ARRAY),
    "sheared pose": (_with(T_map_sensor=_pose(_set((0, 1), 0.2))), ErrorCode.BAD_POSE),
    "mirrored pose": (_with(T_map_sensor=_pose(_set((2, 2), -1.0))), ErrorCode.BAD_POSE),
    "scaled pose": (_with(T_map_sensor=_pose(_scale)), ErrorCode.BAD_POSE),
    "nan pose": (_with(T_map_sensor=_pose(_set((0, 3), np.nan))), ErrorCode.BAD_POSE),
    "infinite pose": (_with(T_map_sensor=_pose(_set((0, 3), np.inf))), ErrorCode.BAD_POSE),
    "projective pose": (_with(T_map_sensor=_pose(_set((3, 0), 0.5))), ErrorCode.BAD_POSE),
    "pose of three rows": (_with(T_map_sensor=_array(np.eye(4)[:3], np.float64)), ErrorCode.BAD_ARRAY),
    "pose in float32": (_with(T_map_sensor=_array(np.eye(4))), ErrorCode.BAD_ARRAY),
    "no pose": (_with(T_map_sensor=None), ErrorCode.NO_POSE),
    "truncated": (_with()[:-100], ErrorCode.BAD_MESSAGE),
    "one byte": (b"\xc1", ErrorCode.BAD_MESSAGE),
    "nothing": (b"", ErrorCode.BAD_MESSAGE),
    "random bytes": (np.random.default_rng(3).bytes(3000), ErrorCode.BAD_MESSAGE),
    "deeply nested": (_nested(5000), ErrorCode.BAD_MESSAGE),
    "bytes after the end": (_with() + b"\x00", ErrorCode.BAD_MESSAGE),
    "a huge length": (b"\xdd\xff\xff\xff\xff", ErrorCode.BAD_MESSAGE),
    "an extension type": (b"\xc7\x02\x05ab", ErrorCode.BAD_MESSAGE),
    "no stamp": (_without("stamp_ns"), ErrorCode.BAD_MESSAGE),
    "no points field": (_without("points"), ErrorCode.BAD_MESSAGE),
    "negative seq": (_instead(seq=-4), ErrorCode.BAD_MESSAGE),
    "text for a number": (_instead(stamp_ns="now"), ErrorCode.BAD_MESSAGE),
    "illegal robot": (_instead(robot="R 1/"), ErrorCode.BAD_MESSAGE),
    "unknown dtype": (
        _instead(points={"dtype": "|O8", "shape": [1, 3], "data": b"x" * 24}),
        ErrorCode.BAD_ARRAY,
    ),
    "negative shape": (
        _instead(points={"dtype": "<f4", "shape": [-1, 3], "data": b""}),
        ErrorCode.BAD_ARRAY,
    ),
}


def _state(client: Client) -> tuple[Any, ...]:
    info = client.one("info")
    answers = client.one("points", PROBES)
    return info.map_revision, info.n_kernels, info.n_scans, answers


@pytest.mark.parametrize("name", BAD_CLOUDS)
def test_a_bad_cloud_gets_its_reason_and_leaves_the_map(real_client: Client, name: str) -> None:
    payload, code = BAD_CLOUDS[name]
    before, counted = _state(real_client), real_client.stats().counters
    receipts = real_client.receipts("r1")

    real_client.put(real_client.keys.cloud("r1"), payload, CLOUD)
    receipt = receipts.get(timeout=30)
    assert (receipt.status, receipt.reason) == (ReceiptStatus.REJECTED, code.value)
    assert receipt.message
    assert receipt.robot == "r1"

    error = real_client.error("integrate", payload, encoding=CLOUD)
    assert error.code is code
    assert not error.retryable

    after = real_client.stats().counters
    assert after["clouds.received"] == counted["clouds.received"] + 2
    counter = f"clouds.rejected.{code.value}"
    assert after[counter] == counted.get(counter, 0) + 2
    assert _state(real_client) == before
    assert receipts.empty(), "one receipt a cloud"


@pytest.mark.parametrize("name", ["nan points", "negative seq", "too many bytes"])
def test_a_receipt_says_which_cloud_it_is_about_where_that_can_be_read(
    real_client: Client, name: str
) -> None:
    receipts = real_client.receipts("r1")
    payload, _ = BAD_CLOUDS[name]
    real_client.put(real_client.keys.cloud("r1"), payload, CLOUD)
    assert receipts.get(timeout=30).seq == (0 if name == "nan points" else -1)


def test_an_illegal_robot_id_in_the_key_is_an_unknown_robot(real_client: Client) -> None:
    receipts = real_client.receipts("Robot!")
    real_client.put_cloud(make_cloud(seq=8), robot="Robot!")
    receipt = receipts.get(timeout=30)
    assert (receipt.status, receipt.reason, receipt.seq) == (ReceiptStatus.REJECTED, "unknown_robot", 8)


def test_a_cloud_that_names_another_robot_than_its_key_is_refused(real_client: Client) -> None:
    receipts = real_client.receipts("r1")
    real_client.put_cloud(make_cloud(robot="r2"), robot="r1")
    assert receipts.get(timeout=30).reason == "bad_message"


def test_a_robot_integrates_on_its_own_key_alone(real_client: Client) -> None:
    (error,) = real_client.get(real_client.keys.integrate("r1"), make_cloud(robot="r2"))
    assert error.code is ErrorCode.BAD_MESSAGE
    assert "its key says 'r1'" in error.message
    (error,) = real_client.get(real_client.keys.integrate("R 1"), make_cloud())
    assert error.code is ErrorCode.UNKNOWN_ROBOT
    assert real_client.one("integrate", make_cloud(seq=70)).robot == "r1"


def test_keys_that_moved_say_where_to(real_client: Client) -> None:
    (error,) = real_client.get(real_client.keys.query("integrate"), make_cloud(robot="r1"))
    assert error.code is ErrorCode.UNSUPPORTED
    assert "in/<robot>/integrate" in error.message
    remove = messages.AtomsQuery(action=messages.AtomsAction.REMOVE, atom_id="a")
    error = real_client.error("atoms", remove)
    assert error.code is ErrorCode.UNSUPPORTED
    assert "ctl/atoms" in error.message
    error = real_client.control("atoms", messages.AtomsQuery())
    assert error.code is ErrorCode.UNSUPPORTED
    assert "q/atoms" in error.message


@pytest.mark.parametrize("encoding", ["application/msgpack;pot.cloud.v2", "application/json", "text/plain"])
def test_another_schema_is_refused_before_it_is_read(real_client: Client, encoding: str) -> None:
    receipts = real_client.receipts("r1")
    real_client.put(real_client.keys.cloud("r1"), _with(), encoding)
    assert receipts.get(timeout=30).reason == "bad_message"
    assert real_client.error("integrate", _with(), encoding=encoding).code is ErrorCode.BAD_MESSAGE
    assert real_client.error("points", wire.encode(PROBES), encoding=encoding).code is ErrorCode.BAD_MESSAGE


def test_a_message_without_an_encoding_is_taken_for_what_its_key_says(real_client: Client) -> None:
    (answer,) = real_client.ask("points", wire.encode(PROBES), encoding=None)
    assert isinstance(answer, messages.Occupancy)


def test_an_old_number_is_refused_and_a_higher_one_is_not(real_client: Client) -> None:
    first = real_client.one("integrate", make_cloud(seq=50, robot="clock"))
    for seq in (50, 49):
        assert real_client.error("integrate", make_cloud(seq=seq, robot="clock")).code is ErrorCode.OLD_SEQ
    receipts = real_client.receipts("clock")
    real_client.put_cloud(make_cloud(seq=50), robot="clock")
    assert receipts.get(timeout=30).reason == "old_seq"
    assert real_client.one("info").map_revision == first.map_revision
    assert real_client.one("integrate", make_cloud(seq=51, robot="clock")).map_revision > first.map_revision


def _grid(**changes: Any) -> messages.GridQuery:
    return messages.GridQuery(**{"lower": [0.0, 0, 0], "upper": [2.0, 2, 1], "resolution": 0.5} | changes)


BAD_QUERIES: dict[str, tuple[str, Any, ErrorCode]] = {
    "nan points": ("points", points_query([[np.nan, 0, 0]]), ErrorCode.BAD_POINTS),
    "infinite points": ("points", points_query([[np.inf, 0, 0]]), ErrorCode.BAD_POINTS),
    "far points": ("points", points_query([[1e7, 0, 0]]), ErrorCode.OUT_OF_RANGE),
    "too many points": ("points", points_query(np.zeros((2001, 3))), ErrorCode.TOO_LARGE),
    "oversize": ("points", points_query(np.zeros((10_000, 3))), ErrorCode.TOO_LARGE),
    "four columns": ("points", points_query(np.zeros((5, 4))), ErrorCode.BAD_ARRAY),
    "no deadline at all": ("points", points_query(np.zeros((5, 3)), deadline_ms=-1.0), ErrorCode.BAD_MESSAGE),
    "nan deadline": ("points", points_query(np.zeros((5, 3)), deadline_ms=np.nan), ErrorCode.BAD_MESSAGE),
    "random bytes": ("points", b"\x93\xff\x00", ErrorCode.BAD_MESSAGE),
    "no payload": ("points", None, ErrorCode.BAD_MESSAGE),
    "another message": ("points", wire.encode(_grid()), ErrorCode.BAD_MESSAGE),
    "zero resolution": ("grid", _grid(resolution=0.0), ErrorCode.BAD_MESSAGE),
    "negative resolution": ("grid", _grid(resolution=-0.1), ErrorCode.BAD_MESSAGE),
    "nan resolution": ("grid", _grid(resolution=np.nan), ErrorCode.BAD_MESSAGE),
    "infinite resolution": ("grid", _grid(resolution=np.inf), ErrorCode.BAD_MESSAGE),
    "tiny resolution": ("grid", _grid(resolution=1e-308), ErrorCode.TOO_LARGE),
    "too many cells": ("grid", _grid(resolution=0.01), ErrorCode.TOO_LARGE),
    "inverted box": ("grid", _grid(lower=[3.0, 0, 0]), ErrorCode.BAD_POINTS),
    "nan corner": ("grid", _grid(lower=[np.nan, 0, 0]), ErrorCode.BAD_MESSAGE),
    "infinite corner": ("grid", _grid(upper=[np.inf, 1, 1]), ErrorCode.BAD_MESSAGE),
    "far corner": ("grid", _grid(upper=[1e7, 1, 1]), ErrorCode.OUT_OF_RANGE),
    "flat corner": ("grid", msgpack.packb({"lower": [0.0], "upper": [1.0], "resolution": 1.0}), ErrorCode.BAD_MESSAGE),
    "nan corner of params": ("params", messages.ParamsQuery(lower=[np.nan, 0, 0]), ErrorCode.BAD_MESSAGE),
    "unknown atom": ("atoms", messages.AtomsQuery(atom_id="none-such"), ErrorCode.UNKNOWN_ATOM),
    "unknown operation": ("volume", None, ErrorCode.UNSUPPORTED),
    "a wild operation": ("*", None, ErrorCode.UNSUPPORTED),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_QUERIES)
def test_a_bad_query_gets_its_code(real_client: Client, name: str) -> None:
    op, payload, code = BAD_QUERIES[name]
    before, counted = _state(real_client), real_client.stats().counters
    error = real_client.error(op, payload)
    assert error.code is code, error.message
    assert not error.retryable
    counter = f"queries.{op if op.isalpha() and op != 'volume' else 'unknown'}.{code.value}"
    assert real_client.stats().counters[counter] == counted.get(counter, 0) + 1
    assert _state(real_client) == before


def test_good_queries_still_work_after_all_that(real_client: Client) -> None:
    parts = real_client.ask("grid", _grid(lower=[-7.0, -7, -2], upper=[7.0, 7, 4], resolution=0.25))
    assert all(isinstance(part, messages.GridPart) for part in parts)
    assert sorted(part.part for part in parts) == list(range(parts[0].n_parts))
    assert parts[0].n_parts == 2
    assert sum(part.occupancy.mean.shape[0] for part in parts) == 56 * 56 * 24
    kernels = [part.kernels.weight_mean.shape[0] for part in real_client.ask("params")]
    assert sum(kernels) == real_client.one("info").n_kernels > 0
    listed = real_client.one("atoms").atoms
    atom = real_client.one("atoms", messages.AtomsQuery(atom_id=listed[0].atom_id))
    assert atom.info == listed[0]


def test_planar_clouds_and_float64_points_are_taken(real_client: Client) -> None:
    angle = np.linspace(-np.pi, np.pi, 300)
    flat = np.stack([4 * np.cos(angle), 4 * np.sin(angle)], axis=1)
    receipt = real_client.one(
        "integrate",
        make_cloud(robot="flat", points=wire.encode_array(flat), is_return=_array(angle < 2, bool)),
    )
    assert receipt.status is ReceiptStatus.ACCEPTED
    assert receipt.n_points == 300
    assert receipt.kernels is not None
    assert len(KernelSet.from_message(receipt.kernels)) == receipt.n_kernels > 0
