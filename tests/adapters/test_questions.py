"""Questions without Zenoh: from the bytes of a query to the messages of its replies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgpack
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potschemas import keys, messages, wire
from potschemas.answers import AnswerRule
from potschemas.messages import AtomsAction
from potserver import errors
from potserver.adapters.audit import Audit
from potserver.adapters.questions import registry
from potserver.adapters.questions.atoms import CHANGE, check_changes, check_reads
from potserver.adapters.questions.control import VERBS, work_of
from potserver.adapters.questions.question import Asked, Question, Served
from potserver.adapters.questions.registry import QUESTIONS
from potserver.adapters.questions.tiles import decode_tiles
from potserver.asking.grid import Grid
from potserver.asking.params import Params
from potserver.asking.points import Points
from potserver.asking.rays import Rays
from potserver.asking.risk import Risk
from potserver.asking.tiles import PART_KERNELS
from potserver.atoms.store import AtomStore
from potserver.codec.atoms import encode_atom
from potserver.codec.base import decode
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.tiles import COARSE, MapKernels, Tile, TiledMap
from potserver.domain.types import Atom, KernelSet, Unknown
from potserver.errors import PotserverError
from potserver.health import Health
from potserver.limits import Limits
from potserver.mapping.service import MappingService
from potserver.numerics import brick_grid, brick_sums, cubes, gradients, kernel_index, lattice, rays
from potserver.numerics.evidence import Rows
from tests.tiled_maps import GRID, free_kernels, lattice_kernels, tiled_state

LIMITS = Limits(max_query_points=50, max_coordinate_m=1000.0)


def served_map(mapper: MappingService, limits: Limits = LIMITS) -> Served:
    return Served(
        server_id="tests",
        map_id=mapper.map_id,
        maps=(mapper.map_id,),
        mapper=mapper,
        atoms=AtomStore(mapper.dictionary, mapper.use_dictionary),
        health=Health(),
        audit=Audit(mapper.map_id),
        limits=limits,
        durable=False,
    )


def ask(op: str, query: messages.Message | bytes, served: Served | None = None) -> list[Any]:
    """The replies to `q/<op>`, of an empty map if none is given."""
    (question,) = (q for q in QUESTIONS if q.op == op)
    return replies(question, query, served)


def replies(
    question: Question[Any], query: messages.Message | bytes, served: Served | None = None
) -> list[Any]:
    """The replies to a question, of an empty map if none is given."""
    served = served or served_map(MappingService(AtomDictionary(()), threads=1))
    payload = query if isinstance(query, bytes) else wire.encode(query)
    message = decode(payload, question.query, question.max_bytes or served.limits.max_query_bytes)
    steps = question.steps(Asked(served, served.mapper.state, "", lambda: None), message)
    return [step.reply for step in steps if step.reply is not None]


def outcome(read: Callable[[], Any]) -> str:
    """The code of the error, or `ok`; anything but a typed error is raised."""
    try:
        read()
    except PotserverError as error:
        return error.code
    return "ok"


def test_every_operation_and_every_verb_of_the_contract_is_served_once() -> None:
    asked = {kind for kind in messages.ALL_MESSAGES if kind.__name__.endswith("Query")} - {
        messages.StatsQuery
    }
    assert {question.query for question in QUESTIONS} == asked
    assert {f"pot.{question.op}_query.v1" for question in QUESTIONS} == {kind.schema for kind in asked}
    assert set(VERBS) == set(keys.CONTROL_VERBS)


_EMPTY = MappingService(AtomDictionary(()), threads=1)


@given(st.sampled_from([question.op for question in QUESTIONS]), st.binary(max_size=300))
def test_random_bytes_are_only_ever_typed_errors(op: str, payload: bytes) -> None:
    served = served_map(_EMPTY)
    assert outcome(lambda: ask(op, payload, served)) != "internal"


def test_points_queries_are_bounded() -> None:
    def query(points: Any) -> messages.PointsQuery:
        return messages.PointsQuery(points=wire.encode_array(np.asarray(points)), deadline_ms=5.0)

    (answer,) = ask("points", query(np.ones((2, 2))))
    assert answer.mean.shape == [2]
    (answer,) = ask("points", query(np.ones((0, 3))))
    assert answer.mean.shape == [0]
    with pytest.raises(errors.TooLargeError):
        ask("points", query(np.ones((51, 3))))
    with pytest.raises(errors.OutOfRangeError):
        ask("points", query(np.full((1, 3), 2000.0)))


def test_a_message_without_arrays_is_small() -> None:
    padded = msgpack.packb({"unknown": bytes(5000)})
    for op in ("grid", "params", "info"):
        with pytest.raises(errors.TooLargeError):
            ask(op, padded)


# --- one answer, one state of the map -----------------------------------------------------------------------


class RestlessMapper(MappingService):
    """The map changes at every look: of revision r are r scans, 10 r kernels and a mean moderation of r / 1000."""

    def __init__(self) -> None:
        self.looks = 0
        super().__init__(AtomDictionary(()), threads=1)

    @property
    def state(self) -> MapState:
        self.looks += 1
        r = self.looks
        snapshot = KernelMap(
            free_kernels(10 * r), rule=AnswerRule(mean_moderation=r / 1000), map_revision=r, threads=1
        )
        return MapState(snapshot=snapshot, n_scans=r, epoch=5)

    @state.setter
    def state(self, _: MapState) -> None:
        pass


def test_params_are_of_one_revision_with_its_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = Params.plan
    monkeypatch.setattr(Params, "plan", lambda *args: plan(*args, part_kernels=4))
    mapper = RestlessMapper()
    served = served_map(mapper)
    parts = ask("params", messages.ParamsQuery(), served)
    assert len(parts) > 2
    for part in parts:
        assert part.map_revision == parts[0].map_revision
        assert part.kernels.mean_moderation == pytest.approx(part.map_revision / 1000)
    assert sum(part.kernels.weight_mean.shape[0] for part in parts) == 10 * parts[0].map_revision


def test_info_is_of_one_revision() -> None:
    (info,) = ask("info", messages.InfoQuery(), served_map(RestlessMapper()))
    assert info.map_revision == info.n_scans == info.n_kernels / 10
    assert info.mean_moderation == pytest.approx(info.map_revision / 1000)


def test_tiles_are_of_one_revision_with_its_rule() -> None:
    (part,) = ask("tiles", messages.TilesQuery(), served_map(RestlessMapper()))
    assert part.mean_moderation == pytest.approx(part.map_revision / 1000)


@pytest.mark.parametrize(
    ("op", "query"),
    [
        ("points", messages.PointsQuery(points=wire.encode_array(np.zeros((3, 3))))),
        ("grid", messages.GridQuery(lower=[0.0] * 3, upper=[1.0] * 3, resolution=0.5)),
        ("params", messages.ParamsQuery()),
        ("tiles", messages.TilesQuery()),
        ("info", messages.InfoQuery()),
        ("atoms", messages.AtomsQuery()),
    ],
)
def test_an_answer_looks_at_the_map_once(op: str, query: messages.Message) -> None:
    mapper = RestlessMapper()
    served = served_map(mapper)
    before = mapper.looks
    ask(op, query, served)
    assert mapper.looks == before + 1


# --- tiles --------------------------------------------------------------------------------------------------


def test_known_tiles_need_their_epoch() -> None:
    known = wire.pack_array(np.zeros((4, 1), np.int64))
    with pytest.raises(errors.BadMessageError, match="epoch"):
        decode_tiles(messages.TilesQuery(known=known))
    asked = decode_tiles(messages.TilesQuery(known=known, epoch=3)).known
    assert asked is not None
    assert (asked.epoch, asked.indices.shape, asked.revisions.shape) == (3, (1, 3), (1,))


def test_askers_take_parts_of_our_size() -> None:
    assert PART_KERNELS <= messages.MAX_PART_KERNELS


def test_tiles_come_with_what_answers_need() -> None:
    mapper = MappingService(AtomDictionary(()), threads=1)
    mapper.state = tiled_state({(0, 0, 0): (free_kernels(30), 3)}, epoch=9, revision=7)
    (part,) = ask("tiles", messages.TilesQuery(), served_map(mapper))
    assert (part.epoch, part.map_revision, part.whole) == (9, 7, True)
    assert (part.residual_var, part.mean_moderation) == (20.0, 0.05)


# --- atoms --------------------------------------------------------------------------------------------------


def atom_message() -> messages.Atom:
    atom = Atom(
        atom_id="wall.1",
        dims=3,
        hit_points=np.ones((5, 3), np.float32),
        free_points=np.zeros((2, 3), np.float32),
        kernels=free_kernels(6),
        radius_m=20.0,
        azimuth_width_rad=1.0,
        provenance={"source": "tests"},
    )
    return encode_atom(atom, {}, _EMPTY.snapshot.rule)


def test_what_may_be_asked_of_the_atoms() -> None:
    def read(**fields: Any) -> str:
        return outcome(lambda: check_reads(messages.AtomsQuery(**fields)))

    def change(**fields: Any) -> str:
        return outcome(lambda: check_changes(messages.AtomsQuery(**fields)))

    whole = atom_message()
    assert read() == read(atom_id="a") == read(atom_id="a", action=AtomsAction.READ) == "ok"
    assert read(atom=whole) == read(action=AtomsAction.READ, atom=whole) == "bad_message"
    assert read(action=AtomsAction.REMOVE, atom_id="a") == "unsupported"
    assert change(atom_id="a", action=AtomsAction.REMOVE) == "ok"
    assert change(atom_id="wall.1", action=AtomsAction.ADD, atom=whole) == "ok"
    assert change() == change(atom_id="a", action=AtomsAction.READ) == "unsupported"
    for fields in (
        {"action": AtomsAction.REMOVE},
        {"action": AtomsAction.ADD},
        {"action": AtomsAction.ADD, "atom_id": "a"},
        {"action": AtomsAction.ADD, "atom": whole, "atom_id": "other"},
        {"action": AtomsAction.REMOVE, "atom_id": "wall.1", "atom": whole},
    ):
        assert change(**fields) == "bad_message"


def test_an_unsound_atom_is_refused_before_the_dictionary_is_asked() -> None:
    served = served_map(MappingService(AtomDictionary(()), threads=1))
    whole = atom_message()
    short = msgspec.structs.replace(whole, hit_points=wire.encode_array(np.ones((4, 3), np.float32)))
    with pytest.raises(errors.ShapeError):
        replies(CHANGE, messages.AtomsQuery(action=AtomsAction.ADD, atom=short), served)
    assert len(served.atoms.dictionary) == 0
    assert served.health.counters() == {}
    with pytest.raises(errors.TooLargeError):
        replies(
            CHANGE,
            messages.AtomsQuery(action=AtomsAction.ADD, atom=whole),
            served_map(served.mapper, Limits(max_query_bytes=100)),
        )


# --- control ------------------------------------------------------------------------------------------------


class Writer:
    """Says what it was told."""

    def __getattr__(self, verb: str) -> Callable[..., str]:
        return lambda *arguments: f"{verb} {arguments}"


@pytest.mark.parametrize(
    ("verb", "fields", "done"),
    [
        ("save", {}, "save (None,)"),
        ("save", {"name": "a"}, "save ('a',)"),
        ("load", {"name": "a"}, "load ('a',)"),
        ("forget", {"robot": "r1"}, "forget ('r1',)"),
        ("clear", {}, "clear ()"),
        ("load", {}, "load needs the name of a saved map"),
        ("merge", {}, "merge needs the name of a saved map"),
        ("forget", {}, "forget needs a robot"),
        ("clear", {"name": "a"}, "clear takes no name"),
        ("drain", {"robot": "r1"}, "drain takes no robot"),
        ("save", {"T_map_saved": wire.encode_array(np.eye(4))}, "save takes no T_map_saved"),
        ("merge", {"name": "a", "T_map_saved": wire.encode_array(2 * np.eye(4))}, "the pose"),
    ],
)
def test_verbs_take_their_fields_and_no_others(verb: str, fields: dict[str, Any], done: str) -> None:
    try:
        said = work_of(verb, messages.ControlRequest(**fields), Writer())()  # type: ignore[arg-type]
    except PotserverError as error:
        said = str(error)
    assert said.startswith(done)


# --- the first question -------------------------------------------------------------------------------------


def test_whatever_is_asked_needs_no_other_compilation_than_the_warm_up() -> None:
    """A first question that compiles would take seconds; received arrays are read-only, and options may be integers."""
    registry.warm_up()
    limits = Limits()
    tiles = {(x, 0, 0): KernelSet.concatenate([lattice_kernels(400), free_kernels(300)]) for x in (0, 9)}
    made = {index: Tile(Rows.empty(), MapKernels.new(own, COARSE)) for index, own in tiles.items()}
    kernels = KernelMap(list(TiledMap.empty(GRID).with_tiles(made).parts.values()), threads=1)
    received = np.frombuffer(np.ones(6).tobytes()).reshape(2, 3)
    asked = Rays(received, received.astype(np.float32), 5, unknown=Unknown.OCCUPIED, width_m=1)
    asked.plan(kernels, limits).part(0)
    pose = np.frombuffer(np.eye(4).tobytes()).reshape(1, 4, 4)
    Risk(pose, np.array([[0, 0, 0, 1], [1, 0, 0, 2]]), dims=2, resolution_m=1).plan(kernels, limits).part(0)
    Points(received, with_gradient=True).plan(kernels, limits).part(0)
    Grid(received[0], received[0] + 3.0, 1).plan(kernels, limits).part(0)
    for compiled in (
        rays._march,
        lattice._cover,
        gradients._gradient_cubes,
        kernel_index._sum_cubes,
        brick_sums._sum_points,
        brick_sums._slope_points,
        brick_grid._sum_columns,
        brick_grid._taps,
        cubes._counting_sort,
    ):
        assert len(compiled.signatures) == 1
