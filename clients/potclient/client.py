"""`MapClient`: feed a map and ask it, from any process.

Everything that Zenoh hands back is read on daemon threads of our own from bounded channels: no Zenoh callbacks, whose
threads keep a process alive that forgot to close its session.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import functools
import itertools
import logging
import math
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, TypeVar

import msgspec
import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from potclient.atoms import Atom
from potclient.errors import (
    BadReplyError,
    ClosedError,
    IncompleteReplyError,
    LostReplyError,
    NoServerError,
    OverloadedError,
    PotclientError,
    QueryTimeoutError,
    TooLargeError,
    UsageError,
    error_from_reply,
)
from potclient.feed import Feed, Numbering
from potclient.kernels import KernelSet
from potclient.mirror import MapMirror
from potclient.results import (
    FeedCounts,
    Float32,
    Float64,
    Grid,
    Occupancy,
    Rays,
    Receipt,
    Risk,
    TransportedParams,
    as_points,
)
from potclient.session import DEFAULT_ENDPOINT, SessionOptions, open_session
from potschemas import messages
from potschemas.keys import DEFAULT_ROOT, MapKeys, check_id, stats_key
from potschemas.messages import Message
from potschemas.wire import WireError, decode, encode, encode_array, encoding_of

log = logging.getLogger("potclient")

MessageT = TypeVar("MessageT", bound=Message)
ProgressCallback = Callable[[int, int], None]  # (parts received, parts in all)

_CHUNK_POINTS = 100_000  # points a query at most, whatever the server would take
_SPLIT_ABOVE = 20_000  # up to here one query is sent without asking for the server's limits
_CHUNK_RAYS = 20_000  # rays a query at most
_CHUNKS_IN_FLIGHT = 4
_MIRROR_MARGIN_M = 4.0  # kernels of the coarsest maps are 1 m apart, and say nothing any more at 2.5 m
_CHUNK_RETRIES = 8
_DIAGNOSIS_TIMEOUT_S = 0.5
CONTROL_TIMEOUT_S = 300.0  # a merge of two large maps takes a minute, and nobody should ask for it twice
# megabytes, that must not delay short questions and answers on the same link
_BULK_LANES = {
    "integrate": zenoh.Priority.DATA_LOW,
    "grid": zenoh.Priority.DATA,
    "params": zenoh.Priority.DATA,
    "tiles": zenoh.Priority.DATA,
}

_open_clients: weakref.WeakSet[MapClient] = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    for client in list(_open_clients):
        client.close()


class Subscription:
    """Samples of one key, delivered on a thread of its own until closed. Also a context manager."""

    def __init__(
        self,
        subscriber: Any,
        deliver: Callable[[zenoh.Sample], None],
        name: str,
        on_close: Callable[[Subscription], None] = lambda _: None,
    ) -> None:
        self._subscriber, self._deliver, self._on_close = subscriber, deliver, on_close
        self._thread = threading.Thread(target=self._run, name=f"potclient-{name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        for sample in self._subscriber:  # ends when it is undeclared or the session closes
            try:
                self._deliver(sample)
            except BadReplyError as error:  # somebody else's message, or another version's
                log.warning("%s: %s", sample.key_expr, error)
            except Exception:  # the user's callback: the stream goes on
                log.exception("callback for %s failed", sample.key_expr)

    def close(self) -> None:
        """Stop; the callback may still be running once more when this returns."""
        with contextlib.suppress(zenoh.ZError):
            self._subscriber.undeclare()
        self._on_close(self)

    def __enter__(self) -> Subscription:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class MapClient:
    """A connection to one map. Any thread may call any method.

    Args:
        connect: Zenoh endpoint of the server or of a router on the way to it.
        map: Id of the map.
        root: First chunks of all keys, as the server has it.
        timeout_s: How long an answer may take, unless a call says otherwise.
        receipt_timeout_s: After this long without a receipt a published cloud counts as unknown.
        credit: How many published clouds of a robot may be without a receipt.
        on_receipt: Called with every receipt of a published cloud, on a thread of the client's; keep it short, the next credit
            waits for it.
        on_params: Called with the transported parameters of published clouds; a slow callback misses some (their numbers jump).
        options: Zenoh session options; `connect` is added when they name no endpoint.
    Raises:
        UsageError: an id or an option is not legal.
        NoServerError: nobody listens at the endpoint.
    """

    def __init__(
        self,
        connect: str | None = None,
        *,
        map: str = "default",  # noqa: A002 - the word of the contract
        root: str = DEFAULT_ROOT,
        timeout_s: float = 10.0,
        receipt_timeout_s: float = 10.0,
        credit: int = 2,
        on_receipt: Callable[[Receipt], None] | None = None,
        on_params: Callable[[TransportedParams], None] | None = None,
        options: SessionOptions | None = None,
    ) -> None:
        if timeout_s <= 0 or receipt_timeout_s <= 0 or credit < 1:
            raise UsageError("timeout_s and receipt_timeout_s must be positive, credit at least 1")
        options = options or SessionOptions()
        if connect is not None:
            options = _with_endpoint(options, connect)
        self._where = ", ".join(options.connect) or DEFAULT_ENDPOINT
        self.keys = MapKeys(root, _legal_id(map, "map"))
        self._timeout_s, self._receipt_timeout_s, self._credit = timeout_s, receipt_timeout_s, credit
        self.on_receipt, self._on_params = on_receipt, on_params
        self._lock = threading.RLock()
        self._alive: set[tuple[str, str]] = set()  # (server, map) of every liveliness token under the root
        self._servers_changed = threading.Condition()
        self._feeds: dict[str, Feed] = {}
        self._numberings: dict[str, Numbering] = {}
        self._queriers: dict[str, zenoh.Querier] = {}
        self._pose_publishers: dict[str, zenoh.Publisher] = {}
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._subscriptions: list[Subscription] = []
        self._info: messages.Info | None = None
        self._closed = False
        self._session = open_session(options)
        _open_clients.add(self)
        try:
            self._subscriptions.append(
                Subscription(
                    self._session.liveliness().declare_subscriber(
                        f"@{root}/srv/*/*", zenoh.handlers.FifoChannel(64), history=True
                    ),
                    self._note_server,
                    "servers",
                )
            )
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> MapClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self._closed else f"servers: {', '.join(self.servers) or 'none'}"
        return f"MapClient({self._where}, map={self.keys.map_id!r}, {state})"

    def close(self) -> None:
        """Undeclare everything and leave; never waits longer than some seconds, and a second call does nothing.

        Clouds that still wait are counted as dropped, those on their way as unknown: call `flush` first if they matter.
        """
        with self._lock:
            if self._closed:
                return
            self._closed = True
        with self._servers_changed:
            self._servers_changed.notify_all()
        teardown = threading.Thread(target=self._teardown, name="potclient-close", daemon=True)
        try:
            teardown.start()
        except RuntimeError:  # the interpreter is shutting down and starts no more threads
            self._teardown()
            return
        teardown.join(15.0)
        if teardown.is_alive():
            log.warning("the Zenoh session to %s did not close within 15 s; it is left behind", self._where)

    def _teardown(self) -> None:
        for feed in list(self._feeds.values()):
            feed.close()
        for subscription in list(self._subscriptions):
            subscription.close()
        declared: list[Any] = [
            *self._tokens.values(),
            *self._queriers.values(),
            *self._pose_publishers.values(),
        ]
        for entity in declared:
            with contextlib.suppress(zenoh.ZError):
                entity.undeclare()
        with contextlib.suppress(zenoh.ZError):
            self._session.close()
        _open_clients.discard(self)

    # --- presence ------------------------------------------------------------------------------------------------------------

    @property
    def servers(self) -> tuple[str, ...]:
        """Ids of the servers that serve this map and are warm, as far as has been heard."""
        with self._servers_changed:
            return self._servers_of_map()

    def wait_ready(self, timeout_s: float | None = None) -> str:
        """Wait until a server says that it serves this map and is warm.

        Returns:
            Its id.
        Raises:
            NoServerError: none did within `timeout_s` (default: the client's).
            ClosedError: the client was closed.
        """
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        with self._servers_changed:
            self._servers_changed.wait_for(lambda: self._closed or self._servers_of_map(), timeout_s)
            self._check_open()
            if servers := self._servers_of_map():
                return servers[0]
        raise NoServerError(
            f"no server at {self._where} is ready to serve map {self.keys.map_id!r} after {timeout_s:g} s"
            + self._other_maps_hint()
        )

    def wait_for_match(self, op: str, timeout_s: float | None = None) -> None:
        """Wait until somebody answers questions of a kind, warm or not: one of `keys.QUERY_OPS`.

        Raises:
            NoServerError: nobody does within `timeout_s` (default: the client's).
        """
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        querier = self._querier(self.keys.query(op))
        until = time.monotonic() + timeout_s
        while not self._zenoh_call(_is_matching, querier):
            if time.monotonic() >= until:
                raise NoServerError(f"nobody at {self._where} answers {op!r} for map {self.keys.map_id!r}")
            time.sleep(0.005)
            self._check_open()

    def _note_server(self, sample: zenoh.Sample) -> None:
        _, server, map_id = str(sample.key_expr).rsplit("/", 2)
        with self._servers_changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._alive.add((server, map_id))
            else:
                self._alive.discard((server, map_id))
            self._servers_changed.notify_all()

    def _servers_of_map(self) -> tuple[str, ...]:
        return tuple(sorted(server for server, map_id in self._alive if map_id == self.keys.map_id))

    # --- clouds in -----------------------------------------------------------------------------------------------------------

    def integrate(
        self,
        points: ArrayLike,
        T_map_sensor: ArrayLike | None,
        *,
        robot: str = "r1",
        seq: int | None = None,
        stamp_ns: int | None = None,
        is_return: ArrayLike | None = None,
        timeout_s: float | None = None,
    ) -> Receipt:
        """Add a cloud to the map and wait until it is in; the receipt brings the transported kernels.

        It travels as a query on the lane of the clouds (DATA_LOW, BLOCK): megabytes must not delay the planners' questions on
        the same link, and the reply takes the lane of its query.

        Args:
            points: (N, 3) or (N, 2) m, sensor frame.
            T_map_sensor: (4, 4), rigid; None lets the server interpolate the robot's pose stream.
            is_return: (N,) bool, false = no echo, the beam was free up to this point; None = all are echoes.
            seq: The robot's number of the cloud; None takes the next one.
            stamp_ns: When the scan was taken, Unix time; None takes the clock. Stamps of a robot must grow.
        Raises:
            MapServerError: its subclass for the reason, when the cloud is not accepted; `receipt` is set if there was one.
            NoServerError, QueryTimeoutError, LostReplyError: see there. After the last two the cloud may or may not be in.
            UsageError: an argument has the wrong shape.
        """
        _legal_id(robot, "robot")
        cloud = _cloud(points, T_map_sensor, is_return, robot=robot)
        number, stamp_ns = self._numbering(robot).assign(seq, stamp_ns)
        cloud = _numbered(cloud, number, stamp_ns)
        started = time.monotonic()
        reply = self._ask_one("integrate", cloud, messages.Receipt, timeout_s)
        receipt = Receipt(reply, round_trip_s=time.monotonic() - started)
        if (error := receipt.error()) is not None:
            raise error
        return receipt

    def publish(
        self,
        points: ArrayLike,
        T_map_sensor: ArrayLike | None,
        *,
        robot: str = "r1",
        seq: int | None = None,
        stamp_ns: int | None = None,
        is_return: ArrayLike | None = None,
        wait: bool = False,
        timeout_s: float | None = None,
    ) -> int:
        """Offer a cloud and go on: it is copied into a slot and sent when fewer than `credit` clouds lack a receipt.

        A cloud that still waits in the slot is dropped for the newer one, and counted. Arguments as for `integrate`.

        Args:
            wait: Block until the cloud is sent instead of dropping one: for recordings, where every scan counts.
            timeout_s: Limit of that wait; None = twice the receipt time-out.
        Returns:
            The cloud's number; its receipt carries it.
        Raises:
            UsageError, ClosedError: nothing was offered.
            QueryTimeoutError: `wait`, and the cloud could not be sent in time.
        """
        feed = self._feed(robot)
        cloud = _cloud(points, T_map_sensor, is_return, robot=robot)
        if wait and timeout_s is None:
            timeout_s = 2.0 * self._receipt_timeout_s
        return feed.offer(cloud, seq=seq, stamp_ns=stamp_ns, wait=wait, timeout_s=timeout_s)

    def pose(self, T_map_sensor: ArrayLike, *, stamp_ns: int | None = None, robot: str = "r1") -> None:
        """Publish one pose of the robot's pose stream, for clouds without a pose. May be lost, never waits.

        Raises:
            UsageError: not a (4, 4) matrix.
        """
        _legal_id(robot, "robot")
        message = messages.Pose(
            stamp_ns=time.time_ns() if stamp_ns is None else stamp_ns,
            T_map_sensor=encode_array(_pose(T_map_sensor)),
        )
        with self._lock:
            self._check_open()
            publisher = self._pose_publishers.get(robot)
            if publisher is None:
                publisher = self._session.declare_publisher(
                    self.keys.pose(robot),
                    encoding=encoding_of(messages.Pose),
                    congestion_control=zenoh.CongestionControl.DROP,
                    express=True,
                )
                self._pose_publishers[robot] = publisher
                self._declare_robot(robot)
        self._zenoh_call(publisher.put, encode(message))

    def flush(self, timeout_s: float | None = None, *, late: bool = False) -> bool:
        """Wait until every published cloud has its outcome; false if `timeout_s` (None: no limit) ran out first.

        Args:
            late: Wait also for receipts that are late already; a receipt that is lost never comes, so give a limit.
        """
        until = None if timeout_s is None else time.monotonic() + timeout_s
        done = True
        for feed in list(self._feeds.values()):
            done &= feed.flush(None if until is None else max(0.0, until - time.monotonic()), late=late)
        return done

    def receipts(self, robot: str = "r1", timeout_s: float | None = None) -> Iterator[Receipt]:
        """Receipts of a robot's published clouds as they come; ends when every one has its outcome.

        Raises:
            QueryTimeoutError: none came for `timeout_s` while clouds are on their way.
        """
        feed = self._feeds.get(robot)
        if feed is not None:
            yield from feed.receipts(timeout_s)

    def counts(self, robot: str | None = None) -> FeedCounts:
        """Where the published clouds of a robot are, or of all robots of this client."""
        feeds = (
            list(self._feeds.values()) if robot is None else [f for r, f in self._feeds.items() if r == robot]
        )
        return functools.reduce(FeedCounts.__add__, (feed.counts for feed in feeds), FeedCounts())

    def _feed(self, robot: str) -> Feed:
        with self._lock:
            self._check_open()
            if robot in self._feeds:
                return self._feeds[robot]
            _legal_id(robot, "robot")
            publisher = self._session.declare_publisher(
                self.keys.cloud(robot),
                encoding=encoding_of(messages.Cloud),
                congestion_control=zenoh.CongestionControl.BLOCK,
                priority=zenoh.Priority.DATA_LOW,
            )

            def put(cloud: messages.Cloud) -> None:
                publisher.put(encode(cloud))

            feed = Feed(
                robot,
                put,
                numbering=self._numbering(robot),
                is_matched=lambda: _is_matching(publisher),
                credit=self._credit,
                receipt_timeout_s=self._receipt_timeout_s,
            )
            self._feeds[robot] = feed

            def settle(sample: zenoh.Sample) -> None:
                message = _decode(sample.payload, messages.Receipt)
                receipt = feed.settle(message)
                if receipt is None and feed.stray_receipts == 1:  # once
                    log.warning(
                        "a receipt for cloud %d of %s, which this client did not send: another process uses the robot's id",
                        message.seq,
                        robot,
                    )
                if receipt is not None and self.on_receipt is not None:
                    self.on_receipt(receipt)

            self._subscriptions.append(
                Subscription(
                    self._session.declare_subscriber(
                        self.keys.receipt(robot), zenoh.handlers.FifoChannel(64)
                    ),
                    settle,
                    f"receipts-{robot}",
                )
            )
            if self._on_params is not None:
                self._subscriptions.append(self._params_subscription(robot, self._on_params))
            self._declare_robot(robot)
            return feed

    def _declare_robot(self, robot: str) -> None:
        if robot not in self._tokens:
            self._tokens[robot] = self._session.liveliness().declare_token(self.keys.robot_token(robot))

    def _numbering(self, robot: str) -> Numbering:
        with self._lock:
            return self._numberings.setdefault(robot, Numbering())

    # --- questions -----------------------------------------------------------------------------------------------------------

    def occupancy(
        self, points: ArrayLike, *, with_gradient: bool = False, timeout_s: float | None = None
    ) -> Occupancy:
        """How likely each point is occupied, and how sure the map is.

        Requests beyond the server's limits are split; the parts may then come from neighbouring revisions of the map, which
        `Occupancy.revisions` lists. An overloaded server is asked again for parts of a split request, never for a single one.

        Args:
            points: (N, 3), or (N, 2) with z = 0; m, map frame. float32 input travels as float32.
            with_gradient: Bring the gradients of the mean and of the latent mean too.
            timeout_s: Of one query; None takes the client's. Parts of a split request queue behind each other and may take
                four times as long.
        Raises:
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        dtype = np.float32 if getattr(points, "dtype", None) == np.float32 else np.float64
        queries = np.ascontiguousarray(as_points(points), dtype)
        if len(queries) == 0:
            empty = np.zeros(0, np.float32)
            return Occupancy(
                mean=empty,
                var=empty,
                latent_mean=empty,
                latent_var=empty,
                observed=np.zeros(0, np.bool_),
                gradient=np.zeros((0, 3), np.float32) if with_gradient else None,
                latent_gradient=np.zeros((0, 3), np.float32) if with_gradient else None,
            )
        step = len(queries) if len(queries) <= _SPLIT_ABOVE else self._points_a_query(queries.itemsize * 3)
        chunks = [queries[i : i + step] for i in range(0, len(queries), step)]
        if len(chunks) == 1:
            replies = self._start_points(chunks[0], timeout_s, with_gradient)
            return self._decode_occupancy(replies, len(queries), with_gradient)
        return Occupancy.concatenate(list(self._occupancy_of_chunks(chunks, timeout_s, with_gradient)))

    def _occupancy_of_chunks(
        self, chunks: list[NDArray[Any]], timeout_s: float | None, with_gradient: bool
    ) -> Iterator[Occupancy]:
        timeout_s = _CHUNKS_IN_FLIGHT * (self._timeout_s if timeout_s is None else timeout_s)
        started: deque[tuple[NDArray[Any], Iterator[zenoh.Sample]]] = deque()
        waiting = deque(chunks)
        while waiting or started:
            while waiting and len(started) < _CHUNKS_IN_FLIGHT:
                chunk = waiting.popleft()
                started.append((chunk, self._start_points(chunk, timeout_s, with_gradient)))
            chunk, replies = started.popleft()
            for attempt in range(_CHUNK_RETRIES + 1):
                try:
                    yield self._decode_occupancy(replies, len(chunk), with_gradient)
                    break
                except OverloadedError as error:
                    if attempt == _CHUNK_RETRIES:
                        raise
                    time.sleep(error.retry_after_s or 0.1)
                    replies = self._start_points(chunk, timeout_s, with_gradient)

    def _start_points(
        self, chunk: NDArray[Any], timeout_s: float | None, with_gradient: bool
    ) -> Iterator[zenoh.Sample]:
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        request = messages.PointsQuery(
            points=encode_array(chunk),
            deadline_ms=timeout_s * 1e3,
            with_gradient=True if with_gradient else messages.ABSENT,
        )
        return self._ask("points", request, timeout_s)

    def _decode_occupancy(self, replies: Iterator[zenoh.Sample], n: int, with_gradient: bool) -> Occupancy:
        message = _decode(next(replies).payload, messages.Occupancy)
        return Occupancy.from_message(message, n, with_gradient=with_gradient)

    def _points_a_query(self, bytes_a_point: int) -> int:
        if self._info is None:
            self._info = self.info()
        limits = self._info.limits
        by_bytes = max(1, (limits.max_query_bytes - 1024) // bytes_a_point)
        return max(1, min(limits.max_query_points, by_bytes, _CHUNK_POINTS))

    def grid(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        resolution: float,
        *,
        progress: ProgressCallback | None = None,
        timeout_s: float | None = None,
    ) -> Grid:
        """Occupancy at the cell centres of a box, all from one revision of the map.

        Args:
            lower, upper: (3,) m, map frame.
            resolution: Cell edge, m.
            progress: Called with (parts received, parts in all) as they stream in.
            timeout_s: For the whole grid; None takes the client's.
        Raises:
            IncompleteReplyError: parts are missing, doubled, or from different revisions.
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        lower_m, upper_m = _corner(lower, "lower"), _corner(upper, "upper")
        if not (upper_m > lower_m).all() or not (math.isfinite(resolution) and resolution > 0):
            raise UsageError(
                f"grid: lower {lower_m.tolist()} must be below upper {upper_m.tolist()}, resolution positive"
            )
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        request = messages.GridQuery(
            lower=lower_m.tolist(), upper=upper_m.tolist(), resolution=resolution, deadline_ms=timeout_s * 1e3
        )
        assembly: _GridAssembly | None = None
        cells = np.ceil((upper_m - lower_m) / resolution - 1e-6)
        for sample in self._ask("grid", request, timeout_s):
            part = _decode(sample.payload, messages.GridPart)
            if assembly is None:
                if np.abs(np.asarray(part.shape) - cells).max() > 1:
                    raise BadReplyError(
                        f"grid: asked for about {cells.astype(int).tolist()} cells, got {part.shape}"
                    )
                assembly = _GridAssembly(part)
            assembly.add(part)
            if progress is not None:
                progress(assembly.n_received, part.n_parts)
        assert assembly is not None, "_ask raises when there is no reply"
        return assembly.finish()

    def rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        *,
        quantiles: Sequence[float] = (0.05, 0.5, 0.95),
        unknown: messages.Unknown | str = messages.Unknown.PRIOR,
        width_m: float | None = None,
        step_m: float | None = None,
        timeout_s: float | None = None,
    ) -> Rays:
        """Where rays first return: expected range, its standard deviation, quantiles, and where the map does not know.

        The hazard of a return along a ray is -ln(1 - p) / width, with p the mean of the occupancy: a stretch of one width with
        constant p stops the ray with probability p. Requests that the server finds too large are halved, and halved again;
        their parts may come from neighbouring revisions of the map.

        Args:
            origins: (N, 3) or (N, 2) m, map frame; or one of them, for all rays.
            directions: (N, 3) or (N, 2), of any length but 0.
            max_range_m: Rays end here.
            quantiles: Ascending, of the range to answer.
            unknown: What rays take unobserved space for: occupied (it stops them), free, or prior (p = 0.5).
            width_m: The length over which p counts as one trial; None = the kernels' own there.
            step_m: Longest step of the summation; None = fine enough for the map's kernels.
            timeout_s: Of one query; None takes the client's.
        Raises:
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        ways = as_points(directions)
        starts = as_points(origins)
        if len(starts) == 1:
            starts = np.broadcast_to(starts, ways.shape)
        if len(starts) != len(ways):
            raise UsageError(f"rays: {len(starts)} origins and {len(ways)} directions")
        kind = _unknown(unknown)
        levels = tuple(float(q) for q in quantiles)
        if not all(a < b for a, b in itertools.pairwise((0.0, *levels, 1.0))):
            raise UsageError(f"quantiles {list(levels)}: need ascending numbers between 0 and 1")
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        parts: list[Rays] = []
        first, step = 0, min(max(len(ways), 1), _CHUNK_RAYS)
        while first < len(ways) or not parts:
            run = slice(first, first + step)
            request = messages.RaysQuery(
                origins=encode_array(np.ascontiguousarray(starts[run])),
                directions=encode_array(ways[run].astype(np.float32)),
                max_range_m=_positive("max_range_m", max_range_m),
                quantiles=list(levels),
                unknown=kind,
                width_m=None if width_m is None else _positive("width_m", width_m),
                step_m=None if step_m is None else _positive("step_m", step_m),
                deadline_ms=timeout_s * 1e3,
            )
            n = len(ways[run])
            try:
                reply = self._ask_one("rays", request, messages.Rays, timeout_s)
            except TooLargeError:
                if n <= 1:
                    raise
                step = n // 2
                continue
            parts.append(Rays.from_message(reply, n, levels))
            first += step
        return Rays.concatenate(parts)

    def risk(
        self,
        path: ArrayLike,
        spheres: ArrayLike,
        *,
        unknown: messages.Unknown | str = messages.Unknown.OCCUPIED,
        resolution_m: float | None = None,
        correlation_m: float | None = None,
        dims: int = 3,
        timeout_s: float | None = None,
    ) -> Risk:
        """How likely a robot on a path touches something; all from one revision of the map.

        The robot covers the cells of a lattice, fixed to the map, whose centres lie in its spheres, and the cells of the
        spheres' own centres. The poses count as they are: nothing is covered between them, so give them close together.

        Args:
            path: (P, 4, 4) T_map_body, rigid; or one of them.
            spheres: (S, 4): centre, m, body frame, and radius, m; or one of them.
            unknown: What unobserved cells are taken for: occupied, free, or prior (p = 0.5).
            resolution_m: Edge of a cell; None = half the smallest radius.
            correlation_m: Edge of a cube that counts as one trial in the union; None = the kernels' own width there.
            dims: 2 takes the spheres for discs in the plane z = 0, for planar maps.
            timeout_s: Of the query; None takes the client's.
        Raises:
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        poses, balls = _numbers("path", path), _numbers("spheres", spheres)
        poses = poses[None] if poses.ndim == 2 else poses
        balls = balls[None] if balls.ndim == 1 else balls
        if poses.ndim != 3 or poses.shape[1:] != (4, 4):
            raise UsageError(f"risk: path has shape {poses.shape}, need (P, 4, 4)")
        if balls.ndim != 2 or balls.shape[1] != 4:
            raise UsageError(f"risk: spheres have shape {balls.shape}, need (S, 4): x y z radius")
        if dims not in (2, 3):
            raise UsageError(f"risk: dims is {dims}, need 2 or 3")
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        request = messages.RiskQuery(
            path=encode_array(np.ascontiguousarray(poses)),
            spheres=encode_array(np.ascontiguousarray(balls)),
            unknown=_unknown(unknown),
            resolution_m=None if resolution_m is None else _positive("resolution_m", resolution_m),
            correlation_m=None if correlation_m is None else _positive("correlation_m", correlation_m),
            dims=dims,
            deadline_ms=timeout_s * 1e3,
        )
        return Risk.from_message(self._ask_one("risk", request, messages.Risk, timeout_s), len(poses))

    def params(
        self,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        *,
        timeout_s: float | None = None,
    ) -> KernelSet:
        """The kernels of the overall map, whole or those with hinges inside a box.

        Raises:
            IncompleteReplyError: parts are missing, doubled, or from different revisions.
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        parts = {part: kernels for part, _, kernels in self.params_parts(lower, upper, timeout_s=timeout_s)}
        return KernelSet.concatenate(parts[i] for i in sorted(parts))

    def params_parts(
        self,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        *,
        timeout_s: float | None = None,
    ) -> Iterator[tuple[int, int, KernelSet]]:
        """The kernels as `params` gives them, part by part as they come, in any order: for maps that should not be held whole.

        Yields:
            The part's number, how many parts there are, and its kernels.
        Raises:
            IncompleteReplyError: parts are missing (known after the last one), doubled, or from different revisions.
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        request = messages.ParamsQuery(
            lower=None if lower is None else _corner(lower, "lower").tolist(),
            upper=None if upper is None else _corner(upper, "upper").tolist(),
            deadline_ms=timeout_s * 1e3,
        )
        seen: set[int] = set()
        totals: set[int] = set()
        revisions: set[int] = set()
        for sample in self._ask("params", request, timeout_s):
            part = _decode(sample.payload, messages.ParamsPart)
            if part.part in seen:
                raise IncompleteReplyError(
                    f"params: part {part.part} came twice; do two servers serve this map?"
                )
            seen.add(part.part)
            totals.add(part.n_parts)
            revisions.add(part.map_revision)
            yield (
                part.part,
                part.n_parts,
                KernelSet.from_message(part.kernels, map_revision=part.map_revision),
            )
        _check_parts("params", seen, totals, revisions)

    def mirror(
        self,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        *,
        margin_m: float = _MIRROR_MARGIN_M,
        mantissa_bits: int | None = None,
        timeout_s: float | None = None,
    ) -> MapMirror:
        """A copy of the map, or of a box of it, to ask without the server; its `update` fetches the tiles that changed.

        Nothing is sent before the first `update`. The mirror outlives restarts of the server: its next `update` fetches all
        anew. Close to the edge of a box, kernels beyond it matter too: so the box is widened.

        Args:
            lower, upper: (3,) m, map frame: corners of the box; None = the whole map.
            margin_m: By which a box is widened. Kernels carried from atoms may reach farther than the default.
            mantissa_bits: Round the weights to 2 to 23 bits to save bytes; None = as they are. With b bits each weight is off
                by at most 2^-(b + 1) of itself, the latent mean by that share of sum_m |weight_mean_m| phi_m.
            timeout_s: Of one update; None takes the client's.
        Raises:
            UsageError: an illegal box, margin or number of bits.
        """
        if (lower is None) != (upper is None):
            raise UsageError("mirror: give both corners, or neither for the whole map")
        if not (math.isfinite(margin_m) and margin_m >= 0):
            raise UsageError(f"margin_m is {margin_m}, need 0 or a positive number of metres")
        if mantissa_bits is not None and not 2 <= mantissa_bits <= 23:
            raise UsageError(f"mantissa_bits is {mantissa_bits}, need 2 to 23")
        box = {}
        if lower is not None and upper is not None:
            low, high = _corner(lower, "lower"), _corner(upper, "upper")
            if (high < low).any():
                raise UsageError(f"mirror: lower {low.tolist()} must not be above upper {high.tolist()}")
            box = {"lower": (low - margin_m).tolist(), "upper": (high + margin_m).tolist()}
        wait_s = self._timeout_s if timeout_s is None else timeout_s

        def ask(query: messages.TilesQuery) -> Iterator[tuple[messages.TilesPart, int]]:
            query = msgspec.structs.replace(query, deadline_ms=wait_s * 1e3)
            for sample in self._ask("tiles", query, wait_s):
                yield _decode(sample.payload, messages.TilesPart), len(sample.payload)

        return MapMirror(ask, **box, mantissa_bits=mantissa_bits)

    def atoms(self, *, timeout_s: float | None = None) -> list[messages.AtomInfo]:
        """The server's dictionary, one line an atom."""
        return self._ask_one("atoms", messages.AtomsQuery(), messages.AtomList, timeout_s).atoms

    def atom(self, atom_id: str, *, timeout_s: float | None = None) -> Atom:
        """One atom whole.

        Raises:
            UnknownAtomError: there is none of this id.
        """
        query = messages.AtomsQuery(atom_id=atom_id)
        return Atom.from_message(self._ask_one("atoms", query, messages.Atom, timeout_s))

    def add_atom(self, atom: Atom, *, timeout_s: float | None = None) -> messages.AtomsChanged:
        """Put an atom into the server's dictionary, for all its maps: scans that are integrated from now on may use it.

        Returns:
            How many atoms there are now, and whether the change outlives the server (`persisted`).
        Raises:
            AtomRefusedError: it may not join; `reason` says which rule it breaks.
            ReadOnlyError: the server takes no changes.
            ShapeError, BadPointsError, EmptyError, TooLargeError: its arrays are unsound.
            QueryTimeoutError, LostReplyError: see there; the atom may or may not have joined, `atoms` tells.
        """
        query = messages.AtomsQuery(action=messages.AtomsAction.ADD, atom=atom.to_message())
        return self._ask_one("atoms", query, messages.AtomsChanged, timeout_s)

    def remove_atom(self, atom_id: str, *, timeout_s: float | None = None) -> messages.AtomsChanged:
        """Take an atom out of the server's dictionary; maps keep the kernels that were carried from it.

        Returns, and raises beside UnknownAtomError: as `add_atom`.
        """
        query = messages.AtomsQuery(action=messages.AtomsAction.REMOVE, atom_id=atom_id)
        return self._ask_one("atoms", query, messages.AtomsChanged, timeout_s)

    def info(self, *, timeout_s: float | None = None) -> messages.Info:
        """What the server is, what it holds, and what it accepts."""
        self._info = self._ask_one("info", messages.InfoQuery(), messages.Info, timeout_s)
        return self._info

    def stats(self, server: str | None = None, *, timeout_s: float | None = None) -> messages.Stats:
        """The counters of a server; by default of the one that answers for this map."""
        server = self.info(timeout_s=timeout_s).server if server is None else _legal_id(server, "server")
        key = stats_key(self.keys.root, server)
        sample = next(
            self._ask_key(key, messages.StatsQuery(), self._timeout_s if timeout_s is None else timeout_s)
        )
        return _decode(sample.payload, messages.Stats)

    def save(self, name: str | None = None, *, timeout_s: float | None = None) -> messages.ControlReply:
        """Have the server write its map to the disk now, all clouds sent so far included.

        Args:
            name: Write also a file of its own, from which `load` gets the map back; one of that name is replaced.
            timeout_s: For the answer.
        Raises:
            UnsupportedError: the server keeps its maps in memory only.
            StorageError: its disk did not take it.
        """
        return self.control("save", name=name, timeout_s=timeout_s)

    def load(self, name: str, *, timeout_s: float | None = None) -> messages.ControlReply:
        """Have the server put a saved map in the place of the present one, which is gone then.

        Raises:
            UnknownMapError: none was saved under that name; the message lists those there are.
            MapFileError: the file is damaged, of another version, or does not fit the server's settings.
            UnsupportedError, StorageError: as for `save`. The map is unchanged, as after any error.
        """
        return self.control("load", name=name, timeout_s=timeout_s)

    def merge(
        self, name: str, T_map_saved: ArrayLike | None = None, *, timeout_s: float | None = None
    ) -> messages.ControlReply:
        """Have the server take a saved map into the present one, as if one server had been fed by both.

        Args:
            name: Of the saved map. It must not hold scans that are in the map already: they would count twice.
            T_map_saved: (4, 4) rigid, p_map = T_map_saved @ p_saved; the same frame by default.
            timeout_s: For the answer, see `control`; a large map takes a minute.
        Raises:
            UnknownMapError, MapFileError, UnsupportedError, StorageError: as for `load`.
            BadPoseError: the transform is not rigid. The map is unchanged, as after any error.
        """
        pose = None if T_map_saved is None else np.asarray(T_map_saved, np.float64)
        return self.control("merge", name=name, T_map_saved=pose, timeout_s=timeout_s)

    def forget(self, robot: str, *, timeout_s: float | None = None) -> messages.ControlReply:
        """Have the server take out of its map what one robot has seen.

        Raises:
            UnknownRobotError: the map has nothing from it.
            UnsupportedError: the map keeps kernels alone (profile `paper`).
        """
        return self.control("forget", robot=robot, timeout_s=timeout_s)

    def control(
        self,
        verb: str,
        *,
        name: str | None = None,
        robot: str | None = None,
        T_map_saved: NDArray[np.float64] | None = None,
        timeout_s: float | None = None,
    ) -> messages.ControlReply:
        """Carry out a control verb: save, load, clear, drain, merge, forget.

        Args:
            verb: Which.
            name: Of a saved map, for `save`, `load` and `merge`.
            robot: Whose scans, for `forget`.
            T_map_saved: (4, 4), for `merge`.
            timeout_s: For the answer, by default `CONTROL_TIMEOUT_S`. Work that has begun by then is done all the same.
        Raises:
            UnsupportedError: the server has no such verb.
            QueryTimeoutError: the map may change nevertheless: look at it before you ask again.
        """
        timeout_s = CONTROL_TIMEOUT_S if timeout_s is None else timeout_s
        key = self.keys.control(_legal_id(verb, "verb"))
        request = messages.ControlRequest(
            timeout_s=timeout_s,
            name=messages.ABSENT if name is None else _legal_id(name, "name"),
            robot=messages.ABSENT if robot is None else _legal_id(robot, "robot"),
            T_map_saved=messages.ABSENT if T_map_saved is None else encode_array(T_map_saved),
        )
        try:
            sample = next(self._ask_key(key, request, timeout_s))
        except QueryTimeoutError as error:
            raise QueryTimeoutError(
                f"{error}; the server may still do it: look at the map's revision before you ask again"
            ) from error
        return _decode(sample.payload, messages.ControlReply)

    # --- streams -------------------------------------------------------------------------------------------------------------

    def watch_revisions(self, callback: Callable[[messages.Revision], None]) -> Subscription:
        """Call back with every change of the map, on a thread of the client's. A slow callback skips to the newest 64 ticks."""
        return self._watch(self.keys.revision, messages.Revision, callback, "revisions")

    def watch_receipts(self, callback: Callable[[messages.Receipt], None], robot: str = "*") -> Subscription:
        """Call back with the receipts of a robot, or of all. A slow callback skips to the newest 64."""
        return self._watch(self.keys.receipt(robot), messages.Receipt, callback, "watch-receipts")

    def watch_stats(self, callback: Callable[[messages.Stats], None], server: str = "*") -> Subscription:
        """Call back with a server's counters once a second."""
        return self._watch(stats_key(self.keys.root, server), messages.Stats, callback, "stats")

    def watch_params(self, callback: Callable[[TransportedParams], None], robot: str = "*") -> Subscription:
        """Call back with transported parameters. A slow callback misses some: their numbers jump."""
        with self._lock:
            self._check_open()
            subscription = self._params_subscription(robot, callback)
            self._subscriptions.append(subscription)
            return subscription

    def _params_subscription(self, robot: str, callback: Callable[[TransportedParams], None]) -> Subscription:
        def deliver(sample: zenoh.Sample) -> None:
            m = _decode(sample.payload, messages.Params)
            callback(
                TransportedParams(
                    robot=m.robot,
                    seq=m.seq,
                    stamp_ns=m.stamp_ns,
                    map_revision=m.map_revision,
                    kernels=KernelSet.from_message(m.kernels, map_revision=m.map_revision),
                    sectors=m.sectors,
                )
            )

        subscriber = self._session.declare_subscriber(self.keys.params(robot), zenoh.handlers.RingChannel(16))
        return Subscription(subscriber, deliver, f"params-{robot}", self._forget)

    def _forget(self, subscription: Subscription) -> None:
        with self._lock, contextlib.suppress(ValueError):  # closed twice
            self._subscriptions.remove(subscription)

    def _watch(
        self, key: str, kind: type[MessageT], callback: Callable[[MessageT], None], name: str
    ) -> Subscription:
        with self._lock:
            self._check_open()
            subscription = Subscription(
                self._session.declare_subscriber(key, zenoh.handlers.RingChannel(64)),
                lambda sample: callback(_decode(sample.payload, kind)),
                name,
                self._forget,
            )
            self._subscriptions.append(subscription)
            return subscription

    # --- one question over Zenoh ---------------------------------------------------------------------------------------------

    def _ask_one(self, op: str, request: Message, kind: type[MessageT], timeout_s: float | None) -> MessageT:
        timeout_s = self._timeout_s if timeout_s is None else timeout_s
        return _decode(next(self._ask(op, request, timeout_s)).payload, kind)

    def _ask(self, op: str, request: Message, timeout_s: float) -> Iterator[zenoh.Sample]:
        return self._ask_key(self.keys.query(op), request, timeout_s)

    def _ask_key(self, key: str, request: Message, timeout_s: float) -> Iterator[zenoh.Sample]:
        """Send a question now; the iterator gives the replies as they come and raises for everything that is not one."""
        if not (math.isfinite(timeout_s) and timeout_s > 0):
            raise UsageError(f"timeout_s {timeout_s}: need a positive number of seconds")
        payload = encode(request)
        encoding = encoding_of(request)
        if timeout_s == self._timeout_s:
            handler = self._zenoh_call(self._querier(key).get, payload=payload, encoding=encoding)
        else:  # the time-out of a declared querier is fixed
            handler = self._zenoh_call(
                self._session.get,
                key,
                payload=payload,
                encoding=encoding,
                timeout=timeout_s,
                **_query_qos(key),
            )
        return self._replies(handler, key, len(payload), timeout_s)

    def _replies(self, handler: Any, key: str, n_bytes: int, timeout_s: float) -> Iterator[zenoh.Sample]:
        n = 0
        for reply in handler:
            if reply.ok is not None:
                n += 1
                yield reply.ok
                continue
            payload = reply.err.payload.to_bytes()
            if payload == b"Timeout":
                got = f" ({n} parts had come)" if n else ""
                raise QueryTimeoutError(f"{key}: no answer from {self._where} within {timeout_s:g} s{got}")
            try:
                error: PotclientError = error_from_reply(decode(payload, messages.ErrorReply))
            except WireError:
                error = BadReplyError(f"{key}: an error reply that is none of ours: {payload[:80]!r}")
            raise error
        if n == 0:
            raise self._silence(key, n_bytes)

    def _silence(self, key: str, n_bytes: int) -> PotclientError:
        """Why a question got no answer at all. Zenoh reports all of these alike: as an empty list of replies."""
        if self._closed:
            return ClosedError("the client was closed")
        if not self._zenoh_call(self._session.info.transports):
            return NoServerError(
                f"{key}: the connection to {self._where} is lost; Zenoh reconnects by itself, try again"
            )
        querier = self._querier(key)
        with (
            self._servers_changed
        ):  # the tokens of a session that was opened just now may still be on their way
            is_alive = bool(self._servers_changed.wait_for(self._servers_of_map, _DIAGNOSIS_TIMEOUT_S))
        if not self._zenoh_call(_is_matching, querier):
            if is_alive:
                return LostReplyError(
                    f"{key}: a server for map {self.keys.map_id!r} is up but does not offer this question:"
                    " its version differs, or its access control hides it"
                )
            return NoServerError(
                f"{key}: no server at {self._where} serves map {self.keys.map_id!r}{self._other_maps_hint()}"
            )
        if not is_alive:
            return NoServerError(
                f"{key}: a server is there but not ready (warming up, or just gone); `wait_ready` waits for it"
            )
        return LostReplyError(
            f"{key}: a server is up but the question of {n_bytes} bytes got no answer: denied by access control, above its size"
            " filter, or the server failed while answering"
        )

    def _other_maps_hint(self) -> str:
        with self._servers_changed:
            maps = sorted({map_id for _, map_id in self._alive} - {self.keys.map_id})
        return f"; maps served here: {', '.join(maps)}" if maps else "; start one with `potserver serve`"

    def _querier(self, key: str) -> zenoh.Querier:
        with self._lock:
            self._check_open()
            querier = self._queriers.get(key)
            if querier is None:
                querier = self._session.declare_querier(key, timeout=self._timeout_s, **_query_qos(key))
                self._queriers[key] = querier
            return querier

    def _zenoh_call(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        self._check_open()
        try:
            return function(*args, **kwargs)
        except zenoh.ZError as error:
            self._check_open()
            raise LostReplyError(f"Zenoh: {error}") from error

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedError("the client is closed")


class _GridAssembly:
    """A grid in the making; refuses what does not fit."""

    def __init__(self, first: messages.GridPart) -> None:
        self._first = first
        n = math.prod(first.shape)
        self._arrays: dict[str, NDArray[Any]] = {
            name: np.zeros(n, np.float32) for name in ("mean", "var", "latent_mean", "latent_var")
        }
        self._arrays["observed"] = np.zeros(n, np.bool_)
        self._filled = np.zeros(n, np.bool_)
        self._parts: set[int] = set()

    @property
    def n_received(self) -> int:
        return len(self._parts)

    def add(self, part: messages.GridPart) -> None:
        first = self._first
        if part.occupancy.map_revision != first.occupancy.map_revision:
            raise IncompleteReplyError(
                f"grid: parts of revisions {first.occupancy.map_revision} and {part.occupancy.map_revision};"
                " do two servers serve this map?"
            )
        if (part.shape, part.n_parts, part.lower, part.resolution) != (
            first.shape,
            first.n_parts,
            first.lower,
            first.resolution,
        ):
            raise IncompleteReplyError("grid: the parts disagree on the grid; do two servers serve this map?")
        n = part.occupancy.mean.shape[0] if part.occupancy.mean.shape else 0
        run = slice(part.first_cell, part.first_cell + n)
        if run.stop > len(self._filled):
            raise BadReplyError(f"grid: part {part.part} ends at cell {run.stop} of {len(self._filled)}")
        if part.part in self._parts or self._filled[run].any():
            raise IncompleteReplyError(f"grid: part {part.part} came twice; do two servers serve this map?")
        occupancy = Occupancy.from_message(part.occupancy, n, f"grid part {part.part}")
        for name, array in self._arrays.items():
            array[run] = getattr(occupancy, name)
        self._filled[run] = True
        self._parts.add(part.part)

    def finish(self) -> Grid:
        missing = int((~self._filled).sum())
        if missing or len(self._parts) != self._first.n_parts:
            raise IncompleteReplyError(
                f"grid: {len(self._parts)} of {self._first.n_parts} parts came, {missing} cells are missing"
            )
        nx, ny, nz = self._first.shape
        return Grid(
            lower=np.asarray(self._first.lower, np.float64),
            resolution=self._first.resolution,
            revision=self._first.occupancy.map_revision,
            **{name: array.reshape(nx, ny, nz) for name, array in self._arrays.items()},
        )


def _check_parts(what: str, parts: set[int], totals: set[int], revisions: set[int]) -> None:
    if len(revisions) != 1:
        raise IncompleteReplyError(
            f"{what}: parts of revisions {sorted(revisions)}; do two servers serve this map?"
        )
    # the length first: whoever claims 2^62 parts must not have them counted
    if len(totals) != 1 or len(parts) != max(totals) or max(parts) >= len(parts):
        raise IncompleteReplyError(f"{what}: {len(parts)} of {max(totals)} parts came")


def _query_qos(key: str) -> dict[str, Any]:
    """The lane of a question; its replies take the same one. No consolidation: parts of one reply share a key."""
    priority = _BULK_LANES.get(key.rsplit("/", 1)[-1], zenoh.Priority.INTERACTIVE_HIGH)
    return {
        "consolidation": zenoh.ConsolidationMode.NONE,
        "congestion_control": zenoh.CongestionControl.BLOCK,
        "priority": priority,
        "express": priority == zenoh.Priority.INTERACTIVE_HIGH,
    }


def _is_matching(entity: zenoh.Publisher | zenoh.Querier) -> bool:
    status: Any = entity.matching_status  # an object that is always true; the stub says bool
    return bool(status.matching)


def _decode(payload: zenoh.ZBytes, kind: type[MessageT]) -> MessageT:
    try:
        return decode(payload.to_bytes(), kind)
    except WireError as error:
        raise BadReplyError(f"{error}; do the versions of client and server differ?") from error


def _cloud(
    points: ArrayLike, T_map_sensor: ArrayLike | None, is_return: ArrayLike | None, *, robot: str
) -> messages.Cloud:
    """A cloud message without its number; arrays are copied. Values are left for the server to judge.

    Raises:
        UsageError: an array has the wrong shape.
    """
    try:
        xyz: Float32 = np.asarray(points, np.float32)
        flags = None if is_return is None else np.asarray(is_return, np.bool_)
    except (TypeError, ValueError) as error:
        raise UsageError(f"cloud: not arrays of numbers ({error})") from error
    if xyz.ndim != 2 or xyz.shape[1] not in (2, 3):
        raise UsageError(f"cloud: points have shape {xyz.shape}, need (N, 3) or (N, 2)")
    if flags is not None and flags.shape != (len(xyz),):
        raise UsageError(f"cloud: is_return has shape {flags.shape}, need ({len(xyz)},)")
    return messages.Cloud(
        seq=0,
        stamp_ns=0,
        points=encode_array(xyz),
        T_map_sensor=None if T_map_sensor is None else encode_array(_pose(T_map_sensor)),
        is_return=None if flags is None else encode_array(flags),
        robot=robot,
    )


def _numbered(cloud: messages.Cloud, seq: int, stamp_ns: int) -> messages.Cloud:
    return msgspec.structs.replace(cloud, seq=seq, stamp_ns=stamp_ns)


def _pose(T_map_sensor: ArrayLike) -> Float64:
    try:
        pose: Float64 = np.asarray(T_map_sensor, np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"T_map_sensor: not an array of numbers ({error})") from error
    if pose.shape != (4, 4):
        raise UsageError(f"T_map_sensor: shape {pose.shape}, need (4, 4)")
    return pose


def _numbers(name: str, value: ArrayLike) -> Float64:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name}: not an array of numbers ({error})") from error


def _positive(name: str, value: float) -> float:
    if not (math.isfinite(value) and value > 0):
        raise UsageError(f"{name} is {value}, need a positive number of metres")
    return float(value)


def _unknown(value: messages.Unknown | str) -> messages.Unknown:
    try:
        return messages.Unknown(value)
    except ValueError as error:
        names = ", ".join(kind.value for kind in messages.Unknown)
        raise UsageError(f"unknown space as {value!r}: need one of {names}") from error


def _corner(value: ArrayLike, name: str) -> Float64:
    try:
        corner: Float64 = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name}: not numbers ({error})") from error
    if corner.shape != (3,) or not np.isfinite(corner).all():
        raise UsageError(f"{name}: need three finite numbers (x y z, m, map frame), not {value!r}")
    return corner


def _legal_id(value: str, what: str) -> str:
    try:
        return check_id(value, what)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _with_endpoint(options: SessionOptions, endpoint: str) -> SessionOptions:
    return options if options.connect else dataclasses.replace(options, connect=(endpoint,))
