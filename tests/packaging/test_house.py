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


def test_hooks_use_the_tools_of_the_environment(root: Path) -> None:
    hooks = yaml.safe_load((root / ".pre-commit-config.yaml").read_text())
    for repository in hooks["repos"]:
        assert repository["repo"] == "local"
        for hook in repository["hooks"]:
            assert hook["entry"].startswith(".venv/bin/")


def test_the_changelog_knows_this_version_and_what_changed_on_the_wire(root: Path) -> None:
    text = (root / "CHANGELOG.md").read_text()
    section = text.partition(f"## [{__version__}]")[2].partition("\n## ")[0]
    assert "### Wire" in section


def test_bundled_scans_are_attributed(root: Path) -> None:
    notice = " ".join((root / "NOTICE").read_text().split())
    for line in ("Copyright (c) 2024 Kenji Koide", "Copyright (c) 2017 Robust Field Autonomy Lab"):
        assert line in notice
    assert "Permission is hereby granted, free of charge" in notice
