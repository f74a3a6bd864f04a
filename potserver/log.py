"""Structured log events over the standard `logging` tree, so that an embedded server stays silent unless
asked. Values under keys that hold secrets are hidden.

An event is a past-tense name plus fields: `log.info("scan_integrated", map_id=..., elapsed_ms=...)`. The
process that owns the terminal calls `configure_logging` once; a program that embeds `MapServer` configures
the `potserver` logger as it likes.
"""

from __future__ import annotations

import logging
import sys
from typing import Any, TextIO, cast

import structlog

from potschemas.redaction import redacted


def _hide_secrets(_logger: Any, _method: str, event: Any) -> Any:
    return redacted(event)


_SHARED: list[Any] = [
    structlog.stdlib.add_log_level,
    structlog.processors.TimeStamper(fmt="iso", utc=True),
    _hide_secrets,
]


def get_logger(name: str = "potserver") -> structlog.stdlib.BoundLogger:
    """A structlog logger whose events go through the standard logger of this name."""
    return cast(
        structlog.stdlib.BoundLogger,
        structlog.wrap_logger(
            logging.getLogger(name),
            processors=[
                structlog.stdlib.filter_by_level,
                *_SHARED,
                structlog.stdlib.ProcessorFormatter.wrap_for_formatter,
            ],
            wrapper_class=structlog.stdlib.BoundLogger,
            cache_logger_on_first_use=True,
        ),
    )


def configure_logging(level: str = "info", style: str = "auto", stream: TextIO | None = None) -> None:
    """Send all log events of the process to one stream.

    Args:
        level: debug, info, warning or error.
        style: `json` (one object a line), `console` (for people), or `auto`: console on a terminal, else
            json.
        stream: Default stderr.
    """
    stream = stream or sys.stderr
    for_people = style == "console" or (style == "auto" and stream.isatty())
    renderer: Any = (
        # as plain text: pretty tracebacks show the values of variables
        structlog.dev.ConsoleRenderer(
            colors=stream.isatty(), exception_formatter=structlog.dev.plain_traceback
        )
        if for_people
        else structlog.processors.JSONRenderer()
    )
    handler = logging.StreamHandler(stream)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=_SHARED,
            processors=[
                structlog.stdlib.ProcessorFormatter.remove_processors_meta,
                structlog.processors.format_exc_info,
                _hide_secrets,  # in the tracebacks too
                renderer,
            ],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)  # other libraries: warnings and worse
    logging.getLogger("potserver").setLevel(level.upper())
