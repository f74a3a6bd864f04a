"""What the documents say can be done: commands, code and links are checked against the project."""

from __future__ import annotations

import ast
import importlib.util
import itertools
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from PIL import Image

OURS = {"potserver", "potclient", "potschemas"}
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>\w*)[^\n]*\n(?P<body>.*?)^(?P=indent)```", re.MULTILINE | re.DOTALL
)
MACHINE_PATH = re.compile(r"(?<![\w.~<>/-])/(?:work|tmp|home|root|mnt|opt)/")
MOST_BYTES = {"README.md": 7_000, "ARCHITECTURE.md": 12_000}
LINK = re.compile(r"\[[^\]]*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)|^\[[^\]]+\]:\s*(\S+)", re.MULTILINE)


class Block(NamedTuple):
    """One fenced block of a document."""

    language: str
    body: str
    line: int


def documents(root: Path) -> list[Path]:
    names = ("docs", "docs/decisions", "docs/guides", "schemas", "benchmarks", "clients", "docker", ".github")
    folders = (root, *(root / name for name in names))
    return sorted(path for folder in folders for path in folder.glob("*.md"))


def scripts(root: Path) -> list[Path]:
    """What draws figures and measures: documents name these by their path."""
    return sorted(path for name in ("docs/pictures", "benchmarks") for path in (root / name).glob("*.py"))


def blocks(text: str, language: str) -> Iterator[Block]:
    for match in FENCE.finditer(text):
        if match["language"] == language:
            body = re.sub(rf"^{match['indent']}", "", match["body"], flags=re.MULTILINE)
            yield Block(language, body, text.count("\n", 0, match.start()) + 1)


def commands(block: Block) -> Iterator[list[str]]:
    """The commands after each `$ `, split at pipes, without settings and .venv/bin/."""
    for line in re.sub(r"\\\n\s*(> )?", " ", block.body).splitlines():
        if not line.startswith("$ "):
            continue
        lexer = shlex.shlex(line[2:], posix=True, punctuation_chars="|&;<>")
        lexer.whitespace_split = True
        words: list[str] = []
        for word in [*lexer, ";"]:
            if re.fullmatch(r"[|&;]+", word):
                while words and re.match(r"[A-Za-z_]\w*=", words[0]):
                    words.pop(0)
                if words:
                    yield [words[0].removeprefix(".venv/bin/"), *words[1:]]
                words = []
            else:
                words.append(word)


def before_redirection(words: list[str]) -> list[str]:
    return words[: next((i for i, word in enumerate(words) if re.fullmatch(r"[<>&]+", word)), len(words))]


def slugs(text: str) -> set[str]:
    """The anchors that a forge gives to the headings of a document; repeated ones are numbered."""
    seen: dict[str, int] = {}
    found = set()
    for heading in re.findall(r"^#+\s+(.+?)\s*#*$", FENCE.sub("", text), re.MULTILINE):
        slug = re.sub(r"[^\w\- ]", "", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()).replace(
            " ", "-"
        )
        found.add(f"{slug}-{seen[slug]}" if slug in seen else slug)
        seen[slug] = seen.get(slug, 0) + 1
    return found


def test_there_is_a_readme(root: Path) -> None:
    assert (root / "README.md").read_text().startswith("# potserver")


def test_commands_in_the_documents_exist(
    root: Path, make_targets: set[str], command_faults: Callable[[list[str]], list[str]]
) -> None:
    faults = []
    for path in documents(root):
        for block in blocks(path.read_text(), "console"):
            for words in map(before_redirection, commands(block)):
                where = f"{path.relative_to(root)}:{block.line}"
                if words[0] == "make":
                    targets = [word for word in words[1:] if "=" not in word and not word.startswith("-")]
                    faults += [f"{where}: no target {name}" for name in targets if name not in make_targets]
                elif words[0] in ("potserver", "potclient"):
                    faults += [f"{where}: {fault}" for fault in command_faults(words)]
                elif words[0] == "docker":
                    files = [after for word, after in itertools.pairwise(words) if word == "-f"]
                    faults += [f"{where}: no file {name}" for name in files if not (root / name).is_file()]
    assert not faults, "\n".join(faults)


def import_faults(tree: ast.AST, where: str) -> list[str]:
    """What a module takes from our packages and is not there."""
    faults = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in OURS:
            module = importlib.import_module(node.module)
            names = [alias.name for alias in node.names if not hasattr(module, alias.name)]
            missing = [name for name in names if importlib.util.find_spec(f"{node.module}.{name}") is None]
            faults += [f"{where}: {node.module} has no {name}" for name in missing]
    return faults


def test_python_in_the_documents_compiles_and_imports_what_exists(root: Path) -> None:
    faults = []
    for path in documents(root):
        for block in blocks(path.read_text(), "python"):
            where = f"{path.relative_to(root)}:{block.line}"
            try:
                faults += import_faults(ast.parse(block.body), where)
            except SyntaxError as error:
                faults.append(f"{where}: {error}")
    assert not faults, "\n".join(faults)


def test_scripts_beside_the_documents_import_what_exists(root: Path) -> None:
    faults = []
    for path in scripts(root):
        faults += import_faults(ast.parse(path.read_text()), str(path.relative_to(root)))
    assert not faults, "\n".join(faults)


def test_scripts_that_the_documents_name_exist(root: Path) -> None:
    named = {
        (path.name, found)
        for path in documents(root)
        for found in re.findall(r"python ((?:benchmarks|docs|clients/examples)/[\w/]+\.py)", path.read_text())
    }
    assert named
    assert not [f"{name}: no {found}" for name, found in sorted(named) if not (root / found).is_file()]


def test_every_figure_with_a_script_has_been_drawn(root: Path) -> None:
    drawn = {path.stem for path in (root / "docs/pictures").iterdir() if path.suffix in (".png", ".gif")}
    assert {path.stem for path in (root / "docs/pictures").glob("*.py")} == drawn


def test_the_page_moves_on_the_readmes_first_screen(root: Path) -> None:
    first_screen = (root / "README.md").read_text().partition("\n## ")[0]
    assert "](docs/pictures/page.gif)" in first_screen


@pytest.mark.parametrize("name", ["page.gif", "growing_map.gif"])
def test_moving_pictures_are_small_enough_to_load(root: Path, name: str) -> None:
    path = root / "docs/pictures" / name
    assert path.stat().st_size <= 2_000_000
    with Image.open(path) as picture:
        assert picture.n_frames > 5
        assert picture.width <= 700


@pytest.mark.parametrize(("name", "most"), MOST_BYTES.items())
def test_first_documents_are_short(root: Path, name: str, most: int) -> None:
    assert len((root / name).read_bytes()) <= most


def test_every_decision_has_its_parts_and_a_line_in_the_index(root: Path) -> None:
    folder = root / "docs/decisions"
    index = (folder / "README.md").read_text()
    records = sorted(path for path in folder.glob("*.md") if path.name != "README.md")
    assert [int(path.name[:4]) for path in records] == list(range(1, len(records) + 1))
    parts = re.compile(
        r"# \S[^\n]*\n\nDate: \d{4}-\d\d-\d\d\n\n## Context\n\n\S.*\n## Choice\n\n\S.*\n## Evidence\n\n\S.*",
        re.DOTALL,
    )
    for path in records:
        assert re.fullmatch(r"\d{4}-[a-z0-9-]+\.md", path.name)
        text = path.read_text()
        assert parts.fullmatch(text), path.name
        title = text.partition("\n")[0].removeprefix("# ")
        assert f"| [{path.name[:4]}]({path.name}) | {title} |" in index


def test_no_document_names_a_path_of_somebodys_machine(root: Path) -> None:
    found = [
        f"{path.relative_to(root)}: {match.group()}"
        for path in [*documents(root), *scripts(root)]
        for match in MACHINE_PATH.finditer(path.read_text())
    ]
    assert not found


def test_links_in_the_documents_lead_somewhere(root: Path) -> None:
    faults = []
    for path in documents(root):
        text = path.read_text()
        for match in LINK.finditer(FENCE.sub("", text)):
            target = match[1] or match[2]
            if re.match(r"[a-z][a-z0-9+.-]*:", target):
                continue  # another site: not ours to check
            name, _, anchor = target.partition("#")
            file = (path.parent / name).resolve() if name else path
            if not file.exists():
                faults.append(f"{path.relative_to(root)}: no {target}")
            elif anchor and file.suffix == ".md" and anchor not in slugs(file.read_text()):
                faults.append(f"{path.relative_to(root)}: no heading {target}")
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("$ make test", [["make", "test"]]),
        ("$ POT=1 .venv/bin/potserver serve -l tcp/x:1 &", [["potserver", "serve", "-l", "tcp/x:1"]]),
        ("$ potclient info | head -3", [["potclient", "info"], ["head", "-3"]]),
        ("$ cd a && potclient \\\n    watch", [["cd", "a"], ["potclient", "watch"]]),
        ("its output", []),
    ],
)
def test_commands_are_found(line: str, expected: list[list[str]]) -> None:
    assert list(commands(Block("console", line, 1))) == expected


def test_no_document_has_a_placeholder_left(root: Path) -> None:
    left = [
        f"{path.name}: {found}"
        for path in documents(root)
        for found in re.findall(r"\b[A-Z]+_TABLE\b|TODO", path.read_text())
    ]
    assert not left
