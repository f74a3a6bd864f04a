"""What the server answers: `q/<op>` and `ctl/<verb>` of each map, and `srv/<server>/stats`.

One complete queryable a key expression, so that Zenoh asks one server and not all. Threads of the
declarations only admit; replies are sent by workers. Replies take the quality of service of their query, so
the asker sets the lane.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import zenoh

from potschemas import keys, messages
from potserver.adapters import codec
from potserver.adapters.intake import Barrier, CloudJob, IntakeQueue
from potserver.adapters.key_exprs import is_wild
from potserver.adapters.log import get_logger
from potserver.adapters.outbox import Outbox
from potserver.adapters.ports import Asker, Mapper, RayPlan, RiskPlan
from potserver.adapters.query_pool import QueryJob, QueryPool
from potserver.adapters.receipts import ReceiptSender
from potserver.adapters.writer import MapWriter
from potserver.atoms.store import AtomChange, AtomStore
from potserver.errors import (
    BadMessageError,
    DeadlineError,
    PotserverError,
    ShuttingDownError,
    UnsupportedError,
)
from potserver.health import Health
from potserver.limits import Limits

log = get_logger("potserver.queries")

INTEGRATE = "integrate"
_SHORT = (
    "atoms",
    "info",
)  # answered past the grids that wait; a change of the atoms is rare, and short beside a grid
_BACKLOG = 64  # queries between Zenoh and our admission; admission takes microseconds
_BUG = "a bug of the server; the traceback is in its log"


class MapQueryable:
    """All `q/<op>` of one map."""

    def __init__(
        self,
        session: zenoh.Session,
        map_keys: keys.MapKeys,
        *,
        mapper: Mapper,
        asker: Asker,
        atoms: AtomStore,
        intake: IntakeQueue,
        receipts: ReceiptSender,
        pool: QueryPool,
        health: Health,
        limits: Limits,
        grid_part_cells: int,
        params_part_kernels: int,
        tiles_part_kernels: int,
        encode_info: Callable[[], codec.Wire],
    ) -> None:
        self._keys = map_keys
        self._mapper, self._asker, self._atom_store = mapper, asker, atoms
        self._intake, self._receipts, self._pool = intake, receipts, pool
        self._health, self._limits = health, limits
        self._grid_part_cells, self._params_part_kernels = grid_part_cells, params_part_kernels
        self._tiles_part_kernels = tiles_part_kernels
        self._encode_info = encode_info
        self._ops: dict[
            str, tuple[type[messages.Message], Callable[[bytes, float], Iterator[codec.Wire]]]
        ] = {
            "points": (messages.PointsQuery, self._points),
            "grid": (messages.GridQuery, self._grid),
            "rays": (messages.RaysQuery, self._rays),
            "risk": (messages.RiskQuery, self._risk),
            "params": (messages.ParamsQuery, self._params),
            "tiles": (messages.TilesQuery, self._tiles),
            "atoms": (messages.AtomsQuery, self._atoms),
            "info": (messages.InfoQuery, self._info),
        }
        self._queryable = session.declare_queryable(
            map_keys.query("*"), zenoh.handlers.FifoChannel(_BACKLOG), complete=True
        )

    def run(self) -> None:
        """Admit queries until undeclared, on a thread of our own."""
        for query in self._queryable:
            op = "unknown"
            try:
                self._health.count("queries.received")
                op = self._admit(query)
            except PotserverError as error:
                self._refuse(query, _op_of(query, (INTEGRATE, *self._ops)) or op, error)
            except Exception:
                log.exception("query_admission_failed", key=str(query.key_expr))
                self._refuse(query, op, PotserverError(_BUG))

    def undeclare(self) -> None:
        """Take no more; ends `run`."""
        self._queryable.undeclare()

    # --- admission ------------------------------------------------------------------------------------------

    def _admit(self, query: zenoh.Query) -> str:
        op = _op_of(query, (INTEGRATE, *self._ops))
        if op is None:
            raise UnsupportedError(
                f"no operation {_last_chunk(query)!r}; ask for one of {', '.join((INTEGRATE, *self._ops))}"
            )
        n_bytes = len(query.payload) if query.payload is not None else 0
        if op == INTEGRATE:
            self._admit_cloud(query)
            return op
        kind, handler = self._ops[op]
        codec.check_size(n_bytes, self._limits.max_query_bytes, f"{op} query")
        codec.check_encoding(_encoding(query), kind)
        self._pool.submit(
            QueryJob(
                answer=lambda arrived_s: self._answer(query, op, handler, arrived_s),
                refuse=lambda error: self._refuse(query, op, error),
                n_bytes=n_bytes,
                is_short=op in _SHORT,
            )
        )
        return op

    def _admit_cloud(self, query: zenoh.Query) -> None:
        if is_wild(query.key_expr):
            raise UnsupportedError("integrate changes a map: name the map, wildcards are not taken")
        self._health.count("clouds.received")
        job = CloudJob(robot_id=None, payload=query.payload or zenoh.ZBytes(b""), query=query)
        try:
            codec.check_size(job.n_bytes, self._limits.max_cloud_bytes, "cloud")
            codec.check_encoding(_encoding(query), messages.Cloud)
        except PotserverError as error:
            self._receipts.refuse(job, error)
            return
        for refused, why in self._intake.admit(job):
            self._receipts.refuse(refused, why)

    # --- answers, on a worker thread ------------------------------------------------------------------------

    def _answer(
        self,
        query: zenoh.Query,
        op: str,
        handler: Callable[[bytes, float], Iterator[codec.Wire]],
        arrived_s: float,
    ) -> None:
        try:
            # hostile numbers may overflow; the checks see the infinity, the log needs no warning
            with query, np.errstate(over="ignore"):  # `with query` ends the replies on every path
                try:
                    payload = query.payload.to_bytes() if query.payload is not None else b""
                    for reply in handler(payload, arrived_s):
                        query.reply(self._keys.query(op), reply.payload, encoding=reply.encoding)
                    self._health.count(f"queries.{op}.ok")
                    self._health.observe(op, (time.monotonic() - arrived_s) * 1e3)
                except PotserverError as error:  # expected: the asker gets a typed reply
                    self._reply_error(query, op, error)
                except Exception:  # a bug: the traceback stays here
                    if self._pool.is_closing:  # the pool has cut the query off
                        return
                    log.exception("query_failed", key=self._keys.query(op))
                    self._reply_error(query, op, PotserverError(_BUG))
        except Exception:
            log.exception("query_reply_failed", key=self._keys.query(op))

    def _points(self, payload: bytes, arrived_s: float) -> Iterator[codec.Wire]:
        request = codec.decode_points_query(payload, self._limits)
        _check_deadline(arrived_s, request.deadline_ms)
        yield codec.encode_occupancy(
            self._asker.occupancy(request.points, with_gradient=request.with_gradient)
        )

    def _grid(self, payload: bytes, arrived_s: float) -> Iterator[codec.Wire]:
        request = codec.decode_grid_query(payload)
        _check_deadline(arrived_s, request.deadline_ms)
        plan = self._asker.grid(
            request.lower, request.upper, request.resolution, part_cells=self._grid_part_cells
        )
        for part in range(plan.n_parts):
            self._check_may_go_on(arrived_s, request.deadline_ms)
            first_cell, occupancy = plan.part(part)
            yield codec.encode_grid_part(
                part=part,
                n_parts=plan.n_parts,
                shape=plan.shape,
                first_cell=first_cell,
                lower=request.lower,
                resolution=request.resolution,
                occupancy=occupancy,
            )

    def _rays(self, payload: bytes, arrived_s: float) -> Iterator[codec.Wire]:
        request = codec.decode_rays_query(payload, self._limits)
        _check_deadline(arrived_s, request.deadline_ms)
        plan = self._asker.rays(
            request.origins,
            request.directions,
            request.max_range_m,
            quantiles=request.quantiles,
            unknown=request.unknown,
            width_m=request.width_m,
            step_m=request.step_m,
        )
        yield codec.encode_rays(plan.result(self._parts(plan, arrived_s, request.deadline_ms)))

    def _risk(self, payload: bytes, arrived_s: float) -> Iterator[codec.Wire]:
        request = codec.decode_risk_query(payload, self._limits)
        _check_deadline(arrived_s, request.deadline_ms)
        plan = self._asker.risk(
            request.path,
            request.spheres,
            unknown=request.unknown,
            resolution_m=request.resolution_m,
            correlation_m=request.correlation_m,
            dims=request.dims,
        )
        yield codec.encode_risk(plan.result(self._parts(plan, arrived_s, request.deadline_ms)))

    def _parts(self, plan: RayPlan | RiskPlan, arrived_s: float, deadline_ms: float | None) -> Iterator[Any]:
        """The parts of an answer that goes out whole."""
        for part in range(plan.n_parts):
            self._check_may_go_on(arrived_s, deadline_ms)
            yield plan.part(part)

    def _params(self, payload: bytes, arrived_s: float) -> Iterator[codec.Wire]:
        request = codec.decode_params_query(payload)
        _check_deadline(arrived_s, request.deadline_ms)
        parts, revision = self._asker.params(
            request.lower, request.upper, part_kernels=self._params_part_kernels
        )
        snapshot = self._mapper.snapshot
        for part, kernels in enumerate(parts):
            self._check_may_go_on(arrived_s, request.deadline_ms)
            yield codec.encode_params_part(
                part=part,
                n_parts=len(parts),
                map_revision=revision,
                kernels=kernels,
                rule=snapshot.rule,
            )

    def _tiles(self, payload: bytes, arrived_s: float) -> Iterator[codec.Wire]:
        request = codec.decode_tiles_query(payload, self._limits)
        _check_deadline(arrived_s, request.deadline_ms)
        plan = self._asker.tiles(
            request.known,
            lower=request.lower,
            upper=request.upper,
            mantissa_bits=request.mantissa_bits,
            part_kernels=self._tiles_part_kernels,
        )
        for part in range(plan.n_parts):
            self._check_may_go_on(arrived_s, request.deadline_ms)
            yield codec.encode_tiles_part(plan, part)

    def _check_may_go_on(self, arrived_s: float, deadline_ms: float | None) -> None:
        """Between the parts of an answer.

        Raises:
            DeadlineError: the asker waits no longer.
            ShuttingDownError: nor does the server.
        """
        _check_deadline(arrived_s, deadline_ms)
        if self._pool.is_closing:
            raise ShuttingDownError("the server is closing")

    def _atoms(self, payload: bytes, _arrived_s: float) -> Iterator[codec.Wire]:
        request = codec.decode_atoms_query(payload, self._limits)
        dictionary, usage = self._mapper.dictionary, self._mapper.atom_usage
        if request.action is not messages.AtomsAction.READ:
            yield codec.encode_atoms_changed(self._change_atoms(request))
        elif request.atom_id is None:
            yield codec.encode_atom_list(dictionary, usage)
        else:
            yield codec.encode_atom(dictionary.get(request.atom_id), usage, self._mapper.snapshot.rule)

    def _change_atoms(self, request: codec.AtomsRequest) -> AtomChange:
        try:
            if request.atom is not None:
                change, verb = self._atom_store.add(request.atom), "added"
            else:
                change, verb = self._atom_store.remove(str(request.atom_id)), "removed"
        except PotserverError as error:
            self._health.count(f"atoms.refused.{error.reason or error.code}")
            raise
        self._health.count(f"atoms.{verb}")
        log.info(f"atom_{verb}", atom_id=change.atom_id, n_atoms=change.n_atoms, persisted=change.persisted)
        return change

    def _info(self, payload: bytes, _arrived_s: float) -> Iterator[codec.Wire]:
        codec.decode_info_query(payload)
        yield self._encode_info()

    # --- errors ---------------------------------------------------------------------------------------------

    def _refuse(self, query: zenoh.Query, op: str, error: PotserverError) -> None:
        with query:
            self._reply_error(query, op, error)

    def _reply_error(self, query: zenoh.Query, op: str, error: PotserverError) -> None:
        self._health.count(f"queries.{op}.{error.code}")
        log.debug(
            "query_refused", map_id=self._keys.map_id, op=op, reason=error.code, detail=str(error)[:300]
        )
        _reply_err(query, error)


class ControlQueryable:
    """`ctl/<verb>` of one map. Each follows every cloud that was admitted before it."""

    def __init__(
        self,
        session: zenoh.Session,
        map_keys: keys.MapKeys,
        *,
        mapper: Mapper,
        intake: IntakeQueue,
        writer: MapWriter,
        withdraw: Callable[[], None],
        prompt: Outbox,
        health: Health,
        limits: Limits,
    ) -> None:
        self._keys, self._mapper, self._intake = map_keys, mapper, intake
        self._writer, self._withdraw = writer, withdraw
        self._prompt, self._health, self._limits = prompt, health, limits
        self._queryable = session.declare_queryable(
            map_keys.control("*"), zenoh.handlers.FifoChannel(4), complete=True
        )

    def run(self) -> None:
        """Admit requests until undeclared, on a thread of our own."""
        for query in self._queryable:
            verb = _op_of(query, keys.CONTROL_VERBS) or "unknown"
            try:
                self._admit(query, verb)
            except PotserverError as error:
                self._refuse(query, verb, error)
            except Exception:
                log.exception("control_failed", key=str(query.key_expr))
                self._refuse(query, verb, PotserverError(_BUG))

    def undeclare(self) -> None:
        """Take no more; ends `run`."""
        self._queryable.undeclare()

    def _admit(self, query: zenoh.Query, verb: str) -> None:
        if is_wild(query.key_expr):
            raise UnsupportedError(
                "control changes a map: name the map and the verb, wildcards are not taken"
            )
        if verb == "unknown":
            raise UnsupportedError(
                f"no verb {_last_chunk(query)!r}; there are {', '.join(keys.CONTROL_VERBS)}"
            )
        payload = query.payload
        codec.check_size(
            len(payload) if payload is not None else 0, self._limits.max_query_bytes, "control request"
        )
        codec.check_encoding(_encoding(query), messages.ControlRequest)
        request = codec.decode_control(payload.to_bytes() if payload is not None else b"")
        timeout_s = request.timeout_s
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        work = self._work(verb, request)

        def run() -> None:
            try:
                if deadline_s is not None and time.monotonic() > deadline_s:
                    raise DeadlineError(
                        f"{verb}: {timeout_s} s passed before the clouds ahead of it were mapped"
                    )
                done = work()
            except PotserverError as error:
                self._refuse(query, verb, error)
            except Exception:
                log.exception("control_failed", key=self._keys.control(verb))
                self._refuse(query, verb, PotserverError(_BUG))
            else:
                self._done(query, verb, done)

        is_drain = verb == "drain"
        self._intake.admit_barrier(
            Barrier(run, lambda error: self._refuse(query, verb, error)), is_last=is_drain
        )
        if is_drain:
            self._withdraw()
            log.info("map_draining", map_id=self._keys.map_id)

    def _work(self, verb: str, request: codec.ControlRequest) -> Callable[[], str]:
        """What the writer thread shall do; it returns what was done, for people."""
        name, robot_id, pose = request.name, request.robot_id, request.T_map_saved
        for what, given, verbs in (
            ("name", name, ("save", "load", "merge")),
            ("robot", robot_id, ("forget",)),
            ("T_map_saved", pose, ("merge",)),
        ):
            if given is not None and verb not in verbs:
                raise BadMessageError(f"{verb} takes no {what}")
        if verb == "save":
            return lambda: self._writer.save(name)
        if verb in ("load", "merge"):
            if name is None:
                raise BadMessageError(f"{verb} needs the name of a saved map")
            if verb == "load":
                return lambda: self._writer.load(name)
            return lambda: self._writer.merge(name, np.eye(4) if pose is None else pose)
        if verb == "forget":
            if robot_id is None:
                raise BadMessageError("forget needs a robot; to forget everything, clear")
            return lambda: self._writer.forget(robot_id)
        if verb == "clear":
            return self._writer.clear
        return lambda: "all clouds are in the map; only a restart of the server takes clouds again"

    def _done(self, query: zenoh.Query, verb: str, done: str) -> None:
        snapshot = self._mapper.snapshot
        self._health.count(f"control.{verb}.ok")

        def send() -> None:
            with query:
                reply = codec.encode_control_reply(
                    verb=verb, map_revision=snapshot.map_revision, message=done
                )
                query.reply(self._keys.control(verb), reply.payload, encoding=reply.encoding)

        self._prompt.post_now(send)

    def _refuse(self, query: zenoh.Query, verb: str, error: PotserverError) -> None:
        self._health.count(f"control.{verb}.{error.code}")

        def send() -> None:
            with query:
                _reply_err(query, error)

        self._prompt.post_now(send)


class StatsQueryable:
    """`srv/<server>/stats` as a query."""

    def __init__(
        self, session: zenoh.Session, key: str, *, encode_stats: Callable[[], codec.Wire], limits: Limits
    ) -> None:
        self._key, self._encode_stats, self._limits = key, encode_stats, limits
        self._queryable = session.declare_queryable(key, zenoh.handlers.FifoChannel(4), complete=True)

    def run(self) -> None:
        """Answer until undeclared, on a thread of our own."""
        for query in self._queryable:
            with query:
                try:
                    payload = query.payload
                    codec.check_size(
                        len(payload) if payload is not None else 0,
                        self._limits.max_query_bytes,
                        "stats query",
                    )
                    codec.check_encoding(_encoding(query), messages.StatsQuery)
                    codec.decode_stats_query(payload.to_bytes() if payload is not None else b"")
                    reply = self._encode_stats()
                    query.reply(self._key, reply.payload, encoding=reply.encoding)
                except PotserverError as error:
                    _reply_err(query, error)
                except Exception:
                    log.exception("stats_query_failed", key=self._key)
                    _reply_err(query, PotserverError(_BUG))

    def undeclare(self) -> None:
        """Take no more; ends `run`."""
        self._queryable.undeclare()


def _reply_err(query: zenoh.Query, error: PotserverError) -> None:
    reply = codec.encode_error(error)
    with contextlib.suppress(zenoh.ZError):  # the asker may be gone
        query.reply_err(reply.payload, encoding=reply.encoding)


def _check_deadline(arrived_s: float, deadline_ms: float | None) -> None:
    if deadline_ms is not None and (waited_ms := (time.monotonic() - arrived_s) * 1e3) > deadline_ms:
        raise DeadlineError(f"{waited_ms:.1f} ms since the query came, its deadline was {deadline_ms:.1f} ms")


def _last_chunk(query: zenoh.Query) -> str:
    return str(query.key_expr).rsplit("/", 1)[-1][:80]


def _op_of(query: zenoh.Query, known: tuple[str, ...]) -> str | None:
    """The operation that a query names. The map may be a wildcard, the operation may not."""
    last = _last_chunk(query)
    return last if last in known else None


def _encoding(query: zenoh.Query) -> str | None:
    return None if query.encoding is None else str(query.encoding)
