"""What the benchmarks share: their flags, and where their numbers and curves go."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


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
