"""Ctrl-C: what was done so far is kept, and the verb says what that is."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

import click

from ..wording import without_password

INTERRUPTED = 130  # as shells have it: 128 + SIGINT

Asked = Callable[[], bool]


class EndAskedError(Exception):
    """Raised between two steps to leave a loop that belongs to somebody else."""


@contextmanager
def interruptible() -> Iterator[Asked]:
    """Let Ctrl-C ask for an end, which the loop inside grants between two steps; a second one ends at once.

    Gives a function that says whether it was asked.
    """
    if threading.current_thread() is not threading.main_thread():  # Python delivers signals to the main thread alone
        yield lambda: False
        return
    asked = False
    before = signal.getsignal(signal.SIGINT)

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, ask)
    try:
        yield lambda: asked
    finally:
        signal.signal(signal.SIGINT, before)


def end_interrupted(*lines: str) -> NoReturn:
    """Say on stderr what was kept, and end with exit code 130."""
    for line in lines:
        click.echo(without_password(line), err=True)
    click.get_current_context().exit(INTERRUPTED)
