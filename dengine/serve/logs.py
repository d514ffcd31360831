"""Log lines that a machine reads as well: time, level, logger, and the message as JSON has a text.

    2026-11-22T18:51:05.120Z level=warning logger=dengine message="labels wait in the journal beside the store: ..."

Nothing in a message ends its line, and no password is in it.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TextIO

from ..wording import without_password


class Lines(logging.Formatter):
    """A record as one line."""

    def format(self, record: logging.LogRecord) -> str:
        """Time, level, logger, message; and what was raised."""
        time = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
        line = f"{time} level={record.levelname.lower()} logger={record.name} message={_said(record.getMessage())}"
        raised = f" raised={_said(self.formatException(record.exc_info))}" if record.exc_info else ""
        return line + raised


def _said(text: str) -> str:
    return json.dumps(without_password(text))


@contextmanager
def log_lines_to(stream: TextIO) -> Iterator[None]:
    """Have every logger write such lines; uvicorn none, for what it refuses is answered, and what fails is told here."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(Lines())
    root, ours, theirs = (logging.getLogger(name) for name in ("", "dengine", "uvicorn"))
    handlers, levels = root.handlers[:], [logger.level for logger in (root, ours, theirs)]
    root.handlers[:] = [handler]
    _set_levels((root, ours, theirs), (logging.WARNING, logging.INFO, logging.CRITICAL))
    try:
        yield
    finally:
        root.handlers[:] = handlers
        _set_levels((root, ours, theirs), levels)


def _set_levels(loggers: Iterable[logging.Logger], levels: Iterable[int]) -> None:
    for logger, level in zip(loggers, levels, strict=True):
        logger.setLevel(level)
