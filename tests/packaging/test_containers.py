"""The container files name what exists: paths, commands, flags, pinned images, a user that is not root.

No container engine is needed: the files are read, and the commands are asked for their help.
"""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import yaml

from potschemas import __version__

DOCKERFILES = ["server.Dockerfile", "client.Dockerfile"]


class Instruction(NamedTuple):
    """One line of a Dockerfile, continuation lines joined."""

    word: str
    rest: str


def instructions(path: Path) -> list[Instruction]:
    lines = [line for line in path.read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    return [Instruction(*line.split(maxsplit=1)) for line in joined.splitlines() if line.strip()]


def last_stage(path: Path) -> list[Instruction]:
    found = instructions(path)
    start = max(i for i, instruction in enumerate(found) if instruction.word == "FROM")
    return found[start:]


def command_of(found: list[Instruction], word: str) -> list[str]:
    """The last ENTRYPOINT or CMD, which must be in exec form."""
    lines = [instruction.rest for instruction in found if instruction.word == word]
    return json.loads(lines[-1]) if lines else []


@pytest.fixture(scope="module", params=DOCKERFILES)
def dockerfile(request: pytest.FixtureRequest, root: Path) -> Path:
    return root / "docker" / request.param


@pytest.fixture(scope="module")
def compose(root: Path) -> dict:
    return yaml.safe_load((root / "docker" / "compose.yaml").read_text())


def test_every_copied_path_exists_and_is_in_the_build_context(root: Path, dockerfile: Path) -> None:
    let_through = {
        line[1:] for line in (root / ".dockerignore").read_text().splitlines() if line.startswith("!")
    }
    n_copied = 0
    for instruction in instructions(dockerfile):
        assert instruction.word != "ADD"
        if instruction.word == "COPY" and "--from=" not in instruction.rest:
            *sources, _ = (word for word in instruction.rest.split() if not word.startswith("--"))
            for source in sources:
                assert (root / source).exists(), source
                assert source.split("/")[0] in let_through, f"{source} is kept out by .dockerignore"
                n_copied += 1
    assert n_copied > 0


def test_stages_that_are_copied_from_exist(dockerfile: Path) -> None:
    found = instructions(dockerfile)
    stages = {match[1] for _, rest in found if (match := re.search(r"\bAS (\w+)$", rest))}
    copied_from = {match[1] for _, rest in found if (match := re.search(r"--from=(\w+)", rest))}
    assert copied_from <= stages


def test_the_base_image_is_pinned(dockerfile: Path) -> None:
    found = instructions(dockerfile)
    images = [instruction.rest.split()[0] for instruction in found if instruction.word == "FROM"]
    assert set(images) == {"${BASE}"}, "whoever builds may name a digest"
    (base,) = (rest for word, rest in found if word == "ARG" and rest.startswith("BASE="))
    assert re.fullmatch(r"BASE=python:3\.\d+(\.\d+)?-slim-\w+(@sha256:[0-9a-f]{64})?", base), base


@pytest.mark.parametrize("digest", ["sha256:" + "0a" * 32, "not a digest"])
def test_the_digest_of_the_base_is_written_into_both_files(root: Path, tmp_path: Path, digest: str) -> None:
    """A stand-in for skopeo tells it."""
    shutil.copytree(root / "docker", tmp_path / "docker")
    skopeo = tmp_path / "skopeo"
    skopeo.write_text(f'#!/bin/sh\necho "$*" >{tmp_path}/asked\necho "{digest}"\n')
    skopeo.chmod(0o755)
    environ = os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    for _ in range(2):  # from a tag, and from a digest
        run = subprocess.run(
            [tmp_path / "docker" / "check", "--pin"], env=environ, capture_output=True, text=True
        )
        assert (tmp_path / "asked").read_text().split()[-1] == "docker://python:3.11-slim-bookworm"
        for name in DOCKERFILES:
            before, after = ((folder / "docker" / name).read_text() for folder in (root, tmp_path))
            wanted = f"ARG BASE=python:3.11-slim-bookworm@{digest}" if run.returncode == 0 else None
            changed = [line for line in after.splitlines() if line not in before.splitlines()]
            assert changed == ([wanted] if wanted else [])
    assert run.returncode == (0 if digest.startswith("sha256:") else 1), run.stderr


@pytest.mark.parametrize("base", ["python:3.11-slim-bookworm", f"python@sha256:{'0a' * 32}"])
@pytest.mark.parametrize("pinned", ["", "1"])
def test_a_base_without_a_digest_is_told_or_refused(dockerfile: Path, base: str, pinned: str) -> None:
    stage = instructions(dockerfile)
    (check,) = (rest for word, rest in stage if word == "RUN" and "names no digest" in rest)
    run = subprocess.run(
        ["sh", "-ec", check], env={"BASE": base, "PINNED": pinned}, capture_output=True, text=True
    )
    has_digest = "@" in base
    assert bool(run.stderr) != has_digest
    assert (run.returncode == 0) == (has_digest or not pinned)
    assert check == next(rest for word, rest in stage if word == "RUN"), "before anything is fetched"
    label = 'org.opencontainers.image.base.name="${BASE}"'
    assert ("LABEL", label) in last_stage(dockerfile)


def test_packages_are_pinned_by_hash(dockerfile: Path) -> None:
    installs = [
        command
        for word, rest in instructions(dockerfile)
        if word == "RUN"
        for command in rest.split("&&")
        if "pip install" in command
    ]
    kinds = [
        "hashed"
        if "--no-deps --require-hashes -r locks/" in command
        else "ours"
        if command.endswith("--no-deps /dist/*.whl")
        else command
        for command in installs
    ]
    assert kinds == ["hashed", "hashed", "ours"]


def test_every_image_carries_a_bill_of_materials(dockerfile: Path) -> None:
    runs = [rest for word, rest in instructions(dockerfile) if word == "RUN"]
    (command,) = (rest for rest in runs if "cyclonedx-py environment" in rest)
    place = command.split()[-1]
    copied = [rest for word, rest in last_stage(dockerfile) if word == "COPY" and "--from=build" in rest]
    assert any(place.startswith(f"{rest.split()[-1]}/") for rest in copied)


def test_the_client_image_takes_the_client_only(root: Path) -> None:
    rest = " ".join(instruction.rest for instruction in instructions(root / "docker" / "client.Dockerfile"))
    assert "cd clients" in rest
    assert "potserver" not in rest


def test_the_user_is_not_root_and_exists(dockerfile: Path) -> None:
    stage = last_stage(dockerfile)
    users = [instruction.rest for instruction in stage if instruction.word == "USER"]
    assert users
    assert users[-1] not in ("root", "0")
    assert any(
        word == "RUN" and rest.startswith("useradd") and rest.split()[-1] == users[-1] for word, rest in stage
    )
    order = [instruction.word for instruction in stage]
    assert "RUN" not in order[order.index("USER") :]


def test_the_image_starts_a_command_of_ours(
    dockerfile: Path, command_faults: Callable[[list[str]], list[str]]
) -> None:
    stage = last_stage(dockerfile)
    words = command_of(stage, "ENTRYPOINT") + command_of(stage, "CMD")
    assert words
    assert command_faults(words) == []


def test_the_server_says_whether_it_is_healthy(
    root: Path, command_faults: Callable[[list[str]], list[str]]
) -> None:
    stage = last_stage(root / "docker" / "server.Dockerfile")
    (check,) = (instruction.rest for instruction in stage if instruction.word == "HEALTHCHECK")
    words = json.loads(check[check.index("CMD") + len("CMD") :])
    assert command_faults(words) == []


def test_every_service_builds_from_a_dockerfile_and_runs_its_command(
    root: Path, compose: dict, command_faults: Callable[[list[str]], list[str]]
) -> None:
    assert set(compose["services"]) == {"server", "load"}
    for service in compose["services"].values():
        context = root / "docker" / service["build"]["context"]
        dockerfile = context / service["build"]["dockerfile"]
        assert context.resolve() == root
        entrypoint = command_of(last_stage(dockerfile), "ENTRYPOINT")
        assert command_faults(entrypoint + service["command"]) == []


def test_services_depend_on_each_other_as_they_can(root: Path, compose: dict) -> None:
    services = compose["services"]
    assert services["load"]["depends_on"]["server"]["condition"] == "service_healthy"
    server = instructions(root / "docker" / "server.Dockerfile")
    assert any(instruction.word == "HEALTHCHECK" for instruction in server)
    ports = {instruction.rest for instruction in server if instruction.word == "EXPOSE"}
    assert {port.rsplit(":", 1)[1] for port in services["server"]["ports"]} == ports
    for service in services.values():
        volumes = {volume.split(":")[0] for volume in service.get("volumes", [])}
        assert volumes <= set(compose["volumes"])
        for word in service["command"]:
            for host, port in re.findall(r"tcp/([\w.]+):(\d+)", word):
                assert host in {*services, "0.0.0.0", "127.0.0.1"}
                assert port in ports


def test_image_tags_are_the_version(compose: dict) -> None:
    for service in compose["services"].values():
        assert service["image"].partition(":")[2] == __version__


def test_the_server_container_keeps_its_maps_on_a_volume(compose: dict) -> None:
    server = compose["services"]["server"]
    places = dict(volume.split(":") for volume in server["volumes"])
    assert set(compose["volumes"]) == set(places)
    assert server["command"][server["command"].index("--store") + 1].startswith(f"{places['state']}/")
    assert server["stop_grace_period"] == "30s"


def test_compiled_numerics_lie_apart_from_the_maps_for_the_server_alone(root: Path, compose: dict) -> None:
    found = instructions(root / "docker" / "server.Dockerfile")
    (cache,) = (match[1] for _, rest in found if (match := re.search(r"NUMBA_CACHE_DIR=(\S+)", rest)))
    places = dict(volume.split(":") for volume in compose["services"]["server"]["volumes"])
    assert cache.startswith(f"{places['cache']}/")
    assert not cache.startswith(f"{places['state']}/")
    (folders,) = (rest for word, rest in found if word == "RUN" and rest.startswith("install -d"))
    made = folders.removeprefix("install -d -m 0700 -o potserver -g potserver ").split()
    assert set(places.values()) == set(made)


def test_memory_and_processes_are_bounded(root: Path, compose: dict) -> None:
    for service in compose["services"].values():
        assert re.fullmatch(r"\d+g", service["mem_limit"])
        assert 0 < service["pids_limit"] < 10_000
    unit = (root / "systemd" / "potserver.service").read_text()
    assert {"MemoryMax=8G", "TasksMax=512", "CacheDirectoryMode=0700", "StateDirectoryMode=0700"} <= set(
        unit.split()
    )


@pytest.mark.parametrize("name", ["server", "client", "dev", "build"])
def test_locks_hold_the_versions_that_are_tested_and_a_hash_of_each(root: Path, name: str) -> None:
    lines = (root / "locks" / f"{name}.txt").read_text().splitlines()
    pins = [line for line in lines if line and not line.startswith((" ", "#"))]
    assert pins
    for pin, after in itertools.pairwise([*lines, ""]):
        if pin in pins:
            assert pin.endswith("\\"), pin
            assert re.match(r"    --hash=sha256:[0-9a-f]{64}", after), pin
    assert not [pin for pin in pins if re.match(r"(torch|triton|nvidia-|cuda-)", pin)], "see the Makefile"
    locked = {(_normal(pin.split("==")[0]), pin.split()[0].split("==")[1]) for pin in pins}
    constraints = [
        line for line in (root / "constraints.txt").read_text().splitlines() if re.match(r"[A-Za-z]", line)
    ]
    allowed: dict[str, set[str]] = {}
    for line in constraints:
        package, version = re.split(r"==", line.split(";")[0].strip())
        allowed.setdefault(_normal(package), set()).add(version)
    assert {pair for pair in locked if pair[0] in allowed and pair[1] not in allowed[pair[0]]} == set()
    assert not re.search(r"https?://|index-url|find-links", "\n".join(lines))


def _normal(package: str) -> str:
    return re.sub(r"[-_.]+", "-", package).lower()
