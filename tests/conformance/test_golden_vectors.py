"""The golden bytes: read and written again byte for byte, and the readable form beside them says the same."""

from __future__ import annotations

import base64
import copy
import json
import zlib
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

import potschemas
from potschemas import generate
from potschemas.messages import ALL_MESSAGES, Message
from potschemas.wire import decode, encode

PACKAGE = Path(potschemas.__file__).parent
KINDS = {kind.schema: kind for kind in ALL_MESSAGES}
VECTORS = sorted((PACKAGE / "vectors").glob("*.msgpack"))
by_name = pytest.mark.parametrize("path", VECTORS, ids=lambda path: path.stem)


def kind_of(path: Path) -> type[Message]:
    return KINDS[".".join(path.stem.split(".")[:3])]


def schema_for(kind: type[Message]) -> Any:
    return json.loads((PACKAGE / "json" / f"{kind.schema}.json").read_text("utf-8"))


def readable_beside(path: Path) -> Any:
    return json.loads(path.with_suffix(".json").read_text("utf-8"))


def test_every_message_has_a_vector_and_a_json_schema() -> None:
    assert {kind_of(path) for path in VECTORS} == set(ALL_MESSAGES)
    assert {path.stem for path in (PACKAGE / "json").iterdir()} == set(KINDS)


@by_name
def test_a_vector_is_written_again_byte_for_byte(path: Path) -> None:
    payload = path.read_bytes()
    assert encode(decode(payload, kind_of(path))) == payload


@by_name
def test_the_readable_form_is_the_same_message(path: Path) -> None:
    assert readable_beside(path) == generate.readable(decode(path.read_bytes(), kind_of(path)))


@by_name
def test_the_readable_numbers_are_the_bytes(path: Path) -> None:
    def check(node: Any) -> None:
        if isinstance(node, dict) and "dtype" in node:
            array = np.array(node["values"], node["dtype"]).reshape(node["shape"])
            if "data" in node:
                assert array.tobytes() == base64.b64decode(node["data"])
            else:
                planes = np.frombuffer(array.tobytes(), np.uint8).reshape(-1, array.itemsize).T
                assert planes.tobytes() == zlib.decompress(base64.b64decode(node["deflated"]))
        elif isinstance(node, dict | list):
            for item in node.values() if isinstance(node, dict) else node:
                check(item)

    check(readable_beside(path))


@by_name
def test_the_readable_form_fits_the_json_schema(path: Path) -> None:
    jsonschema.Draft202012Validator(schema_for(kind_of(path))).validate(readable_beside(path))


@by_name
def test_the_json_schema_refuses_what_the_decoder_refuses(path: Path) -> None:
    schema = schema_for(kind_of(path))
    validator = jsonschema.Draft202012Validator(schema)
    definition = schema["$defs"][kind_of(path).__name__]
    tree = readable_beside(path)
    assert not validator.is_valid([tree])
    for field in definition["required"]:
        assert not validator.is_valid({name: value for name, value in tree.items() if name != field})
    for field in definition["properties"]:
        assert not validator.is_valid({**tree, field: {"no": "such value"}}) or field in _MAPS
    assert validator.is_valid({**tree, "from_the_future": 1})


_MAPS = ("queues", "counters", "map_kernels", "latencies")  # `no` is a key there like any other


@pytest.mark.parametrize("kind", ALL_MESSAGES)
def test_a_json_schema_is_sound_and_says_what_it_is(kind: type[Message]) -> None:
    schema = schema_for(kind)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["$id"] == f"urn:potserver:schema:{kind.schema}"
    assert schema["title"] == kind.schema
    assert schema["description"]
    for definition in schema["$defs"].values():
        assert definition["description"]
        for name, field in definition.get("properties", {}).items():
            assert field["description"], name


# --- drift ------------------------------------------------------------------------------------------


def test_everything_generated_is_up_to_date() -> None:
    assert generate.drift() == []
    assert generate.main(["--check"]) == 0


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The generator at work in an empty folder, with a README that waits for its tables."""
    monkeypatch.setattr(generate, "PACKAGE", tmp_path)
    monkeypatch.setattr(generate, "README", tmp_path / "README.md")
    (tmp_path / "README.md").write_text(f"before\n{generate.BEGIN}old\n{generate.END}after\n", "utf-8")
    return tmp_path


def test_the_generator_writes_what_the_package_holds(elsewhere: Path) -> None:
    assert generate.main([]) == 0
    for folder in ("json", "vectors"):
        written = {path.name: path.read_bytes() for path in (elsewhere / folder).iterdir()}
        assert written == {path.name: path.read_bytes() for path in (PACKAGE / folder).iterdir()}
    readme = (elsewhere / "README.md").read_text("utf-8")
    assert readme == f"before\n{generate.BEGIN}{generate.readme_tables()}{generate.END}after\n"
    assert generate.write() == []


def test_the_check_names_each_file_that_drifted(elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    generate.write()
    assert generate.main(["--check"]) == 0
    assert capsys.readouterr().err == ""
    vectors = elsewhere / "vectors"
    (vectors / "pot.pose.v1.msgpack").write_bytes(b"\x80")
    (vectors / "pot.gone.v1.msgpack").write_bytes(b"\x80")
    (elsewhere / "json" / "pot.error.v1.json").unlink()
    readme = elsewhere / "README.md"
    readme.write_text(readme.read_text("utf-8").replace("`seq`", "`sequence`"), "utf-8")
    before = {path: path.read_bytes() for path in elsewhere.rglob("*.*") if path.is_file()}

    assert generate.main(["--check"]) == 1
    said = capsys.readouterr().err.splitlines()
    assert sorted(said[:-1]) == sorted(
        [
            f"{vectors / 'pot.pose.v1.msgpack'}: differs from the messages",
            f"{vectors / 'pot.gone.v1.msgpack'}: not generated from any message",
            f"{elsewhere / 'json' / 'pot.error.v1.json'}: missing",
            f"{readme}: differs from the messages",
        ]
    )
    assert {path: path.read_bytes() for path in elsewhere.rglob("*.*") if path.is_file()} == before

    assert len(generate.write()) == 4
    assert generate.main(["--check"]) == 0


def test_without_a_readme_the_rest_is_checked_all_the_same(elsewhere: Path) -> None:
    (elsewhere / "README.md").unlink()
    generate.write()
    assert not (elsewhere / "README.md").exists()
    assert generate.drift() == []


def test_a_readme_without_the_markers_is_left_alone(elsewhere: Path) -> None:
    (elsewhere / "README.md").write_text("somebody else's\n", "utf-8")
    generate.write()
    assert (elsewhere / "README.md").read_text("utf-8") == "somebody else's\n"


def test_the_readable_form_does_not_share_with_the_message() -> None:
    path = PACKAGE / "vectors" / "pot.revision.v1.msgpack"
    message = decode(path.read_bytes(), kind_of(path))
    tree = generate.readable(message)
    untouched = copy.deepcopy(tree)
    tree["changed_tiles"].clear()
    assert generate.readable(message) == untouched
