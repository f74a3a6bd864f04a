"""A small server that speaks the wire on loopback, for tests of the client: one kernel a hit, no learning, scripted faults."""

from __future__ import annotations

import dataclasses
import json
import queue
import socket
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import zenoh

from potclient.kernels import KernelSet
from potschemas import messages
from potschemas.answers import AnswerRule
from potschemas.keys import CONTROL_VERBS, QUERY_OPS, MapKeys, stats_key
from potschemas.messages import ErrorCode, ReceiptStatus
from potschemas.wire import MIME, decode, decode_array, encode, encode_array, encoding_of

SERVER = "fake"
RULE = AnswerRule(observed_activation=0.05, prior_var=50.0, residual_var=20.0)
PART_CELLS = 64
LIMITS = messages.Limits(
    max_cloud_bytes=8 << 20,
    max_cloud_points=200_000,
    max_query_bytes=1 << 20,
    max_query_points=5_000,
    max_grid_cells=1_000_000,
    max_range_m=100.0,
    max_coordinate_m=1e7,
)


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def kernels_of(points: np.ndarray[Any, Any], revision: int) -> KernelSet:
    """(N, 3) m, map frame: one occupied kernel a point, 0.5 m wide."""
    k = len(points)
    one = np.ones(k, np.float32)
    return KernelSet(
        hinge_mean=np.asarray(points, np.float64),
        hinge_var=np.full((k, 3), 0.01, np.float32),
        gamma_shape=2 * one,
        gamma_rate=one,
        weight_mean=3 * one,
        weight_var=0.5 * one,
        rule=RULE,
        map_revision=revision,
    )


@dataclasses.dataclass
class Script:
    """What the server does wrong, or when; tests change it while it runs."""

    receipts: Callable[[messages.Cloud], ReceiptStatus | None] = lambda cloud: (
        ReceiptStatus.ACCEPTED
    )  # None: no receipt
    receipt_gate: threading.Event = dataclasses.field(default_factory=threading.Event)  # set = receipts flow
    fail: dict[str, ErrorCode] = dataclasses.field(
        default_factory=dict
    )  # op -> error, as long as it stands here
    fail_once: dict[str, list[ErrorCode]] = dataclasses.field(default_factory=dict)
    silent: set[str] = dataclasses.field(default_factory=set)  # ops whose query is dropped without an answer
    hold: set[str] = dataclasses.field(default_factory=set)  # ops whose query is kept: the asker times out
    garbage: set[str] = dataclasses.field(
        default_factory=set
    )  # ops that are answered with bytes that are no message
    skip_parts: set[int] = dataclasses.field(default_factory=set)  # parts of a grid that never leave
    mixed_revisions: bool = False


class FakeServer:
    """Serves one map in this process."""

    def __init__(self, map_id: str = "default", *, port: int | None = None, ready: bool = True) -> None:
        self.endpoint = f"tcp/127.0.0.1:{port or free_port()}"
        self.keys = MapKeys("pot/v1", map_id)
        self.script = Script()
        self.script.receipt_gate.set()
        self.clouds: list[messages.Cloud] = []
        self.atoms: list[messages.Atom] = []  # that were added
        self.poses: queue.Queue[messages.Pose] = queue.Queue()
        self.points = np.zeros((0, 3))
        self.saved: dict[str, Any] = {}
        self.clears: list[messages.ControlRequest] = []
        self.revision = 0
        self.queries: list[str] = []
        self._held: list[zenoh.Query] = []
        self._closed = False
        self._lock = threading.Lock()
        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", json.dumps([self.endpoint]))
        self.session = zenoh.open(config)
        self._declared: list[Any] = []
        self._threads: list[threading.Thread] = []
        k = self.keys
        self._serve(
            self.session.declare_subscriber(k.cloud("*"), zenoh.handlers.FifoChannel(4)), self._on_cloud
        )
        self._serve(
            self.session.declare_subscriber(k.pose("*"), zenoh.handlers.FifoChannel(64)), self._on_pose
        )
        for op in QUERY_OPS:
            self._queryable(k.query(op), op)
        for verb in CONTROL_VERBS:
            self._queryable(k.control(verb), f"ctl-{verb}")
        self._queryable(stats_key(k.root, SERVER), "stats")
        self._token: Any = None
        if ready:
            self.declare_ready()

    def declare_ready(self) -> None:
        self._token = self.session.liveliness().declare_token(self.keys.server_token(SERVER))

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self.script.receipt_gate.set()
        for query in self._held:
            query.drop()
        if self._token is not None:
            self._token.undeclare()
        for declared in self._declared:
            declared.undeclare()
        self.session.close()
        for thread in self._threads:
            thread.join(10)

    def __enter__(self) -> FakeServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _serve(self, declared: Any, handle: Callable[[Any], None]) -> None:
        def run() -> None:
            for item in declared:
                handle(item)

        self._declared.append(declared)
        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        self._threads.append(thread)

    def _queryable(self, key: str, op: str) -> None:
        queryable = self.session.declare_queryable(key, zenoh.handlers.FifoChannel(32), complete=True)
        self._serve(queryable, lambda query: self._answer(query, key, op))

    # --- clouds --------------------------------------------------------------------------------------------------------------

    def _on_pose(self, sample: zenoh.Sample) -> None:
        self.poses.put(decode(sample.payload.to_bytes(), messages.Pose))

    def _on_cloud(self, sample: zenoh.Sample) -> None:
        robot = str(sample.key_expr).rsplit("/", 2)[1]
        cloud = decode(sample.payload.to_bytes(), messages.Cloud)
        self.script.receipt_gate.wait(30)
        status = self.script.receipts(cloud)
        receipt = self._integrate(cloud, robot, status or ReceiptStatus.ACCEPTED)
        if status is not None:
            self._publish(self.keys.receipt(robot), receipt)
        if status is ReceiptStatus.ACCEPTED:
            kernels = kernels_of(self.points[-1:], self.revision).to_message()
            self._publish(
                self.keys.params(robot),
                messages.Params(
                    map=self.keys.map_id,
                    robot=robot,
                    seq=cloud.seq,
                    stamp_ns=cloud.stamp_ns,
                    map_revision=self.revision,
                    kernels=kernels,
                ),
            )
            self._publish(
                self.keys.revision,
                messages.Revision(
                    map=self.keys.map_id,
                    map_revision=self.revision,
                    stamp_ns=cloud.stamp_ns,
                    n_kernels=len(self.points),
                    tile_size_m=8.0,
                    changed_tiles=[[0, 0, 0]],
                ),
            )

    def _publish(self, key: str, message: messages.Message) -> None:
        self.session.put(
            key,
            encode(message),
            encoding=encoding_of(message),
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def _integrate(self, cloud: messages.Cloud, robot: str, status: ReceiptStatus) -> messages.Receipt:
        self.clouds.append(cloud)
        points = decode_array(
            cloud.points, "points", dtypes=(messages.DType.FLOAT32,), shape=(None, (2, 3))
        ).astype(np.float64)
        if points.shape[1] == 2:
            points = np.pad(points, ((0, 0), (0, 1)))
        pose = np.eye(4)
        if cloud.T_map_sensor is not None:
            pose = decode_array(cloud.T_map_sensor, "pose", dtypes=(messages.DType.FLOAT64,), shape=(4, 4))
        in_map = points @ pose[:3, :3].T + pose[:3, 3]
        n_new = 0
        with self._lock:
            if status is ReceiptStatus.ACCEPTED:
                new = in_map[:: max(1, len(in_map) // 200)]
                n_new = len(new)
                self.points = np.concatenate([self.points, new])
                self.revision += 1
            accepted = status is ReceiptStatus.ACCEPTED
            return messages.Receipt(
                map=self.keys.map_id,
                robot=robot,
                seq=cloud.seq,
                status=status,
                reason=None if accepted else ErrorCode.OVERLOADED.value,
                message=None if accepted else "scripted",
                integrate_ms=1.0,
                map_revision=self.revision,
                n_points=len(points),
                n_kernels=n_new,
                n_kernels_added=n_new,
                map_kernels=len(self.points),
                kernels=kernels_of(in_map[:5], self.revision).to_message(),
            )

    # --- queries -------------------------------------------------------------------------------------------------------------

    def _answer(self, query: zenoh.Query, key: str, op: str) -> None:
        self.queries.append(op)
        script = self.script
        if op in script.hold:
            self._held.append(query)
            return
        with query:
            if op in script.silent:
                return
            if op in script.garbage:
                query.reply(key, b"\xc1garbage")
                return
            code = script.fail.get(op)
            if script.fail_once.get(op):
                code = script.fail_once[op].pop(0)
            if code is not None:
                error = messages.ErrorReply(
                    code=code,
                    message="scripted",
                    retryable=code is ErrorCode.OVERLOADED,
                    retry_after_s=0.01 if code is ErrorCode.OVERLOADED else None,
                )
                query.reply_err(encode(error), encoding=encoding_of(error))
                return
            payload = query.payload.to_bytes() if query.payload is not None else b""
            for message in self._replies(op, payload):
                if isinstance(message, messages.ErrorReply):
                    query.reply_err(encode(message), encoding=encoding_of(message))
                else:
                    query.reply(key, encode(message), encoding=encoding_of(message))
            assert str(query.encoding).startswith(MIME)

    def _map(self) -> KernelSet:
        with self._lock:
            return kernels_of(self.points, self.revision)

    def _replies(self, op: str, payload: bytes) -> list[messages.Message]:
        return list(getattr(self, "_reply_" + op.replace("-", "_"))(payload))

    def _reply_integrate(self, payload: bytes) -> list[messages.Message]:
        cloud = decode(payload, messages.Cloud)
        assert cloud.robot is not None
        status = self.script.receipts(cloud)
        return [] if status is None else [self._integrate(cloud, cloud.robot, status)]

    def _occupancy(self, points: np.ndarray[Any, Any], with_gradient: bool = False) -> messages.Occupancy:
        o = self._map().occupancy(points, gradient=with_gradient)
        gradients: dict[str, Any] = {}
        if o.gradient is not None and o.latent_gradient is not None:
            gradients = {
                "gradient": encode_array(o.gradient),
                "latent_gradient": encode_array(o.latent_gradient),
            }
        return messages.Occupancy(
            mean=encode_array(o.mean),
            var=encode_array(o.var),
            latent_mean=encode_array(o.latent_mean),
            latent_var=encode_array(o.latent_var),
            observed=encode_array(o.observed),
            map_revision=o.revision,
            **gradients,
        )

    def _reply_points(self, payload: bytes) -> list[messages.Message]:
        ask = decode(payload, messages.PointsQuery)
        wire = ask.points
        dtypes = (messages.DType.FLOAT32, messages.DType.FLOAT64)
        points = decode_array(wire, "points", dtypes=dtypes, shape=(None, (2, 3)))
        assert len(points) <= LIMITS.max_query_points
        return [self._occupancy(points, ask.with_gradient is True)]

    def _reply_rays(self, payload: bytes) -> list[messages.Message]:
        """Rays along x end a metre after their origin's x, whatever the map holds."""
        ask = decode(payload, messages.RaysQuery)
        n, n_quantiles = ask.origins.shape[0], len(ask.quantiles or ())
        origins = decode_array(ask.origins, "origins", dtypes=(messages.DType.FLOAT64,), shape=(n, 3))
        one = np.ones(n, np.float32)
        return [
            messages.Rays(
                hit_probability=encode_array(0.5 * one),
                mean_m=encode_array((origins[:, 0] + 1.0).astype(np.float32)),
                std_m=encode_array(0.25 * one),
                quantile_m=encode_array(np.ones((n, n_quantiles), np.float32)),
                unknown_range_m=encode_array(np.nan * one),
                unknown_share=encode_array(0 * one),
                step_m=0.1,
                map_revision=self.revision,
            )
        ]

    def _reply_risk(self, payload: bytes) -> list[messages.Message]:
        """A robot on pose i is at risk i / 10."""
        n = decode(payload, messages.RiskQuery).path.shape[0]
        risk = (np.arange(n) / 10).astype(np.float32)
        return [
            messages.Risk(
                max_probability=encode_array(0.5 * risk),
                union_probability=encode_array(risk),
                unknown_share=encode_array(0 * risk),
                path_max_probability=0.25,
                path_union_probability=0.5,
                path_unknown_share=0.125,
                n_cells=100,
                resolution_m=0.1,
                map_revision=self.revision,
            )
        ]

    def _reply_grid(self, payload: bytes) -> list[messages.Message]:
        ask = decode(payload, messages.GridQuery)
        lower = np.asarray(ask.lower)
        shape = np.ceil((np.asarray(ask.upper) - lower) / ask.resolution - 1e-6).astype(int)
        n = int(shape.prod())
        cells = np.stack(np.unravel_index(np.arange(n), shape), axis=-1)
        centers = lower + (cells + 0.5) * ask.resolution
        n_parts = -(-n // PART_CELLS)
        parts: list[messages.Message] = []
        for i in range(n_parts):
            if i in self.script.skip_parts:
                continue
            occupancy = self._occupancy(centers[i * PART_CELLS : (i + 1) * PART_CELLS])
            if self.script.mixed_revisions and i == n_parts - 1:
                self.revision += 1
                occupancy = self._occupancy(centers[i * PART_CELLS : (i + 1) * PART_CELLS])
            parts.append(
                messages.GridPart(
                    part=i,
                    n_parts=n_parts,
                    shape=[int(s) for s in shape],
                    first_cell=i * PART_CELLS,
                    lower=ask.lower,
                    resolution=ask.resolution,
                    occupancy=occupancy,
                )
            )
        return parts[::-1] if not self.script.mixed_revisions else parts  # any order must do

    def _reply_params(self, payload: bytes) -> list[messages.Message]:
        ask = decode(payload, messages.ParamsQuery)
        kernels = self._map()
        inside = np.ones(len(kernels), np.bool_)
        if ask.lower is not None:
            inside &= (kernels.hinge_mean >= ask.lower).all(axis=1)
        if ask.upper is not None:
            inside &= (kernels.hinge_mean <= ask.upper).all(axis=1)
        index = np.flatnonzero(inside)
        halves = [index[: len(index) // 2], index[len(index) // 2 :]]
        return [
            messages.ParamsPart(
                part=i, n_parts=2, map_revision=self.revision, kernels=kernels.take(half).to_message()
            )
            for i, half in enumerate(halves)
        ]

    def _atom_info(self) -> messages.AtomInfo:
        return messages.AtomInfo(
            atom_id="wall.1",
            dims=3,
            n_hits=4,
            n_free=4,
            n_kernels=2,
            radius_m=10.0,
            azimuth_width_rad=1.2,
            times_used=7,
            provenance={"source": "fake"},
        )

    def _reply_atoms(self, payload: bytes) -> list[messages.Message]:
        ask = decode(payload, messages.AtomsQuery)
        if ask.action is messages.AtomsAction.ADD:
            self.atoms.append(ask.atom)
            return [messages.AtomsChanged(atom_id=ask.atom.info.atom_id, n_atoms=2, persisted=True)]
        if ask.action is messages.AtomsAction.REMOVE:
            return [messages.AtomsChanged(atom_id=ask.atom_id, n_atoms=0, persisted=False)]
        if ask.atom_id is None:
            return [messages.AtomList(atoms=[self._atom_info()])]
        hits = np.ones((4, 3), np.float32)
        return [
            messages.Atom(
                info=self._atom_info(),
                hit_points=encode_array(hits),
                free_points=encode_array(0.5 * hits),
                kernels=kernels_of(hits[:2], 0).to_message(),
            )
        ]

    def _reply_info(self, payload: bytes) -> list[messages.Message]:
        return [
            messages.Info(
                server=SERVER,
                version="0",
                map=self.keys.map_id,
                maps=[self.keys.map_id],
                profile="default",
                map_revision=self.revision,
                n_kernels=len(self.points),
                n_atoms=1,
                n_scans=self.revision,
                lower=None,
                upper=None,
                tile_size_m=8.0,
                **RULE.fields(),
                limits=LIMITS,
                started_ns=1,
            )
        ]

    def _reply_stats(self, payload: bytes) -> list[messages.Message]:
        return [self.stats()]

    def stats(self) -> messages.Stats:
        return messages.Stats(
            server=SERVER,
            stamp_ns=1,
            uptime_s=1.0,
            state="serving",
            counters={"clouds.received": len(self.clouds)},
            queues={"clouds.depth": 0},
            latencies={},
            rss_bytes=1,
            map_kernels={self.keys.map_id: len(self.points)},
        )

    def publish_stats(self) -> None:
        self._publish(stats_key(self.keys.root, SERVER), self.stats())

    def _reply_ctl_clear(self, payload: bytes) -> list[messages.Message]:
        self.clears.append(decode(payload, messages.ControlRequest))
        with self._lock:
            self.points = np.zeros((0, 3))
            self.revision += 1
        return [messages.ControlReply(verb="clear", map_revision=self.revision, message="cleared")]

    def _reply_ctl_save(self, payload: bytes) -> list[messages.Message]:
        name = decode(payload, messages.ControlRequest).name
        if name is messages.ABSENT:
            return [messages.ControlReply(verb="save", map_revision=self.revision, message="saved")]
        with self._lock:
            self.saved[name] = self.points
        return [messages.ControlReply(verb="save", map_revision=self.revision, message=f"saved as {name}")]

    def _reply_ctl_load(self, payload: bytes) -> list[messages.Message]:
        name = decode(payload, messages.ControlRequest).name
        if name is messages.ABSENT or name not in self.saved:
            return [messages.ErrorReply(code=ErrorCode.UNKNOWN_MAP, message=f"no map {name}")]
        with self._lock:
            self.points = self.saved[name]
            self.revision += 1
        return [messages.ControlReply(verb="load", map_revision=self.revision, message=f"loaded {name}")]

    def _reply_ctl_merge(self, payload: bytes) -> list[messages.Message]:
        request = decode(payload, messages.ControlRequest)
        if request.name is messages.ABSENT or request.name not in self.saved:
            return [messages.ErrorReply(code=ErrorCode.UNKNOWN_MAP, message=f"no map {request.name}")]
        at = np.zeros(3)
        if request.T_map_saved is not messages.ABSENT:
            at = decode_array(
                request.T_map_saved, "T_map_saved", dtypes=(messages.DType.FLOAT64,), shape=(4, 4)
            )[:3, 3]
        return [
            messages.ControlReply(
                verb="merge", map_revision=self.revision, message=f"merged {request.name} at {at.tolist()}"
            )
        ]

    def _reply_ctl_forget(self, payload: bytes) -> list[messages.Message]:
        robot = decode(payload, messages.ControlRequest).robot
        return [messages.ControlReply(verb="forget", map_revision=self.revision, message=f"forgot {robot}")]

    def _reply_ctl_drain(self, payload: bytes) -> list[messages.Message]:
        return [messages.ControlReply(verb="drain", map_revision=self.revision, message="drained")]
