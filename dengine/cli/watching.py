"""The same screen again and again, until Ctrl-C."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

from .interrupting import Asked, interruptible
from .output import console, show

STEP = 0.05  # seconds between two looks for Ctrl-C


def redraw(read: Callable[[], Sequence[Any]], seconds: float) -> None:
    """Show what `read` gives, and again every so many seconds; Ctrl-C is how it ends, so that is no failure.

    On a terminal the screen is drawn anew; elsewhere each look follows the one before.
    """
    with interruptible() as asked:
        if not sys.stdout.isatty():
            while not asked():
                show(*read())
                _wait(seconds, asked)
            return
        from rich.console import Group
        from rich.live import Live

        with Live(Group(*read()), console=console(), screen=True, auto_refresh=False) as live:
            while not asked():
                live.update(Group(*read()), refresh=True)
                _wait(seconds, asked)
    show(*read())  # the last look stays when the screen is given back


def _wait(seconds: float, asked: Asked) -> None:
    end = time.monotonic() + seconds
    while not asked() and (left := end - time.monotonic()) > 0:
        time.sleep(min(STEP, left))
