"""Names of threads, as the system's tools show them (`top -H`, perf)."""

from __future__ import annotations

import ctypes
import sys
import threading

_PR_SET_NAME = 15  # of Linux's prctl.h; it keeps 15 characters


def show_name() -> None:
    """Give the running thread its Python name; on Linux."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_NAME, threading.current_thread().name.encode())
