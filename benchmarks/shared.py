"""What the benchmarks share: their flags, what they were measured on, and where their numbers and curves go."""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


def parser_of(text: str | None, *, draws: bool = False) -> argparse.ArgumentParser:
    """A parser with the flags that say where results go.

    Args:
        text: The benchmark's docstring.
        draws: Whether it draws curves.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help="write the numbers")
    if draws:
        parser.add_argument("-o", "--out", metavar="PNG", help="draw the curves")
    return parser


def keep(options: argparse.Namespace, found: Any, draw: Callable[[], Any] | None = None) -> None:
    """Write the numbers and draw the curves where the flags want them.

    Args:
        options: The flags.
        found: What goes into the file.
        draw: Makes the figure.
    """
    if options.json:
        Path(options.json).write_text(json.dumps(found, indent=1) + "\n")
    if draw is not None and options.out:
        draw().savefig(options.out, dpi=110)
        print(f"curves: {options.out}")


def machine() -> str:
    """What was measured on, and which commit."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout
    load = ", ".join(f"{n:.0f}" for n in os.getloadavg())
    return f"{os.cpu_count()} processors ({platform.machine()}), load {load}, commit {commit.strip()}, {time.strftime('%F')}"


def spread(values: Any, *, digits: int = 0) -> str:
    """The median, and the middle 80 %."""
    low, middle, high = np.quantile(values, (0.1, 0.5, 0.9))
    return f"{middle:.{digits}f} [{low:.{digits}f}-{high:.{digits}f}]"
