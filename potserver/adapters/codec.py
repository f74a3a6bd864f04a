"""The only place where bytes become domain objects and back.

Decoders check everything that can be checked without the map and raise typed errors; encoders return bytes
with the Zenoh encoding that names their schema.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from potschemas import keys, messages, wire
from potschemas.answers import AnswerRule
from potschemas.messages import DType, ErrorCode
from potserver.adapters.kernel_coding import code_kernels
from potserver.adapters.ports import Snapshot
from potserver.asking.tiles import MANTISSA_BITS, KnownTiles, TilesPlan
from potserver.atoms.store import AtomChange
from potserver.domain.running_scores import RunningScores
from potserver.domain.types import (
    Atom,
    Float64,
    KernelSet,
    MapUpdate,
    Occupancy,
    PathRisk,
    RayReturns,
    Scan,
    SectorMatch,
    TileChange,
    Unknown,
    check_rigid,
)
from potserver.errors import (
    BadMessageError,
    BadPointsError,
    EmptyError,
    NoPoseError,
    OutOfRangeError,
    PotserverError,
    ShapeError,
    TooLargeError,
    UnknownRobotError,
    error_classes,
)
from potserver.health import Latency
from potserver.limits import Limits

MessageT = TypeVar("MessageT", bound=messages.Message)
UNKNOWN_SEQ = -1  # in the receipt of a cloud whose number could not be read
_UNSET_ENCODING = "zenoh/bytes"  # what Zenoh reports when the sender named none
_MAX_SMALL_BYTES = 4096  # of messages without arrays
_QUANTILES = (0.05, 0.5, 0.95)  # of a `q/rays` that names none
_FLOATS = (DType.FLOAT32, DType.FLOAT64)
_ERRORS = error_classes()
# float32 would round a sure answer up to certainty, which costs an infinite log-loss when it is wrong
_BELOW_ONE = float(np.nextafter(np.float32(1), np.float32(0)))


class Wire(NamedTuple):
    """A message ready to send."""

    payload: bytes
    encoding: str


class CloudHead(NamedTuple):
    """What of a cloud can be read even when the rest is unsound."""

    seq: int
    robot_id: str | None


class PointsRequest(NamedTuple):
    """A decoded `q/points`."""

    points: NDArray[np.floating[Any]]  # (N, 3) or (N, 2) m, map frame
    deadline_ms: float | None
    with_gradient: bool = False


class GridRequest(NamedTuple):
    """A decoded `q/grid`."""

    lower: list[float]
    upper: list[float]
    resolution: float
    deadline_ms: float | None


class RaysRequest(NamedTuple):
    """A decoded `q/rays`."""

    origins: NDArray[np.floating[Any]]  # (N, 3) or (N, 2) m, map frame
    directions: NDArray[np.floating[Any]]  # (N, 3) or (N, 2)
    max_range_m: float
    quantiles: Sequence[float]
    unknown: Unknown
    width_m: float | None
    step_m: float | None
    deadline_ms: float | None


class RiskRequest(NamedTuple):
    """A decoded `q/risk`."""

    path: NDArray[np.floating[Any]]  # (P, 4, 4) T_map_body
    spheres: NDArray[np.floating[Any]]  # (S, 4) m: centre in the body frame, and radius
    unknown: Unknown
    resolution_m: float | None
    correlation_m: float | None
    dims: int
    deadline_ms: float | None


class TilesRequest(NamedTuple):
    """A decoded `q/tiles`."""

    known: KnownTiles | None
    lower: list[float] | None
    upper: list[float] | None
    mantissa_bits: int
    deadline_ms: float | None


class AtomsRequest(NamedTuple):
    """A decoded `q/atoms`."""

    action: messages.AtomsAction
    atom_id: str | None  # none: list them, or add `atom`
    atom: Atom | None  # set when one is to be added


class ParamsRequest(NamedTuple):
    """A decoded `q/params`."""

    lower: list[float] | None
    upper: list[float] | None
    deadline_ms: float | None


# --- in: checks before the bytes are touched ----------------------------------------------------------------


def check_size(n_bytes: int, limit: int, what: str) -> None:
    """Refuse a payload by its length alone.

    Raises:
        TooLargeError: it is longer than the limit.
    """
    if n_bytes > limit:
        raise TooLargeError(f"{what} of {n_bytes} bytes, the limit is {limit}")


def check_encoding(encoding: str | None, kind: type[messages.Message]) -> None:
    """Refuse a payload that says it is something else; a sender that says nothing is taken at its word.

    Raises:
        BadMessageError: the encoding names another schema.
    """
    expected = wire.encoding_of(kind)
    if encoding not in (None, "", _UNSET_ENCODING, expected):
        raise BadMessageError(f"the encoding is {encoding[:80]!r}, need {expected!r}")


def check_robot_id(robot_id: str, allowed: frozenset[str]) -> None:
    """Refuse robots that have no legal id, or are not on the list; an empty list allows all.

    Raises:
        UnknownRobotError: either of the two.
    """
    try:
        keys.check_id(robot_id, "robot")
    except ValueError as error:
        raise UnknownRobotError(str(error)[:200]) from error
    if allowed and robot_id not in allowed:
        raise UnknownRobotError(f"robot {robot_id!r} is not on the allow list")


# --- in: clouds and poses -----------------------------------------------------------------------------------


class _CloudHead(messages.Message, frozen=True, kw_only=True):
    schema = messages.Cloud.schema
    seq: messages.Sequence
    robot: messages.Identifier | None = None


def decode_cloud_head(payload: bytes) -> CloudHead:
    """The number and sender of a cloud; `UNKNOWN_SEQ` when even they cannot be read."""
    try:
        head = wire.decode(payload, _CloudHead)
    except wire.WireError:
        return CloudHead(UNKNOWN_SEQ, None)
    return CloudHead(head.seq, head.robot)


@np.errstate(over="ignore", invalid="ignore")  # hostile numbers may overflow on the way to their error
def decode_cloud(
    payload: bytes,
    *,
    robot_id: str | None,
    limits: Limits,
    pose_at: Callable[[str, int], Float64],
) -> Scan:
    """A scan from the payload of `in/<robot>/cloud` or `q/integrate`.

    Args:
        payload: A `messages.Cloud`.
        robot_id: From the key; None where the message must say it.
        limits: Bounds on bytes, points and coordinates.
        pose_at: Called with robot and stamp when the cloud brings no pose.
    Raises:
        BadMessageError: not a cloud, or its robot is missing or not the key's.
        ShapeError: an array has the wrong dtype, shape or byte count.
        TooLargeError: too many bytes or points.
        EmptyError: no points.
        BadPointsError: NaN or infinite coordinates.
        OutOfRangeError: coordinates beyond the map's bounds, in the sensor frame or after the pose.
        BadPoseError: not rigid, or not finite.
        NoPoseError: no pose, and none at the stamp.
    """
    cloud = _decode(payload, messages.Cloud, limits.max_cloud_bytes)
    if robot_id is None:
        if cloud.robot is None:
            raise BadMessageError("pot.cloud.v1: q/integrate needs the field `robot`")
        robot_id = cloud.robot
    elif cloud.robot not in (None, robot_id):
        raise BadMessageError(
            f"pot.cloud.v1: the cloud says robot {cloud.robot!r}, its key says {robot_id!r}"
        )

    points = _decode_array(cloud.points, "points", _FLOATS, (None, (2, 3)))
    n = len(points)
    if n > limits.max_cloud_points:
        raise TooLargeError(f"cloud of {n} points, the limit is {limits.max_cloud_points}")
    if n == 0:
        raise EmptyError("the cloud has no points")
    is_return = (
        np.ones(n, np.bool_)
        if cloud.is_return is None
        else _decode_array(cloud.is_return, "is_return", (DType.BOOL,), (n,))
    )
    _check_coordinates(points, limits.max_coordinate_m, "points")
    is_planar = points.shape[1] == 2
    xyz = np.zeros((n, 3), np.float32)
    xyz[:, : points.shape[1]] = points

    pose = (
        pose_at(robot_id, cloud.stamp_ns)
        if cloud.T_map_sensor is None
        else _decode_array(cloud.T_map_sensor, "T_map_sensor", (DType.FLOAT64,), (4, 4))
    )
    check_rigid(pose)
    _check_placed(xyz, pose, limits.max_coordinate_m)
    return Scan(
        robot_id=robot_id,
        seq=cloud.seq,
        stamp_ns=cloud.stamp_ns,
        points=xyz,
        is_return=is_return,
        T_map_sensor=pose,
        is_planar=is_planar,
    )


def encode_cloud(scan: Scan) -> bytes:
    """The scan as `pot.cloud.v1`, complete: `read_cloud` needs nothing else to make the same scan again."""
    return wire.encode(
        messages.Cloud(
            seq=scan.seq,
            stamp_ns=scan.stamp_ns,
            points=wire.encode_array(scan.points[:, :2] if scan.is_planar else scan.points),
            T_map_sensor=wire.encode_array(scan.T_map_sensor),
            is_return=None if scan.is_return.all() else wire.encode_array(scan.is_return),
            robot=scan.robot_id,
        )
    )


def read_cloud(payload: bytes) -> Scan:
    """A scan that was accepted before: what limits allow now does not matter.

    Raises:
        PotserverError: it is no complete cloud.
    """
    unlimited = Limits(max_cloud_bytes=2**40, max_cloud_points=2**40, max_coordinate_m=math.inf)
    return decode_cloud(payload, robot_id=None, limits=unlimited, pose_at=_no_pose)


def _no_pose(robot_id: str, _stamp_ns: int) -> Float64:
    raise NoPoseError(f"the kept cloud of {robot_id} has no pose")


@np.errstate(over="ignore", invalid="ignore")
def decode_pose(payload: bytes, *, max_bytes: int = 4096) -> tuple[int, Float64]:
    """Stamp and (4, 4) matrix of one pose of a pose stream.

    Raises:
        BadMessageError, ShapeError, BadPoseError: see `decode_cloud`.
    """
    pose = _decode(payload, messages.Pose, max_bytes)
    matrix = _decode_array(pose.T_map_sensor, "T_map_sensor", (DType.FLOAT64,), (4, 4))
    check_rigid(matrix)
    return pose.stamp_ns, matrix


def _check_coordinates(points: NDArray[np.floating[Any]], max_coordinate_m: float, what: str) -> None:
    """One pass over the array when all is well: NaN and infinity survive a maximum."""
    with np.errstate(invalid="ignore"):
        extent = float(np.abs(points).max(initial=0.0))
    if extent <= max_coordinate_m:
        return
    bad = int((~np.isfinite(points)).any(axis=1).sum())
    if bad:
        raise BadPointsError(f"{bad} of {len(points)} {what} have NaN or infinite coordinates")
    raise OutOfRangeError(f"{what} reach {extent:.6g} m, the limit is {max_coordinate_m:.6g} m")


def _check_placed(points: NDArray[np.float32], pose: Float64, max_coordinate_m: float) -> None:
    """Bound the map-frame coordinates; exact only when the cheap bound does not already settle it."""
    reach = math.sqrt(3) * float(np.abs(points).max())
    if float(np.abs(pose[:3, 3]).max()) + reach <= max_coordinate_m:
        return
    placed = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    extent = max(float(np.abs(placed).max()), float(np.abs(pose[:3, 3]).max()))
    if extent > max_coordinate_m:
        raise OutOfRangeError(
            f"the placed cloud reaches {extent:.6g} m, the limit is {max_coordinate_m:.6g} m"
        )


# --- in: queries --------------------------------------------------------------------------------------------


def decode_points_query(payload: bytes, limits: Limits) -> PointsRequest:
    """Points to ask at.

    Raises:
        BadMessageError, ShapeError: see `decode_cloud`.
        TooLargeError: too many bytes or points.
        BadPointsError, OutOfRangeError: coordinates.
    """
    query = _decode(payload, messages.PointsQuery, limits.max_query_bytes)
    points = _decode_array(query.points, "points", _FLOATS, (None, (2, 3)))
    if len(points) > limits.max_query_points:
        raise TooLargeError(f"query of {len(points)} points, the limit is {limits.max_query_points}")
    _check_coordinates(points, limits.max_coordinate_m, "points")
    return PointsRequest(points, query.deadline_ms, query.with_gradient is True)


def decode_rays_query(payload: bytes, limits: Limits) -> RaysRequest:
    """Rays to cast; the query service judges the values.

    Raises:
        BadMessageError, ShapeError: see `decode_cloud`.
        TooLargeError: too many bytes or rays.
    """
    query = _decode(payload, messages.RaysQuery, limits.max_query_bytes)
    origins = _decode_array(query.origins, "origins", _FLOATS, (None, (2, 3)))
    if len(origins) > limits.max_query_rays:
        raise TooLargeError(f"query of {len(origins)} rays, the limit is {limits.max_query_rays}")
    return RaysRequest(
        origins=origins,
        directions=_decode_array(query.directions, "directions", _FLOATS, origins.shape),
        max_range_m=query.max_range_m,
        quantiles=_QUANTILES if query.quantiles is None else query.quantiles,
        unknown=Unknown(query.unknown.value),
        width_m=query.width_m,
        step_m=query.step_m,
        deadline_ms=query.deadline_ms,
    )


def decode_risk_query(payload: bytes, limits: Limits) -> RiskRequest:
    """A path and a robot; the query service judges the values.

    Raises:
        BadMessageError, ShapeError: see `decode_cloud`.
        TooLargeError: too many bytes, poses or spheres.
    """
    query = _decode(payload, messages.RiskQuery, limits.max_query_bytes)
    path = _decode_array(query.path, "path", (DType.FLOAT64,), (None, 4, 4))
    spheres = _decode_array(query.spheres, "spheres", _FLOATS, (None, 4))
    for what, n, limit in (
        ("poses", len(path), limits.max_query_poses),
        ("spheres", len(spheres), limits.max_query_spheres),
    ):
        if n > limit:
            raise TooLargeError(f"query of {n} {what}, the limit is {limit}")
    return RiskRequest(
        path=path,
        spheres=spheres,
        unknown=Unknown(query.unknown.value),
        resolution_m=query.resolution_m,
        correlation_m=query.correlation_m,
        dims=query.dims,
        deadline_ms=query.deadline_ms,
    )


def decode_grid_query(payload: bytes) -> GridRequest:
    """A box and a resolution; the query service judges the values.

    Raises:
        BadMessageError: not this message.
    """
    query = _decode(payload, messages.GridQuery)
    return GridRequest(query.lower, query.upper, query.resolution, query.deadline_ms)


def decode_params_query(payload: bytes) -> ParamsRequest:
    """A box, or none for the whole map; the query service judges the values.

    Raises:
        BadMessageError: not this message.
    """
    query = _decode(payload, messages.ParamsQuery)
    return ParamsRequest(query.lower, query.upper, query.deadline_ms)


def decode_tiles_query(payload: bytes, limits: Limits) -> TilesRequest:
    """What the asker has, and the box that it asks about; the query service judges the values.

    Raises:
        BadMessageError, ShapeError: see `decode_cloud`.
        TooLargeError: too many bytes or known tiles.
    """
    query = _decode(payload, messages.TilesQuery, limits.max_query_bytes)
    known = None
    if query.known is not None:
        if query.epoch is None:
            raise BadMessageError("pot.tiles_query.v1: `known` needs the `epoch` that its revisions are of")
        with _typed_errors():
            columns = wire.unpack_array(
                query.known,
                "known",
                dtypes=(DType.INT64,),
                shape=(4, None),
                max_elements=4 * limits.max_query_tiles,
            )
        known = KnownTiles(query.epoch, columns[:3].T, columns[3])
    return TilesRequest(
        known=known,
        lower=query.lower,
        upper=query.upper,
        mantissa_bits=MANTISSA_BITS if query.mantissa_bits is None else query.mantissa_bits,
        deadline_ms=query.deadline_ms,
    )


def decode_atoms_query(payload: bytes, limits: Limits) -> AtomsRequest:
    """What is asked of the dictionary.

    Raises:
        BadMessageError: not this message, or its fields do not fit its action.
        TooLargeError, ShapeError, BadPointsError, EmptyError: of the atom to be added.
    """
    query = _decode(payload, messages.AtomsQuery, limits.max_query_bytes)
    action = messages.AtomsAction.READ if query.action is messages.ABSENT else query.action
    if action is messages.AtomsAction.ADD:
        if query.atom is messages.ABSENT or query.atom_id not in (None, query.atom.info.atom_id):
            raise BadMessageError(
                "pot.atoms_query.v1: to add needs the field `atom`, and no other id beside it"
            )
        return AtomsRequest(action, None, decode_atom(query.atom, max_points=limits.max_query_points))
    if query.atom is not messages.ABSENT:
        raise BadMessageError(f"pot.atoms_query.v1: to {action.value} takes no field `atom`")
    if action is messages.AtomsAction.REMOVE and query.atom_id is None:
        raise BadMessageError("pot.atoms_query.v1: to remove needs the field `atom_id`")
    return AtomsRequest(action, query.atom_id, None)


@np.errstate(over="ignore", invalid="ignore")
def decode_atom(message: messages.Atom, *, max_points: int) -> Atom:
    """An atom of the dictionary; the scalars beside its kernels belong to maps, and are left out.

    Raises:
        ShapeError: an array has the wrong dtype, shape or byte count, or a number its sign does not allow.
        TooLargeError: more points or kernels than a query may have.
        BadPointsError, EmptyError: NaN or infinite points, or none.
    """
    info, kernels = message.info, message.kernels
    hits, free = (
        _decode_array(array, name, _FLOATS, (None, 3))
        for name, array in (("hit_points", message.hit_points), ("free_points", message.free_points))
    )
    hinges = _decode_array(kernels.hinge_mean, "hinge_mean", _FLOATS, (None, 3))
    for name, n, counted in (
        ("hits", len(hits), info.n_hits),
        ("free", len(free), info.n_free),
        ("kernels", len(hinges), info.n_kernels),
    ):
        if n > max_points:
            raise TooLargeError(f"atom with {n} {name}, the limit is {max_points}")
        if n != counted:
            raise ShapeError(f"atom: its arrays have {n} {name}, its info says {counted}")
    k = len(hinges)

    def numbers(name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
        return np.asarray(_decode_array(getattr(kernels, name), name, _FLOATS, shape), np.float32)

    return Atom(
        atom_id=info.atom_id,
        dims=info.dims,
        hit_points=np.asarray(hits, np.float32),
        free_points=np.asarray(free, np.float32),
        kernels=KernelSet(
            hinge_mean=np.asarray(kernels.origin) + hinges,
            hinge_var=numbers("hinge_var", (k, 3)),
            **{
                name: numbers(name, (k,))
                for name in ("gamma_shape", "gamma_rate", "weight_mean", "weight_var")
            },
        ),
        radius_m=float(info.radius_m),
        azimuth_width_rad=float(info.azimuth_width_rad),
        provenance=dict(info.provenance),
    )


def read_atom_file(payload: bytes) -> Atom:
    """The atom in a `*.atom` file, which is the message `pot.atom.v1`.

    Raises:
        BadMessageError and what `decode_atom` raises.
    """
    limits = Limits()
    message = _decode(payload, messages.Atom, limits.max_query_bytes)
    return decode_atom(message, max_points=limits.max_query_points)


def decode_info_query(payload: bytes) -> None:
    """Nothing to read, but it must be that message."""
    _decode(payload, messages.InfoQuery)


def decode_stats_query(payload: bytes) -> None:
    """Nothing to read, but it must be that message."""
    _decode(payload, messages.StatsQuery)


class ControlRequest(NamedTuple):
    """A decoded `ctl/<verb>`."""

    timeout_s: float | None  # how long the asker waits
    name: str | None  # of a saved map
    robot_id: str | None
    T_map_saved: Float64 | None  # (4, 4)


def decode_control(payload: bytes) -> ControlRequest:
    """What is asked of a map: how long the asker waits, and what the verb is about.

    Raises:
        BadMessageError, ShapeError, BadPoseError: not that message.
    """
    request = _decode(payload, messages.ControlRequest)
    pose = None
    if request.T_map_saved is not messages.ABSENT:
        pose = _decode_array(request.T_map_saved, "T_map_saved", (DType.FLOAT64,), (4, 4))
        check_rigid(pose)
    return ControlRequest(
        request.timeout_s,
        None if request.name is messages.ABSENT else request.name,
        None if request.robot is messages.ABSENT else request.robot,
        pose,
    )


def _decode(payload: bytes, kind: type[MessageT], max_bytes: int = _MAX_SMALL_BYTES) -> MessageT:
    """One message; an empty payload stands for a message whose fields all have defaults."""
    with _typed_errors():
        return wire.decode(payload or b"\x80", kind, wire.WireLimits(max_bytes=max_bytes))


def _decode_array(
    array: messages.Array,
    name: str,
    dtypes: tuple[DType, ...],
    shape: tuple[int | tuple[int, ...] | None, ...],
) -> NDArray[Any]:
    with _typed_errors():
        return wire.decode_array(array, name, dtypes=dtypes, shape=shape)


@contextlib.contextmanager
def _typed_errors() -> Iterator[None]:
    try:
        yield
    except wire.WireError as error:
        raise _ERRORS[error.code.value](str(error)) from error


# --- out: receipts and events -------------------------------------------------------------------------------


def accepted_receipt(
    *,
    map_id: str,
    scan: Scan,
    update: MapUpdate,
    kernels: messages.Kernels | None,
    queue_depth: int,
    wait_ms: float,
    integrate_ms: float,
) -> Wire:
    """The receipt of a cloud that is in the map; with its kernels for `q/integrate`."""
    return _wire(
        messages.Receipt(
            map=map_id,
            robot=scan.robot_id,
            seq=scan.seq,
            status=messages.ReceiptStatus.ACCEPTED,
            queue_depth=queue_depth,
            wait_ms=wait_ms,
            integrate_ms=integrate_ms,
            map_revision=int(update.map_revision),
            n_points=int(update.n_points),
            n_kernels=len(update.kernels),
            n_kernels_added=int(update.n_kernels_added),
            n_kernels_transported=int(update.n_kernels_transported),
            map_kernels=int(update.map_kernels),
            sectors=_sectors(update.sectors),
            kernels=kernels,
        )
    )


def refused_receipt(
    *,
    map_id: str,
    robot_id: str,
    seq: int,
    error: PotserverError,
    queue_depth: int,
    wait_ms: float,
    map_revision: int,
    map_kernels: int,
) -> Wire:
    """The receipt of a cloud that is not in the map."""
    return _wire(
        messages.Receipt(
            map=map_id,
            robot=robot_id,
            seq=seq,
            status=refusal(error),
            reason=error.code,
            message=str(error),
            queue_depth=queue_depth,
            wait_ms=wait_ms,
            map_revision=map_revision,
            map_kernels=map_kernels,
        )
    )


def refusal(error: PotserverError) -> messages.ReceiptStatus:
    """`dropped` for load and shutdown, `rejected` for everything that would fail again."""
    return messages.ReceiptStatus.DROPPED if error.retryable else messages.ReceiptStatus.REJECTED


def encode_params(*, map_id: str, scan: Scan, update: MapUpdate, rule: AnswerRule) -> Wire:
    """The transported parameters of one cloud."""
    return _wire(
        messages.Params(
            map=map_id,
            robot=scan.robot_id,
            seq=scan.seq,
            stamp_ns=scan.stamp_ns,
            map_revision=int(update.map_revision),
            kernels=encode_kernels(update.kernels, rule),
            sectors=_sectors(update.sectors),
        )
    )


def encode_revision(
    *, map_id: str, map_revision: int, map_kernels: int, changed: TileChange, stamp_ns: int
) -> Wire:
    """The tick of `ev/revision`."""
    return _wire(
        messages.Revision(
            map=map_id,
            map_revision=int(map_revision),
            stamp_ns=stamp_ns,
            n_kernels=int(map_kernels),
            tile_size_m=float(changed.tile_size_m),
            changed_tiles=[[int(i) for i in tile] for tile in changed.tiles],
        )
    )


def _sectors(matches: list[SectorMatch]) -> list[messages.SectorReport]:
    return [
        messages.SectorReport(
            azimuth_min_rad=float(m.azimuth_min_rad),
            azimuth_max_rad=float(m.azimuth_max_rad),
            n_hits=int(m.n_hits),
            n_free=int(m.n_free),
            atom_id=m.atom_id,
            rotation_rad=float(m.rotation_rad),
            w2_m2=float(m.w2_m2),
            n_kernels=int(m.n_kernels),
            converged=bool(m.converged),
            marginal_error=float(m.marginal_error),
            n_iterations=int(m.n_iterations),
            reason=m.reason,
        )
        for m in matches
    ]


# --- out: maps and answers ----------------------------------------------------------------------------------


def encode_kernels(kernels: KernelSet, rule: AnswerRule) -> messages.Kernels:
    """Kernels for the wire: float64 positions become float32 offsets from their centroid, in whole metres."""
    origin = np.round(kernels.hinge_mean.mean(axis=0)) if len(kernels) else np.zeros(3)
    return messages.Kernels(
        origin=[float(c) for c in origin],
        hinge_mean=_float32(kernels.hinge_mean - origin),
        hinge_var=_float32(kernels.hinge_var),
        gamma_shape=_float32(kernels.gamma_shape),
        gamma_rate=_float32(kernels.gamma_rate),
        weight_mean=_float32(kernels.weight_mean),
        weight_var=_float32(kernels.weight_var),
        **rule.fields(),
    )


def encode_occupancy(occupancy: Occupancy) -> Wire:
    """The reply to `q/points`."""
    return _wire(_occupancy(occupancy))


def encode_rays(rays: RayReturns) -> Wire:
    """The reply to `q/rays`."""
    return _wire(
        messages.Rays(
            hit_probability=_float32(rays.hit_probability),
            mean_m=_float32(rays.mean_m),
            std_m=_float32(rays.std_m),
            quantile_m=_float32(rays.quantile_m),
            unknown_range_m=_float32(rays.unknown_range_m),
            unknown_share=_float32(rays.unknown_share),
            step_m=rays.step_m,
            map_revision=rays.map_revision,
        )
    )


def encode_risk(risk: PathRisk) -> Wire:
    """The reply to `q/risk`."""
    return _wire(
        messages.Risk(
            max_probability=_float32(risk.max_probability),
            union_probability=_float32(risk.union_probability),
            unknown_share=_float32(risk.unknown_share),
            path_max_probability=risk.path_max_probability,
            path_union_probability=risk.path_union_probability,
            path_unknown_share=risk.path_unknown_share,
            n_cells=risk.n_cells,
            resolution_m=risk.resolution_m,
            map_revision=risk.map_revision,
        )
    )


def encode_grid_part(
    *,
    part: int,
    n_parts: int,
    shape: tuple[int, int, int],
    first_cell: int,
    lower: Sequence[float],
    resolution: float,
    occupancy: Occupancy,
) -> Wire:
    """One part of the reply to `q/grid`."""
    return _wire(
        messages.GridPart(
            part=part,
            n_parts=n_parts,
            shape=[int(n) for n in shape],
            first_cell=int(first_cell),
            lower=[float(c) for c in lower],
            resolution=float(resolution),
            occupancy=_occupancy(occupancy),
        )
    )


def encode_params_part(
    *,
    part: int,
    n_parts: int,
    map_revision: int,
    kernels: KernelSet,
    rule: AnswerRule,
) -> Wire:
    """One part of the reply to `q/params`."""
    return _wire(
        messages.ParamsPart(
            part=part,
            n_parts=n_parts,
            map_revision=map_revision,
            kernels=encode_kernels(kernels, rule),
        )
    )


def encode_tiles_part(plan: TilesPlan, part: int) -> Wire:
    """One part of the reply to `q/tiles`; the tiles that are gone travel in part 0."""
    run = plan.part(part)
    return _wire(
        messages.TilesPart(
            part=part,
            n_parts=plan.n_parts,
            epoch=plan.epoch,
            map_revision=plan.map_revision,
            whole=plan.is_whole,
            tile_size_m=float(plan.tile_size_m),
            tiles=wire.pack_array(np.vstack([run.indices.T, run.revisions])),
            counts=wire.pack_array(run.counts),
            gone=wire.pack_array(plan.gone.T) if part == 0 and len(plan.gone) else None,
            kernels=code_kernels(run.kernels, plan.spacings_m),
            **plan.rule.fields(),
        )
    )


def encode_atom_list(atoms: Iterable[Atom], usage: Mapping[str, int]) -> Wire:
    """The dictionary's table."""
    return _wire(messages.AtomList(atoms=[_atom_info(atom, usage) for atom in atoms]))


def encode_atom(atom: Atom, usage: Mapping[str, int], rule: AnswerRule) -> Wire:
    """One atom whole."""
    return _wire(
        messages.Atom(
            info=_atom_info(atom, usage),
            hit_points=_float32(atom.hit_points),
            free_points=_float32(atom.free_points),
            kernels=encode_kernels(atom.kernels, rule),
        )
    )


def encode_atoms_changed(change: AtomChange) -> Wire:
    """The reply to an atom added or removed."""
    return _wire(
        messages.AtomsChanged(atom_id=change.atom_id, n_atoms=change.n_atoms, persisted=change.persisted)
    )


def encode_info(
    *,
    server_id: str,
    version: str,
    map_id: str,
    maps: Sequence[str],
    profile: str,
    snapshot: Snapshot,
    n_atoms: int,
    n_scans: int,
    tile_size_m: float,
    max_range_m: float,
    limits: Limits,
    started_ns: int,
    durable: bool,
) -> Wire:
    """What this server is and what this map holds."""
    hinges = snapshot.kernels.hinge_mean
    return _wire(
        messages.Info(
            server=server_id,
            version=version,
            map=map_id,
            maps=list(maps),
            profile=profile,
            map_revision=snapshot.map_revision,
            n_kernels=len(hinges),
            n_atoms=n_atoms,
            n_scans=n_scans,
            lower=[float(c) for c in hinges.min(axis=0)] if len(hinges) else None,
            upper=[float(c) for c in hinges.max(axis=0)] if len(hinges) else None,
            tile_size_m=float(tile_size_m),
            **snapshot.rule.fields(),
            limits=messages.Limits(
                max_cloud_bytes=limits.max_cloud_bytes,
                max_cloud_points=limits.max_cloud_points,
                max_query_bytes=limits.max_query_bytes,
                max_query_points=limits.max_query_points,
                max_grid_cells=limits.max_grid_cells,
                max_range_m=float(max_range_m),
                max_coordinate_m=limits.max_coordinate_m,
                max_query_rays=limits.max_query_rays,
                max_query_poses=limits.max_query_poses,
                max_query_spheres=limits.max_query_spheres,
                max_query_samples=limits.max_query_samples,
                max_query_tiles=limits.max_query_tiles,
            ),
            started_ns=started_ns,
            durable=durable,
        )
    )


def encode_stats(
    *,
    server_id: str,
    stamp_ns: int,
    uptime_s: float,
    state: str,
    counters: dict[str, int],
    queues: dict[str, int],
    latencies: Mapping[str, Latency],
    rss_bytes: int,
    map_kernels: dict[str, int],
    map_scores: Mapping[str, tuple[RunningScores, float]],
) -> Wire:
    """The server's counters; the scores of each map with the mean moderation that it answers with."""
    return _wire(
        messages.Stats(
            server=server_id,
            stamp_ns=stamp_ns,
            uptime_s=uptime_s,
            state=state,
            counters=counters,
            queues=queues,
            latencies={
                kind: messages.LatencySummary(
                    count=summary.n,
                    p50_ms=summary.p50_ms,
                    p95_ms=summary.p95_ms,
                    p99_ms=summary.p99_ms,
                    max_ms=summary.max_ms,
                )
                for kind, summary in latencies.items()
            },
            rss_bytes=rss_bytes,
            map_kernels=map_kernels,
            map_scores={
                map_id: messages.MapScores(
                    n_points=scores.n_points,
                    nll=scores.mean_nll(moderation),
                    brier=scores.mean_brier,
                    ece=scores.ece,
                    mean_moderation=moderation,
                )
                for map_id, (scores, moderation) in map_scores.items()
            },
        )
    )


def encode_control_reply(*, verb: str, map_revision: int, message: str) -> Wire:
    """A control verb was carried out."""
    return _wire(messages.ControlReply(verb=verb, map_revision=map_revision, message=message))


def encode_error(error: PotserverError) -> Wire:
    """The payload of `reply_err`."""
    return _wire(
        messages.ErrorReply(
            code=ErrorCode(error.code),
            message=str(error),
            retryable=error.retryable,
            retry_after_s=error.retry_after_s,
            reason=messages.ABSENT if error.reason is None else error.reason,
        )
    )


def _atom_info(atom: Atom, usage: Mapping[str, int]) -> messages.AtomInfo:
    return messages.AtomInfo(
        atom_id=atom.atom_id,
        dims=atom.dims,
        n_hits=len(atom.hit_points),
        n_free=len(atom.free_points),
        n_kernels=len(atom.kernels),
        radius_m=float(atom.radius_m),
        azimuth_width_rad=float(atom.azimuth_width_rad),
        times_used=int(usage.get(atom.atom_id, 0)),
        provenance={str(k): str(v) for k, v in atom.provenance.items()},
    )


def _occupancy(occupancy: Occupancy) -> messages.Occupancy:
    return messages.Occupancy(
        mean=_float32(np.minimum(occupancy.mean, _BELOW_ONE)),
        var=_float32(occupancy.var),
        latent_mean=_float32(occupancy.latent_mean),
        latent_var=_float32(occupancy.latent_var),
        observed=wire.encode_array(occupancy.observed),
        map_revision=occupancy.map_revision,
        gradient=messages.ABSENT if occupancy.gradient is None else _float32(occupancy.gradient),
        latent_gradient=(
            messages.ABSENT if occupancy.latent_gradient is None else _float32(occupancy.latent_gradient)
        ),
    )


def _float32(array: NDArray[np.floating[Any]]) -> messages.Array:
    return wire.encode_array(np.asarray(array, np.float32))


def _wire(message: messages.Message) -> Wire:
    return Wire(wire.encode(message), wire.encoding_of(message))
