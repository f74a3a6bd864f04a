"""The messages, and that everything said about them elsewhere is true."""

from __future__ import annotations

import re
import subprocess
import sys
from enum import Enum
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest

from potschemas import keys, messages, wire
from potschemas.examples import examples
from potschemas.generate import field_notes
from potschemas.messages import ALL_MESSAGES, DType, ErrorCode, Message
from potserver.errors import error_classes

README = Path(__file__).parents[2] / "schemas" / "README.md"
STRUCTS = [
    value
    for value in vars(messages).values()
    if isinstance(value, type) and issubclass(value, msgspec.Struct) and value.__module__ == messages.__name__
]


@pytest.fixture(scope="module")
def readme() -> str:
    return README.read_text("utf-8")


# --- the messages -----------------------------------------------------------------------------------


def test_every_message_is_listed_once_under_its_own_schema() -> None:
    defined = [s for s in STRUCTS if issubclass(s, Message) and s is not Message]
    assert list(ALL_MESSAGES) == defined
    assert len({kind.schema for kind in ALL_MESSAGES}) == len(ALL_MESSAGES)


@pytest.mark.parametrize("kind", ALL_MESSAGES)
def test_a_schema_has_a_name_and_a_version(kind: type[Message]) -> None:
    assert re.fullmatch(r"pot\.[a-z][a-z_]*\.v[1-9]\d*", kind.schema)


@pytest.mark.parametrize("struct", [s for s in STRUCTS if s is not Message])
def test_every_field_says_what_it_means(struct: type[msgspec.Struct]) -> None:
    assert struct.__doc__
    assert set(field_notes(struct)) == set(struct.__struct_fields__)


@pytest.mark.parametrize("struct", STRUCTS)
def test_messages_are_frozen(struct: type[msgspec.Struct]) -> None:
    assert struct.__struct_config__.frozen
    assert not struct.__struct_config__.forbid_unknown_fields  # forward compatibility


@pytest.mark.parametrize("dtype", DType)
def test_element_types_are_little_endian_and_plain(dtype: DType) -> None:
    assert dtype.value[0] in "<|"
    assert dtype.value[1] in "fiub"


def test_every_error_of_the_server_has_a_code_and_every_code_an_error() -> None:
    assert set(error_classes()) == {code.value for code in ErrorCode}


# --- the examples -----------------------------------------------------------------------------------


def test_every_message_has_an_example_under_its_own_name() -> None:
    for name, message in examples().items():
        assert re.fullmatch(re.escape(message.schema) + r"(\.[a-z0-9_]+)?", name)
    assert {kind.schema for kind in ALL_MESSAGES} <= set(examples())


def test_examples_do_not_change_from_call_to_call() -> None:
    first, second = examples(), examples()
    assert {n: wire.encode(v) for n, v in first.items()} == {n: wire.encode(v) for n, v in second.items()}


def test_every_field_that_may_be_nil_is_shown_with_and_without() -> None:
    seen: dict[tuple[str, str], set[bool]] = {}

    def visit(value: Any) -> None:
        if isinstance(value, msgspec.Struct):
            for field in msgspec.structs.fields(type(value)):
                item = getattr(value, field.name)
                if type(None) in getattr(field.type, "__args__", ()):
                    seen.setdefault((type(value).__name__, field.name), set()).add(item is None)
                visit(item)
        elif isinstance(value, list | dict):
            for item in value.values() if isinstance(value, dict) else value:
                visit(item)

    for message in examples().values():
        visit(message)
    assert len(seen) > 10
    assert {place for place, cases in seen.items() if cases != {True, False}} == set()


def test_a_field_that_was_added_later_is_left_out_of_the_bytes_and_shown_with_and_without() -> None:
    later = {
        (type(m), field.name): field.name in msgpack.unpackb(wire.encode(m))
        for m in examples().values()
        for field in msgspec.structs.fields(type(m))
        if field.default is messages.ABSENT and getattr(m, field.name) is messages.ABSENT
    }
    assert len(later) == 30
    assert not any(later.values())
    given = {
        type(m) for m in examples().values() for kind, name in later if type(m) is kind and getattr(m, name)
    }
    assert given == {kind for kind, _ in later}


def test_every_status_of_a_receipt_has_an_example() -> None:
    statuses = {m.status for m in examples().values() if isinstance(m, messages.Receipt)}
    assert statuses == set(messages.ReceiptStatus)


def test_no_message_comes_near_the_depth_limit() -> None:
    def depth(tree: Any) -> int:
        if isinstance(tree, dict):
            return 1 + max(map(depth, tree.values()), default=0)
        return 1 + max(map(depth, tree), default=0) if isinstance(tree, list) else 0

    deepest = max(depth(msgpack.unpackb(wire.encode(message))) for message in examples().values())
    assert deepest == 7  # as the limit's comment says
    assert deepest < wire.MAX_DEPTH


# --- the README -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL_MESSAGES)
def test_the_readme_says_where_a_schema_travels(kind: type[Message], readme: str) -> None:
    by_hand = readme.partition("<!-- generated")[0]
    assert f"`{kind.schema}`" in by_hand
    assert f"#### `{kind.schema}`: {kind.__name__}\n" in readme


@pytest.mark.parametrize("struct", [s for s in STRUCTS if s is not Message])
def test_the_readme_has_every_field(struct: type[msgspec.Struct], readme: str) -> None:
    heading = f"#### `{struct.schema}`: " if issubclass(struct, Message) else "#### "
    section = readme.split(f"{heading}{struct.__name__}\n")[1].split("####")[0]
    assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == list(struct.__struct_fields__)


# a message `pot.<op>_query.v1` is the question `q/<op>`; stats are the server's and not a map's
QUESTIONS = sorted(
    {
        op
        for kind in messages.ALL_MESSAGES
        if (op := kind.schema.split(".")[1].removesuffix("_query")) + "_query" in kind.schema
    }
    - {"stats"}
)


def test_the_readme_has_every_key(readme: str) -> None:
    site = keys.MapKeys(keys.DEFAULT_ROOT, "<map>")
    expected = {
        site.cloud("<robot>"),
        site.pose("<robot>"),
        site.integrate("<robot>"),
        site.receipt("<robot>"),
        site.params("<robot>"),
        site.revision,
        site.robot_token("<robot>"),
        site.server_token("<server>"),
        keys.stats_key(keys.DEFAULT_ROOT, "<server>"),
        *(site.query(op) for op in QUESTIONS),
        *(site.control(verb) for verb in (*keys.CONTROL_VERBS, keys.CHANGE_ATOMS, keys.LEARN)),
    }
    table = readme.split("## Keys")[1].split("\n## ")[0]
    assert set(re.findall(r"^\| `(@?pot/[^`]+)` \|", table, re.MULTILINE)) == expected
    for map_id in keys.RESERVED_MAP_IDS:
        assert f"No map may be called `{map_id}`" in readme


def test_the_readme_says_of_every_error_whether_to_retry(readme: str) -> None:
    table = readme.split("## Errors")[1].split("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| (yes|no) \| [^|]+ \| [^|]+ \|$", table, re.MULTILINE)
    assert [code for code, _ in rows] == [code.value for code in ErrorCode]
    retryable = {code for code, cls in error_classes().items() if cls.retryable}
    assert {code for code, retry in rows if retry == "yes"} == retryable


def test_the_readme_has_the_limits_as_they_are(readme: str) -> None:
    table = readme.split("## Limits")[1].split("\n## ")[0]
    values = [int(value) for value in re.findall(r"^\| [^|]+ \| (\d+)", table, re.MULTILINE)]
    assert values == [
        *wire.DEFAULT_LIMITS,
        wire.MAX_REQUEST_VALUES,
        wire.MAX_STRING_BYTES,
        messages.MAX_AXES,
        messages.MAX_AXIS_LENGTH,
        messages.MAX_PART_KERNELS,
    ]


def test_the_readme_has_every_value_of_every_enumeration(readme: str) -> None:
    for enum in (messages.DType, messages.ReceiptStatus, messages.AtomsAction, messages.Unknown):
        assert issubclass(enum, Enum)
        section = readme.split(f"#### {enum.__name__}\n")[1].split("####")[0]
        assert re.findall(r"^\| `([^`]+)` \|", section, re.MULTILINE) == [e.value for e in enum]


def test_the_readme_explains_every_named_type(readme: str) -> None:
    legend = readme.split("## Reference")[1].partition("<!-- generated")[0]
    tables = readme.split("## Reference")[1].partition("<!-- generated")[2]
    used = {
        word
        for kind in re.findall(r"^\| `\w+` \| (.+?) \| (?:required|`)", tables, re.MULTILINE)
        for word in re.findall(r"\w+", kind)
    }
    plain = {"str", "int", "float", "bool", "bytes", "list", "dict", "None"}
    explained = (
        plain
        | set(re.findall(r"`(\w+)`", legend))
        | set(re.findall(r"^#### .*?(\w+)$", tables, re.MULTILINE))
    )
    assert "Sequence" in used
    assert used - explained - {"ErrorCode"} == set()


def test_the_bytes_in_the_readme_are_the_messages_that_it_says(readme: str) -> None:
    blocks = re.findall(r"```hex (\S+)\n(.*?)```", readme, re.DOTALL)
    decoded = {}
    for schema, text in blocks:
        payload = bytes.fromhex("".join(line.partition("#")[0] for line in text.splitlines()))
        kind = next(kind for kind in ALL_MESSAGES if kind.schema == schema)
        decoded[schema] = wire.decode(payload, kind)
    receipt = messages.Receipt(map="m", robot="r1", seq=7, status=messages.ReceiptStatus.ACCEPTED)
    assert decoded["pot.receipt.v1"] == receipt
    query = decoded["pot.points_query.v1"]
    assert isinstance(query, messages.PointsQuery)
    points = wire.decode_array(query.points, "points", dtypes=(DType.FLOAT32,), shape=(None, 3))
    assert points.tolist() == [[1.0, 2.0, 0.5]]


# --- the package ------------------------------------------------------------------------------------


def test_the_contract_needs_neither_the_network_nor_the_server() -> None:
    program = (
        "import sys, potschemas, potschemas.generate, potschemas.examples, potschemas.keys, potschemas.wire\n"
        "print(*sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "potschemas" in loaded
    assert loaded.isdisjoint({"zenoh", "potserver", "potclient", "torch", "open3d", "numba"})
