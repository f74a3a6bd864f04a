"""The files that build and check the project agree with each other."""

from __future__ import annotations

import os
import re
from pathlib import Path

import yaml

from potschemas import __version__


def test_ci_runs_targets_that_exist_and_stops_on_errors(root: Path, make_targets: set[str]) -> None:
    script = root / ".ci" / "run"
    text = script.read_text()
    assert os.access(script, os.X_OK)
    assert text.startswith("#!/usr/bin/env bash\n")
    assert "set -euo pipefail" in text
    called = set(re.findall(r"\bmake (?:--?[\w-]+ )*([a-z-]+)", text))
    assert {"test", "check"} <= called
    assert called <= make_targets


def test_ci_ends_within_its_ninety_minutes(root: Path) -> None:
    minutes = [int(found) for found in re.findall(r"\btimeout (\d+)m\b", (root / ".ci" / "run").read_text())]
    assert 0 < sum(minutes) < 90


def test_every_phony_target_exists_and_every_public_one_is_explained(
    root: Path, make_targets: set[str]
) -> None:
    text = (root / "Makefile").read_text()
    assert set(re.search(r"^\.PHONY: (help .*)$", text, re.MULTILINE)[1].split()) == make_targets
    explained = set(re.findall(r"^([a-z-]+):.*## ", text, re.MULTILINE))
    assert {"help", "venv", "demo", "test", "check", "bench", "clean"} <= explained


def test_hooks_bring_their_own_environments_with_the_tested_versions(root: Path) -> None:
    text = (root / ".pre-commit-config.yaml").read_text()
    constraints = (root / "constraints.txt").read_text()
    for repository in yaml.safe_load(text)["repos"]:
        if repository["repo"] != "local":
            assert re.fullmatch(r"v?\d[\w.]*", repository["rev"])
            continue
        for hook in repository["hooks"]:
            assert hook["language"] == "python"
            assert hook["additional_dependencies"]
            assert ".venv" not in hook["entry"]
            for pin in hook["additional_dependencies"]:
                assert "==" not in pin or re.search(rf"^{re.escape(pin)}$", constraints, re.MULTILINE), pin


def test_workflows_call_targets_that_exist(root: Path, make_targets: set[str]) -> None:
    called = set()
    for path in sorted((root / ".github" / "workflows").glob("*.yml")):
        workflow = yaml.safe_load(path.read_text())
        assert {"name", "on", "permissions", "jobs"} <= set(workflow), path.name
        for job in workflow["jobs"].values():
            assert job["timeout-minutes"] <= (360 if path.name == "nightly.yml" else 90)
            for step in job["steps"]:
                assert "run" in step or re.fullmatch(r"[\w-]+/[\w-]+@v\d+", step["uses"]), step
                called |= set(re.findall(r"\bmake (?:--?[\w-]+ )*([a-z-]+)", step.get("run", "")))
    assert {"test", "check", "wheels", "docs"} <= called  # wheels builds them first
    assert called <= make_targets


def test_workflows_test_every_python_that_the_makefile_takes(root: Path) -> None:
    workflow = yaml.safe_load((root / ".github" / "workflows" / "tests.yml").read_text())
    least, most = re.search(
        r"\(3, (\d+)\) <= sys\.version_info < \(3, (\d+)\)", (root / "Makefile").read_text()
    ).groups()
    expected = [f"3.{minor}" for minor in range(int(least), int(most))]
    assert workflow["jobs"]["test"]["strategy"]["matrix"]["python"] == expected


def test_issue_forms_have_what_a_forge_needs(root: Path) -> None:
    forms = sorted((root / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))
    assert "config.yml" in [path.name for path in forms]
    for path in forms:
        form = yaml.safe_load(path.read_text())
        if path.name == "config.yml":
            assert form["contact_links"]
        else:
            assert {"name", "description", "body"} <= set(form)
            assert len({part["id"] for part in form["body"]}) == len(form["body"])
    assert (root / ".github" / "pull_request_template.md").is_file()


def test_the_citation_names_the_paper_and_this_version(root: Path, project: dict) -> None:
    citation = yaml.safe_load((root / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "type", "authors", "version", "license"} <= set(citation)
    assert citation["type"] == "software"
    assert citation["version"] == __version__
    assert citation["license"] == project["license"]
    assert citation["repository-code"] == project["urls"]["Homepage"]
    paper = citation["preferred-citation"]
    assert paper["type"] == "conference-paper"
    assert paper["title"] == "Online Domain Adaptation for Occupancy Mapping"
    assert [author["family-names"] for author in paper["authors"]] == ["Tompkins", "Senanayake", "Ramos"]
    assert paper["year"] == 2020


def test_both_packages_say_where_they_are_from(root: Path, project: dict) -> None:
    client = (root / "clients" / "pyproject.toml").read_text()
    assert f'Homepage = "{project["urls"]["Homepage"]}"' in client
    assert {"Homepage", "Documentation", "Issues", "Changelog"} <= set(project["urls"])


def test_the_changelog_knows_this_version_and_what_changed_on_the_wire(root: Path) -> None:
    text = (root / "CHANGELOG.md").read_text()
    section = text.partition(f"## [{__version__}]")[2].partition("\n## ")[0]
    assert "### Wire" in section


def test_bundled_scans_are_attributed(root: Path) -> None:
    notice = " ".join((root / "NOTICE").read_text().split())
    for line in ("Copyright (c) 2024 Kenji Koide", "Copyright (c) 2017 Robust Field Autonomy Lab"):
        assert line in notice
    assert "Permission is hereby granted, free of charge" in notice
