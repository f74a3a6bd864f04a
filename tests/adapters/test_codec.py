"""Bytes to domain objects and back."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potschemas import messages, wire
from potschemas.answers import AnswerRule
from potschemas.messages import DType, ErrorCode, ReceiptStatus
from potserver import errors
from potserver.adapters import codec
from potserver.domain.types import (
    Atom,
    KernelSet,
    MapUpdate,
    Occupancy,
    Scan,
    SectorMatch,
    TileChange,
)
from potserver.errors import PotserverError, error_classes
from potserver.limits import Limits

RULE = AnswerRule(observed_activation=0.05, prior_var=50.0, residual_var=20.0, mean_moderation=0.25)
LIMITS = Limits(max_cloud_bytes=10_000, max_cloud_points=100, max_query_points=50, max_coordinate_m=1000.0)


def no_pose(robot_id: str, stamp_ns: int) -> Any:
    raise errors.NoPoseError(f"{robot_id} at {stamp_ns}")


def cloud(**changes: Any) -> bytes:
    fields: dict[str, Any] = {
        "seq": 3,
        "stamp_ns": 17,
        "points": wire.encode_array(np.ones((5, 3), np.float32)),
        "T_map_sensor": wire.encode_array(np.eye(4)),
    }
    return wire.encode(messages.Cloud(**fields | changes))


def decode(payload: bytes, robot_id: str | None = "r1", pose_at: Any = no_pose) -> Scan:
    return codec.decode_cloud(payload, robot_id=robot_id, limits=LIMITS, pose_at=pose_at)


def outcome(read: Callable[[bytes], Any], payload: bytes) -> str:
    """The code of the error, or `ok`; anything but a typed error is raised."""
    try:
        read(payload)
    except PotserverError as error:
        return error.code
    return "ok"


def array(of: messages.Array) -> np.ndarray[Any, Any]:
    return wire.decode_array(of, "array", dtypes=tuple(DType), shape=(None,) * len(of.shape))


def kernels(k: int = 4, at: float = 0.0) -> KernelSet:
    rng = np.random.default_rng(k)
    positive = rng.uniform(0.5, 2, (4, k)).astype(np.float32)
    return KernelSet(
        hinge_mean=at + rng.normal(size=(k, 3)) * 10,
        hinge_var=rng.uniform(0, 1, (k, 3)).astype(np.float32),
        gamma_shape=positive[0],
        gamma_rate=positive[1],
        weight_mean=positive[2],
        weight_var=positive[3],
    )


# --- errors -------------------------------------------------------------------------------------------------


def test_every_code_has_one_class_and_every_class_a_code() -> None:
    assert set(error_classes()) == {code.value for code in ErrorCode}
    for code, kind in error_classes().items():
        assert kind.code == code
    for _, kind in inspect.getmembers(errors, inspect.isclass):
        if issubclass(kind, PotserverError):
            ErrorCode(kind.code)


@pytest.mark.parametrize("code", ErrorCode)
def test_errors_travel_by_code(code: ErrorCode) -> None:
    error = error_classes()[code.value]("because", retry_after_s=0.5)
    reply = wire.decode(codec.encode_error(error).payload, messages.ErrorReply)
    assert reply == messages.ErrorReply(
        code=code, message="because", retryable=error.retryable, retry_after_s=0.5
    )


def test_only_load_shutdown_and_a_full_disk_are_worth_another_try() -> None:
    retryable = {code for code, kind in error_classes().items() if kind.retryable}
    assert retryable == {"overloaded", "deadline", "shutting_down", "storage"}
    assert codec.refusal(errors.OverloadedError("")) is ReceiptStatus.DROPPED
    assert codec.refusal(errors.BadPoseError("")) is ReceiptStatus.REJECTED


@pytest.mark.parametrize("code", [ErrorCode.TOO_LARGE, ErrorCode.BAD_MESSAGE, ErrorCode.BAD_ARRAY])
def test_wire_errors_become_typed_ones(code: ErrorCode, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise wire.WireError(code, "text")

    monkeypatch.setattr(wire, "decode", fail)
    with pytest.raises(error_classes()[code.value], match="text"):
        decode(cloud())


# --- clouds -------------------------------------------------------------------------------------------------


def test_a_cloud_becomes_a_scan() -> None:
    pose = np.eye(4)
    pose[:3, 3] = (1, 2, 3)
    echoes = np.array([True, False, True, True, True])
    scan = decode(
        cloud(T_map_sensor=wire.encode_array(pose), is_return=wire.encode_array(echoes), robot="r1")
    )
    assert (scan.robot_id, scan.seq, scan.stamp_ns, scan.is_planar) == ("r1", 3, 17, False)
    np.testing.assert_array_equal(scan.T_map_sensor, pose)
    np.testing.assert_array_equal(scan.is_return, echoes)
    assert scan.points.dtype == np.float32


def test_without_is_return_all_beams_returned() -> None:
    assert decode(cloud()).is_return.all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_two_columns_are_a_planar_scan_with_z_zero(dtype: Any) -> None:
    scan = decode(cloud(points=wire.encode_array(np.full((5, 2), 1.5, dtype))))
    assert scan.is_planar
    np.testing.assert_array_equal(scan.points, np.array([[1.5, 1.5, 0]] * 5, np.float32))


def test_a_cloud_without_a_pose_asks_for_one() -> None:
    asked = []

    def pose_at(robot_id: str, stamp_ns: int) -> Any:
        asked.append((robot_id, stamp_ns))
        return np.eye(4)

    decode(cloud(T_map_sensor=None), pose_at=pose_at)
    assert asked == [("r1", 17)]


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (np.zeros((0, 3)), errors.EmptyError),
        (np.ones((101, 3)), errors.TooLargeError),
        (np.ones((5, 4)), errors.ShapeError),
        (np.ones(5), errors.ShapeError),
        (np.ones((5, 3), np.int64), errors.ShapeError),
        (np.array([[1.0, np.nan, 0]]), errors.BadPointsError),
        (np.array([[1.0, np.inf, 0]]), errors.BadPointsError),
        (np.array([[1.0, np.nan, 1e9]]), errors.BadPointsError),
        (np.array([[1.0, -1001, 0]]), errors.OutOfRangeError),
        (np.array([[1.0, 1e300, 0]]), errors.OutOfRangeError),
    ],
)
def test_bad_points_have_their_class(points: Any, error: type[PotserverError]) -> None:
    with pytest.raises(error):
        decode(cloud(points=wire.encode_array(points)))


@given(st.floats(-999, 999), st.floats(-0.99, 0.99), st.integers(0, 3))
def test_the_bound_is_on_placed_coordinates(x: float, c: float, axis: int) -> None:
    """The cheap bound never refuses what the exact one takes, and the other way round."""
    pose = np.eye(4)
    s = np.sqrt(1 - c * c)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[axis % 3, 3] = x
    points = np.array([[400.0, 30.0, 5.0]], np.float32)
    placed = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    payload = cloud(points=wire.encode_array(points), T_map_sensor=wire.encode_array(pose))
    if np.abs(placed).max() > LIMITS.max_coordinate_m:
        with pytest.raises(errors.OutOfRangeError):
            decode(payload)
    else:
        decode(payload)


def test_the_robot_of_the_key_and_of_the_message_must_agree() -> None:
    assert decode(cloud(robot="r2"), robot_id=None).robot_id == "r2"
    with pytest.raises(errors.BadMessageError, match="needs the field `robot`"):
        decode(cloud(), robot_id=None)
    with pytest.raises(errors.BadMessageError, match="its key says"):
        decode(cloud(robot="r2"), robot_id="r1")


def test_too_many_bytes_are_not_parsed() -> None:
    with pytest.raises(errors.TooLargeError):
        decode(b"\xc1" * 10_001)


def test_the_number_of_a_bad_cloud_is_read_where_it_can_be() -> None:
    assert codec.decode_cloud_head(cloud(robot="r9")) == (3, "r9")
    assert codec.decode_cloud_head(cloud(points=wire.encode_array(np.ones(2, np.int64)))).seq == 3
    assert codec.decode_cloud_head(cloud()[:-1]) == (codec.UNKNOWN_SEQ, None)
    assert codec.decode_cloud_head(b"") == (codec.UNKNOWN_SEQ, None)


@given(st.binary(max_size=300))
def test_random_bytes_are_only_ever_typed_errors(payload: bytes) -> None:
    for read in (
        decode,
        codec.decode_pose,
        lambda p: codec.decode_points_query(p, LIMITS),
        codec.decode_grid_query,
        codec.decode_params_query,
        lambda p: codec.decode_atoms_query(p, LIMITS),
        codec.read_atom_file,
        codec.decode_info_query,
        codec.decode_stats_query,
        codec.decode_control,
    ):
        assert outcome(read, payload) != "internal"


@given(st.data())
def test_a_changed_byte_is_a_scan_or_a_typed_error(data: st.DataObject) -> None:
    payload = bytearray(cloud(robot="r1"))
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    assert outcome(decode, bytes(payload)) != "internal"


# --- checks before the bytes are touched --------------------------------------------------------------------


def test_sizes_encodings_and_ids() -> None:
    codec.check_size(10, 10, "cloud")
    with pytest.raises(errors.TooLargeError, match="cloud of 11 bytes"):
        codec.check_size(11, 10, "cloud")
    for encoding in (None, "", "zenoh/bytes", "application/msgpack;pot.cloud.v1"):
        codec.check_encoding(encoding, messages.Cloud)
    with pytest.raises(errors.BadMessageError, match=r"pot\.pose\.v1"):
        codec.check_encoding("application/msgpack;pot.pose.v1", messages.Cloud)
    codec.check_robot_id("r1", frozenset())
    codec.check_robot_id("r1", frozenset({"r1"}))
    for robot in ("R1", "", "*", "a/b", "x" * 64, "é"):
        with pytest.raises(errors.UnknownRobotError):
            codec.check_robot_id(robot, frozenset())
    with pytest.raises(errors.UnknownRobotError, match="allow list"):
        codec.check_robot_id("r2", frozenset({"r1"}))


# --- queries ------------------------------------------------------------------------------------------------


def test_an_empty_payload_is_a_message_of_defaults() -> None:
    codec.decode_info_query(b"")
    codec.decode_stats_query(b"")
    assert codec.decode_atoms_query(b"", LIMITS) == (messages.AtomsAction.READ, None, None)
    assert codec.decode_params_query(b"") == (None, None, None)
    assert codec.decode_control(b"") == (None, None, None, None)
    with pytest.raises(errors.BadMessageError):
        codec.decode_grid_query(b"")


def test_points_queries_are_bounded() -> None:
    def query(points: Any) -> bytes:
        return wire.encode(
            messages.PointsQuery(points=wire.encode_array(np.asarray(points)), deadline_ms=5.0)
        )

    request = codec.decode_points_query(query(np.ones((2, 2))), LIMITS)
    assert (request.points.shape, request.deadline_ms) == ((2, 2), 5.0)
    assert codec.decode_points_query(query(np.ones((0, 3))), LIMITS).points.shape == (0, 3)
    with pytest.raises(errors.TooLargeError):
        codec.decode_points_query(query(np.ones((51, 3))), LIMITS)
    with pytest.raises(errors.OutOfRangeError):
        codec.decode_points_query(query(np.full((1, 3), 2000.0)), LIMITS)


def atom(**changes: Any) -> Atom:
    fields: dict[str, Any] = {
        "atom_id": "wall.1",
        "dims": 3,
        "hit_points": np.ones((5, 3), np.float32),
        "free_points": np.zeros((2, 3), np.float32),
        "kernels": kernels(6),
        "radius_m": 20.0,
        "azimuth_width_rad": 1.0,
        "provenance": {"source": "tests"},
    }
    return Atom(**fields | changes)


def atom_message(of: Atom, **changes: Any) -> messages.Atom:
    message = wire.decode(codec.encode_atom(of, {"wall.1": 3}, RULE).payload, messages.Atom)
    return msgspec.structs.replace(message, **changes)


def adding(message: messages.Atom, **changes: Any) -> bytes:
    return wire.encode(messages.AtomsQuery(action=messages.AtomsAction.ADD, atom=message, **changes))


def test_an_atom_to_be_added_comes_back_as_it_was() -> None:
    sent = atom()
    request = codec.decode_atoms_query(adding(atom_message(sent)), LIMITS)
    assert (request.action, request.atom_id) == (messages.AtomsAction.ADD, None)
    received = request.atom
    assert received is not None
    for name in ("atom_id", "dims", "radius_m", "azimuth_width_rad", "provenance"):
        assert getattr(received, name) == getattr(sent, name)
    for name in ("hit_points", "free_points"):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))
    np.testing.assert_allclose(received.kernels.hinge_mean, sent.kernels.hinge_mean, atol=2e-6, rtol=0)
    for name in ("hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(getattr(received.kernels, name), getattr(sent.kernels, name))
    again = codec.read_atom_file(codec.encode_atom(sent, {}, RULE).payload)
    np.testing.assert_array_equal(again.kernels.hinge_mean, received.kernels.hinge_mean)


def test_what_may_be_asked_of_the_atoms() -> None:
    def asked(**fields: Any) -> codec.AtomsRequest:
        return codec.decode_atoms_query(wire.encode(messages.AtomsQuery(**fields)), LIMITS)

    action = messages.AtomsAction
    assert asked(atom_id="a") == asked(atom_id="a", action=action.READ) == (action.READ, "a", None)
    assert asked(atom_id="a", action=action.REMOVE) == (action.REMOVE, "a", None)
    whole = atom_message(atom())
    assert asked(atom_id="wall.1", action=action.ADD, atom=whole).atom is not None
    for fields in (
        {"action": action.REMOVE},
        {"action": action.ADD},
        {"action": action.ADD, "atom_id": "a"},
        {"action": action.ADD, "atom": whole, "atom_id": "other"},
        {"action": action.READ, "atom": whole},
        {"atom": whole},
        {"action": action.REMOVE, "atom_id": "wall.1", "atom": whole},
    ):
        with pytest.raises(errors.BadMessageError):
            asked(**fields)


def test_an_unsound_atom_is_a_typed_error() -> None:
    whole = atom_message(atom())
    for message, error in (
        (atom_message(atom(), hit_points=wire.encode_array(np.ones((4, 3), np.float32))), errors.ShapeError),
        (atom_message(atom(), hit_points=wire.encode_array(np.ones((5, 2), np.float32))), errors.ShapeError),
        (
            atom_message(atom(), hit_points=wire.encode_array(np.full((5, 3), np.nan, np.float32))),
            errors.BadPointsError,
        ),
        (atom_message(atom(), hit_points=wire.encode_array(np.full((5, 3), 1e300))), errors.BadPointsError),
        (atom_message(atom(free_points=np.zeros((51, 3), np.float32))), errors.TooLargeError),
        (
            msgspec.structs.replace(
                whole,
                kernels=msgspec.structs.replace(
                    whole.kernels, gamma_rate=wire.encode_array(np.zeros(6, np.float32))
                ),
            ),
            errors.ShapeError,
        ),
        (
            msgspec.structs.replace(
                whole,
                kernels=msgspec.structs.replace(
                    whole.kernels, weight_var=wire.encode_array(np.ones(5, np.float32))
                ),
            ),
            errors.ShapeError,
        ),
    ):
        with pytest.raises(error):
            codec.decode_atoms_query(adding(message), LIMITS)
    with pytest.raises(errors.TooLargeError):
        codec.decode_atoms_query(adding(whole), Limits(max_query_bytes=100))


@given(st.data())
def test_a_changed_byte_of_an_atom_is_an_atom_or_a_typed_error(data: st.DataObject) -> None:
    payload = bytearray(adding(atom_message(atom())))
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    assert outcome(lambda p: codec.decode_atoms_query(p, LIMITS), bytes(payload)) != "internal"


def test_a_reason_travels_and_none_leaves_the_bytes_as_they_were() -> None:
    refused = codec.encode_error(errors.AtomRefusedError("because", reason="duplicate"))
    assert wire.decode(refused.payload, messages.ErrorReply).reason == "duplicate"
    plain = codec.encode_error(errors.EmptyError("because"))
    assert b"reason" not in plain.payload
    assert wire.decode(plain.payload, messages.ErrorReply).reason is messages.ABSENT


# --- out ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [0.0, 5.3e6])
def test_kernels_travel_as_float32_about_a_float64_origin(at: float) -> None:
    sent = kernels(50, at=at)
    received = codec.encode_kernels(sent, RULE)
    assert received.origin == np.round(sent.hinge_mean.mean(axis=0)).tolist()
    hinges = np.asarray(received.origin) + array(received.hinge_mean)
    np.testing.assert_allclose(hinges, sent.hinge_mean, atol=2e-6, rtol=0)
    for name in ("hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(array(getattr(received, name)), getattr(sent, name))


def test_no_kernels_are_a_message_too() -> None:
    received = codec.encode_kernels(KernelSet.empty(), RULE)
    assert received.origin == [0.0, 0.0, 0.0]
    assert received.hinge_mean.shape == [0, 3]


def test_no_answer_is_rounded_up_to_certainty() -> None:
    n = 3
    occupancy = Occupancy(
        mean=np.array([1.0 - 1e-12, 0.25, 1e-12]),
        var=np.zeros(n),
        latent_mean=np.zeros(n, np.float32),
        latent_var=np.zeros(n, np.float32),
        observed=np.array([True, False, True]),
        map_revision=4,
    )
    message = codec.encode_occupancy(occupancy)
    assert message.encoding == "application/msgpack;pot.occupancy.v1"
    reply = wire.decode(message.payload, messages.Occupancy)
    mean = array(reply.mean)
    assert mean.dtype == np.float32
    assert mean.min() > 0
    assert mean.max() < 1
    assert array(reply.observed).tolist() == [True, False, True]
    assert reply.map_revision == 4


def test_a_sector_without_an_atom_still_travels() -> None:
    sector = SectorMatch(
        0.0, 1.0, 3, 4, None, 0.0, float("inf"), 0, False, float("nan"), 0, "no atom is comparable"
    )
    update = MapUpdate(
        map_revision=1,
        kernels=kernels(),
        sectors=[sector],
        n_points=5,
        n_kernels_added=4,
        n_kernels_transported=3,
        converged=True,
        rule=RULE,
        map_kernels=4,
        changed=TileChange(10.0, [(np.int64(-1), np.int64(2), np.int64(0))]),  # type: ignore[list-item]
        timings_ms={},
    )
    scan = decode(cloud())
    sent = codec.encode_params(map_id="m", scan=scan, update=update, rule=RULE)
    (report,) = wire.decode(sent.payload, messages.Params).sectors
    assert (report.atom_id, report.reason, report.n_hits) == (None, "no atom is comparable", 3)
    tick = codec.encode_revision(
        map_id="m", map_revision=3, map_kernels=9, changed=update.changed, stamp_ns=9
    )
    assert wire.decode(tick.payload, messages.Revision).changed_tiles == [[-1, 2, 0]]
