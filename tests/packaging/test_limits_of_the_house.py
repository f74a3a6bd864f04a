"""The house's own limits: short files, short functions, few parameters, no private names across modules."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT

MOST_LINES = 600  # of a file
MOST_BODY = 60  # lines of a function, its docstring left out
MOST_PARAMETERS = 8  # self left out
LONG_BY_NATURE = {"schemas/potschemas/messages.py", "schemas/potschemas/examples.py"}  # tables of messages
PRODUCT = ("potserver", "clients/potclient", "schemas/potschemas")
FOLDERS = (*PRODUCT, "clients/examples", "benchmarks", "tests")
OURS = ("potserver", "potclient", "potschemas")


def sources(*folders: str) -> list[Path]:
    found = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    assert len(found) > 50
    return found


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def is_compiled(function: ast.FunctionDef) -> bool:
    return any(
        word in ast.unparse(d) for d in function.decorator_list for word in ("jit", "inner_loop", "intrinsic")
    )


def body_lines(function: ast.FunctionDef) -> int:
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return (function.end_lineno or 0) - body[0].lineno + 1 if body else 0


def n_parameters(function: ast.FunctionDef) -> int:
    a = function.args
    named = [arg for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs) if arg.arg not in ("self", "cls")]
    return len(named) + (a.vararg is not None) + (a.kwarg is not None)


def functions(path: Path) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef) and not is_compiled(node):
            yield node


def test_no_file_is_long() -> None:
    lines = {name_of(path): len(path.read_text().splitlines()) for path in sources(*FOLDERS)}
    long = {name: n for name, n in lines.items() if n > MOST_LINES and name not in LONG_BY_NATURE}
    assert not long


def test_no_function_is_long() -> None:
    long = [
        f"{name_of(path)}: {function.name} has {body_lines(function)} lines"
        for path in sources(*FOLDERS)
        if name_of(path) not in LONG_BY_NATURE
        for function in functions(path)
        if body_lines(function) > MOST_BODY
    ]
    assert not long


def test_no_function_takes_many_parameters() -> None:
    many = [
        f"{name_of(path)}: {function.name} takes {n_parameters(function)}"
        for path in sources(*PRODUCT, "clients/examples", "benchmarks")
        for function in functions(path)
        if n_parameters(function) > MOST_PARAMETERS
    ]
    assert not many


def private_uses(path: Path) -> Iterator[str]:
    tree = ast.parse(path.read_text())
    modules = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in OURS:
            for alias in node.names:
                if alias.name.startswith("_") and not alias.name.startswith("__"):
                    yield f"{name_of(path)}: {node.module}.{alias.name}"
                modules.add(alias.asname or alias.name)
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Name)
            and node.value.id in modules
            and node.value.id.islower()  # a module; the private methods of named tuples are public
            and node.attr.startswith("_")
            and not node.attr.startswith("__")
        ):
            yield f"{name_of(path)}: {node.value.id}.{node.attr}"


def test_no_module_uses_private_names_of_another() -> None:
    assert not [use for path in sources(*PRODUCT, "benchmarks") for use in private_uses(path)]


def test_the_import_contract_names_every_module(project_file: dict) -> None:
    """What no layer names may import anything, and be imported from anywhere."""
    contract = project_file["tool"]["importlinter"]["contracts"][0]
    assert contract["name"] == "imports go down only"
    named = {name.strip() for layer in contract["layers"] for name in layer.replace("|", ":").split(":")}
    for path in sources("potserver"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if module in ("potserver", "potserver.__main__"):
            continue
        assert any(f"{module}.".startswith(f"{name}.") for name in named) or any(
            name.startswith(f"{module}.") for name in named
        ), f"{module} is in no layer"
