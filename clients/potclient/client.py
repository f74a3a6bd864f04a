"""`MapClient`: feed a map and ask it, from any process."""

from __future__ import annotations

import atexit
import dataclasses
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType

import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from potclient.arguments import legal_id, map_keys
from potclient.clouds import Clouds, cloud_message
from potclient.dictionary import DictionaryMethods
from potclient.errors import UsageError
from potclient.feed import FeedOptions
from potclient.kernels import KernelSet
from potclient.link import Link, MessageT, Subscription
from potclient.mirror import MapMirror
from potclient.occupancy import Grid, Occupancy
from potclient.questions import control, grid, info, params, rays, risk, tiles
from potclient.questions.grid import ProgressCallback
from potclient.questions.points import PointsQuestion
from potclient.questions.rays import Rays
from potclient.questions.risk import Risk
from potclient.questions.tiles import MIRROR_MARGIN_M, MIRROR_STEP
from potclient.results import FeedCounts, Receipt, TransportedParams
from potclient.session import SessionOptions
from potclient.watched import WatchedCloud, watch_clouds
from potschemas import messages
from potschemas.keys import DEFAULT_ROOT, stats_key

log = logging.getLogger("potclient")

_CLOSE_S = 15.0

# Who forgets one leaves its threads inside Zenoh: it is closed at the end, and not collected before.
_open_clients: set[MapClient] = set()


@atexit.register
def _close_all() -> None:
    for client in list(_open_clients):
        client.close()


class MapClient(DictionaryMethods):
    """A connection to one map. Any thread may call any method.

    Args:
        connect: Zenoh endpoint of the server or of a router on the way to it.
        map: Id of the map.
        root: First chunks of all keys, as the server has it.
        timeout_s: How long an answer may take, unless a call says otherwise.
        feed: How clouds are published, and who is told of their receipts.
        options: Zenoh session options; `connect` is added when they name no endpoint.
        session: An open Zenoh session to use instead of one of our own; it stays open when the client is closed.
    Raises:
        UsageError: an id, the root or an option is not legal.
        NoServerError: nobody listens at the endpoint. AccessError: somebody does, and does not let us in.
    """

    def __init__(
        self,
        connect: str | None = None,
        *,
        map: str = "default",  # noqa: A002 - the word of the contract
        root: str = DEFAULT_ROOT,
        timeout_s: float = 10.0,
        feed: FeedOptions | None = None,
        options: SessionOptions | None = None,
        session: zenoh.Session | None = None,
    ) -> None:
        if timeout_s <= 0:
            raise UsageError("timeout_s must be positive")
        options = options or SessionOptions()
        if connect is not None and not options.connect:
            options = dataclasses.replace(options, connect=(connect,))
        self.keys = map_keys(root, map)
        self._link = Link(self.keys, options, timeout_s, session)
        self._clouds = Clouds(self._link, feed or FeedOptions())
        self._points = PointsQuestion(self._link)
        self._lock = threading.Lock()  # for whoever closes first
        _open_clients.add(self)

    def __enter__(self) -> MapClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        state = "closed" if self._link.is_closed else f"servers: {', '.join(self.servers) or 'none'}"
        return f"MapClient({self._link.where}, map={self.keys.map_id!r}, {state})"

    def close(self) -> None:
        """Undeclare everything and leave; never waits longer than some seconds, and a second call does nothing.

        Clouds that still wait are counted as dropped, those on their way as unknown: call `flush` first if they matter.
        """
        with self._lock:
            if self._link.is_closed:
                return
            self._link.end_waits()
        caller = threading.current_thread()
        teardown = threading.Thread(
            target=self._teardown, args=(caller,), name="potclient-close", daemon=True
        )
        try:
            teardown.start()
        except RuntimeError:  # the interpreter is shutting down and starts no more threads
            self._teardown(caller)
            return
        teardown.join(_CLOSE_S)
        if teardown.is_alive():
            log.warning(
                "the Zenoh session to %s did not close within %g s; it is left behind",
                self._link.where,
                _CLOSE_S,
            )

    def _teardown(self, caller: threading.Thread) -> None:
        self._clouds.close()
        self._link.close(caller)
        _open_clients.discard(self)

    # --- who serves -----------------------------------------------------------------------------------------------------------

    @property
    def servers(self) -> tuple[str, ...]:
        """Ids of the servers that serve this map and are warm, as far as has been heard."""
        return self._link.servers

    def wait_ready(self, timeout_s: float | None = None) -> str:
        """Wait until a server says that it serves this map and is warm.

        Returns:
            Its id.
        Raises:
            NoServerError: none did within `timeout_s` (default: the client's).
            ClosedError: the client was closed.
        """
        return self._link.wait_ready(timeout_s)

    def wait_for_match(self, op: str, timeout_s: float | None = None) -> None:
        """Wait until somebody answers questions of a kind, warm or not: `points`, `grid`, ...

        Raises:
            NoServerError: nobody does within `timeout_s` (default: the client's).
        """
        self._link.wait_for_match(op, timeout_s)

    # --- clouds in ------------------------------------------------------------------------------------------------------------

    @property
    def on_receipt(self) -> Callable[[Receipt], None] | None:
        """Called with every receipt of a published cloud, see `FeedOptions`; may be exchanged at any time."""
        return self._clouds.on_receipt

    @on_receipt.setter
    def on_receipt(self, callback: Callable[[Receipt], None] | None) -> None:
        self._clouds.on_receipt = callback

    @property
    def session(self) -> str:
        """The run that this client's numbers belong to, drawn when the client was made.

        A server takes a robot's clouds of one session in the order of their numbers, each once.
        """
        return self._clouds.session

    @session.setter
    def session(self, name: str) -> None:
        self._clouds.session = legal_id(name, "session")

    def integrate(
        self,
        points: ArrayLike,
        T_map_sensor: ArrayLike | None,
        *,
        robot: str = "r1",
        seq: int | None = None,
        stamp_ns: int | None = None,
        is_return: ArrayLike | None = None,
        params: str | None = None,
        timeout_s: float | None = None,
    ) -> Receipt:
        """Add a cloud to the map and wait until it is in; the receipt brings the cloud's own kernels.

        Args:
            points: (N, 3) or (N, 2) m, sensor frame.
            T_map_sensor: (4, 4), rigid; None lets the server interpolate the robot's pose stream.
            is_return: (N,) bool, false = no echo, the beam was free up to this point; None = all are echoes.
            seq: The robot's number of the cloud, which must grow; None takes the next one.
            stamp_ns: When the scan was taken, Unix time; None takes the clock. It places the cloud in a pose stream.
            params: Which kernels come back: "fitted" to the cloud (the default), "transported" from atoms, or "none".
        Raises:
            MapServerError: its subclass for the reason, when the cloud is not accepted; `receipt` is set if there was one.
            NoServerError, QueryTimeoutError, LostReplyError: see there. After the last two the cloud may or may not be in.
            UsageError: an argument has the wrong shape.
        """
        cloud = cloud_message(points, T_map_sensor, is_return, robot, params)
        return self._clouds.integrate(cloud, seq=seq, stamp_ns=stamp_ns, timeout_s=timeout_s)

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
        cloud = cloud_message(points, T_map_sensor, is_return, robot)
        return self._clouds.publish(cloud, seq=seq, stamp_ns=stamp_ns, wait=wait, timeout_s=timeout_s)

    def pose(self, T_map_sensor: ArrayLike, *, stamp_ns: int | None = None, robot: str = "r1") -> None:
        """Publish one pose of the robot's pose stream, for clouds without a pose. May be lost, never waits.

        Raises:
            UsageError: not a (4, 4) matrix.
        """
        self._clouds.pose(T_map_sensor, stamp_ns=stamp_ns, robot=robot)

    def flush(self, timeout_s: float | None = None, *, late: bool = False) -> bool:
        """Wait until every published cloud has its outcome; false if `timeout_s` (None: no limit) ran out first.

        Args:
            late: Wait also for receipts that are late already; a receipt that is lost never comes, so give a limit.
        """
        return self._clouds.flush(timeout_s, late=late)

    def receipts(self, robot: str = "r1", timeout_s: float | None = None) -> Iterator[Receipt]:
        """Receipts of a robot's published clouds as they come; ends when every one has its outcome.

        Raises:
            QueryTimeoutError: none came for `timeout_s` while clouds are on their way.
        """
        return self._clouds.receipts(robot, timeout_s)

    def counts(self, robot: str | None = None) -> FeedCounts:
        """Where the published clouds of a robot are, or of all robots of this client."""
        return self._clouds.counts(robot)

    # --- questions ------------------------------------------------------------------------------------------------------------

    def occupancy(
        self,
        points: ArrayLike,
        *,
        with_gradient: bool = False,
        evidence_only: bool = False,
        timeout_s: float | None = None,
    ) -> Occupancy:
        """How likely each point is occupied, and how sure the map is.

        Requests beyond the server's limits are split; the parts may then come from neighbouring revisions of the map, which
        `Occupancy.revisions` lists. An overloaded server is asked again for parts of a split request, never for a single one.

        Args:
            points: (N, 3), or (N, 2) with z = 0; m, map frame. float32 input travels as float32.
            with_gradient: Bring the gradients of the mean and of the latent mean too.
            evidence_only: Borrow nothing from what the dictionary expects: what is not observed is unknown.
            timeout_s: Of one query; None takes the client's. Parts of a split request queue and may take four times as long.
        Raises:
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        return self._points.occupancy(
            points, with_gradient=with_gradient, evidence_only=evidence_only, timeout_s=timeout_s
        )

    def grid(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        resolution: float,
        *,
        evidence_only: bool = False,
        progress: ProgressCallback | None = None,
        timeout_s: float | None = None,
    ) -> Grid:
        """Occupancy at the cell centres of a box, all from one revision of the map.

        Args:
            lower, upper: (3,) m, map frame.
            resolution: Cell edge, m.
            evidence_only: As for `occupancy`.
            progress: Called with (parts received, parts in all) as they stream in.
            timeout_s: For the whole grid; None takes the client's.
        Raises:
            IncompleteReplyError: parts are missing, doubled, or from different revisions.
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        wanted = grid.Wanted(lower, upper, resolution, evidence_only)
        return grid.grid(self._link, wanted, progress=progress, timeout_s=timeout_s)

    def rays(
        self,
        origins: ArrayLike,
        directions: ArrayLike,
        max_range_m: float,
        *,
        quantiles: Sequence[float] = (0.05, 0.5, 0.95),
        unknown: messages.Unknown | str = messages.Unknown.PRIOR,
        evidence_only: bool = False,
        timeout_s: float | None = None,
        **summation: float | None,
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
            unknown: What rays take unobserved space for: occupied (it stops them), free, or prior (what the map expects there,
                or p = 0.5).
            evidence_only: As for `occupancy`.
            timeout_s: Of one query; None takes the client's.
            summation: `width_m`, the length over which p counts as one trial (None = the kernels' own there), and `step_m`, the
                longest step of the sum (None = fine enough for the map's kernels).
        Raises:
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        options = rays.RayOptions(
            max_range_m=max_range_m,
            quantiles=quantiles,
            unknown=unknown,
            evidence_only=evidence_only,
            **summation,
        )
        return rays.rays(self._link, origins, directions, options, timeout_s)

    def risk(
        self,
        path: ArrayLike,
        spheres: ArrayLike,
        *,
        unknown: messages.Unknown | str = messages.Unknown.OCCUPIED,
        resolution_m: float | None = None,
        correlation_m: float | None = None,
        dims: int = 3,
        evidence_only: bool = False,
        timeout_s: float | None = None,
    ) -> Risk:
        """How likely a robot on a path touches something; all from one revision of the map.

        The robot covers the cells of a lattice, fixed to the map, whose centres lie in its spheres, and the cells of the
        spheres' own centres. The poses count as they are: nothing is covered between them, so give them close together.

        Args:
            path: (P, 4, 4) T_map_body, rigid; or one of them.
            spheres: (S, 4): centre, m, body frame, and radius, m; or one of them.
            unknown: What unobserved cells are taken for: occupied, free, or prior (what the map expects there, or p = 0.5).
            resolution_m: Edge of a cell; None = half the smallest radius.
            correlation_m: Edge of a cube that counts as one trial in the union; None = the kernels' own width there.
            dims: 2 takes the spheres for discs in the plane z = 0, for planar maps.
            evidence_only: As for `occupancy`.
            timeout_s: Of the query; None takes the client's.
        Raises:
            MapServerError, NoServerError, QueryTimeoutError, LostReplyError, UsageError: see there.
        """
        options = risk.RiskOptions(
            unknown=unknown,
            resolution_m=resolution_m,
            correlation_m=correlation_m,
            dims=dims,
            evidence_only=evidence_only,
        )
        return risk.risk(self._link, path, spheres, options, timeout_s)

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
        return params.params_parts(self._link, lower, upper, timeout_s)

    def mirror(
        self,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        *,
        margin_m: float = MIRROR_MARGIN_M,
        step: float | None = MIRROR_STEP,
        timeout_s: float | None = None,
    ) -> MapMirror:
        """A copy of the map, or of a box of it, to ask without the server; its `update` fetches the tiles that changed.

        Nothing is sent before the first `update`. The mirror outlives restarts of the server: its next `update` fetches all
        anew. Close to the edge of a box, kernels beyond it matter too: so the box is widened.

        Args:
            lower, upper: (3,) m, map frame: corners of the box; None = the whole map.
            margin_m: By which a box is widened. Kernels carried from atoms may reach farther than the default.
            step: Means of weights come as multiples of it, log-odds, and variances in steps of three times that share of
                themselves: few bytes then tell what has changed. At the default a probability is within .02 of the server's,
                but for points at the edge of what is known. None = exact, at eight times the bytes.
            timeout_s: Of one update; None takes the client's.
        Raises:
            UsageError: an illegal box, margin or step.
        """
        return tiles.mirror(
            self._link,
            lower,
            upper,
            margin_m=margin_m,
            step=step,
            timeout_s=timeout_s,
        )

    def info(self, *, timeout_s: float | None = None) -> messages.Info:
        """What the server is, what it holds, and what it accepts."""
        answer = info.info(self._link, timeout_s)
        self._points.limits = answer.limits
        return answer

    def stats(self, server: str | None = None, *, timeout_s: float | None = None) -> messages.Stats:
        """The counters of a server; by default of the one that answers for this map."""
        return info.stats(self._link, server, timeout_s)

    # --- changes of the map ---------------------------------------------------------------------------------------------------

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
        return control.control(
            self._link, verb, name=name, robot=robot, T_map_saved=T_map_saved, timeout_s=timeout_s
        )

    # --- streams --------------------------------------------------------------------------------------------------------------

    def watch_revisions(self, callback: Callable[[messages.Revision], None]) -> Subscription:
        """Call back with every change of the map, on a thread of the client's. A slow callback skips to the newest 64 ticks."""
        return self._watch(self.keys.revision, messages.Revision, callback, "revisions")

    def watch_receipts(self, callback: Callable[[messages.Receipt], None], robot: str = "*") -> Subscription:
        """Call back with the receipts of a robot, or of all. A slow callback skips to the newest 64."""
        return self._watch(self.keys.receipt(robot), messages.Receipt, callback, "watch-receipts")

    def watch_stats(self, callback: Callable[[messages.Stats], None], server: str = "*") -> Subscription:
        """Call back with a server's counters once a second."""
        return self._watch(stats_key(self.keys.root, server), messages.Stats, callback, "stats")

    def watch_clouds(self, callback: Callable[[WatchedCloud], None], robot: str = "*") -> Subscription:
        """Call back with the clouds that robots publish (not those of `integrate`). A slow callback skips to the newest 16."""
        return watch_clouds(self._link, robot, callback)

    def watch_params(self, callback: Callable[[TransportedParams], None], robot: str = "*") -> Subscription:
        """Call back with the parameters of clouds. A slow callback misses some: their numbers jump."""
        return params.watch_params(self._link, robot, callback)

    def _watch(
        self, key: str, kind: type[MessageT], callback: Callable[[MessageT], None], name: str
    ) -> Subscription:
        return self._link.subscribe(key, kind, callback, name, zenoh.handlers.RingChannel(64))
