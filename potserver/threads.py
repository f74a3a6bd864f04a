"""Named daemon threads: an embedded server must never keep its host process alive."""

from __future__ import annotations

import threading
from collections.abc import Callable

from potserver.log import get_logger
from potserver.thread_names import show_name

log = get_logger("potserver.threads")


def spawn(name: str, target: Callable[[], None]) -> threading.Thread:
    """Start a daemon thread that logs how it died, if it dies."""

    def run() -> None:
        show_name()
        try:
            target()
        except Exception:
            log.exception("thread_died", thread=name)

    thread = threading.Thread(target=run, name=name, daemon=True)
    thread.start()
    return thread
