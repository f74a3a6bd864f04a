"""`potserver demo`, the first command of the README, as a person runs it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

TIMEOUT_S = 240.0  # the first run on a machine compiles
MAPS = ("street", "rooms", "plan")


def test_the_demo_maps_scores_and_draws(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    environ = {k: v for k, v in os.environ.items() if not k.startswith(("POTSERVER_", "ZENOH_"))}
    run = subprocess.run(
        [sys.executable, "-m", "potserver", "demo", "--scans", "2", "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        cwd=tmp_path,
        env=environ,
    )
    assert (run.returncode, run.stderr) == (0, "")
    summary = json.loads((out / "summary.json").read_text())
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["summary.json", *(f"{m}.png" for m in MAPS)]
    )
    for name in MAPS:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")

    assert list(summary["maps"]) == list(MAPS)
    assert summary["scans"] == summary["receipts_accepted"] == 6
    assert summary["kernels"] == sum(each["kernels"] for each in summary["maps"].values())
    for each in summary["maps"].values():
        assert each["scans"] == len(each["ms_per_scan"]) == 2
        assert each["auc"] > 0.95
        assert each["nll"] < 0.3
        assert each["atoms"], "atoms were carried to its scans"

    text = run.stdout
    assert "server ready after" in text
    for name, each in [*summary["maps"].items(), ("all", summary)]:
        row = next(
            line.split() for line in text.splitlines() if line.split()[:2] == [name, str(each["scans"])]
        )
        assert row[2:4] == [str(each["receipts_accepted"]), str(each["kernels"])]
        assert row[5:7] == [f"{each['acc']:.3f}", f"{each['auc']:.3f}"]
    assert text.count("held-out beams: ACC") == 3
    assert f"results: {out}/summary.json" in text.replace("\n", "")
