"""What a verb shows: one JSON document, or tables on stdout and a progress bar on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from rich.console import Console

WIDE = 110  # columns where no terminal says otherwise: a table in a file is not folded


def show(*parts: Any) -> None:
    """Print tables and lines to stdout."""
    out = console()
    for part in parts:
        out.print(part, highlight=False, soft_wrap=isinstance(part, str))


def console() -> Console:
    """The screen, or a file that is as wide as a table needs."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=WIDE)


def write_json(result: Mapping[str, Any]) -> None:
    """Print one JSON document; NaN, which JSON has not, becomes null."""
    click.echo(json.dumps(plain(result), indent=2, allow_nan=False))


def plain(value: Any) -> Any:
    """A value that `json` takes: records as objects, paths and enums as text, NaN and infinities as None."""
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, bool | int | str) or value is None:
        return value
    if hasattr(value, "item"):  # a NumPy scalar
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value)


@contextmanager
def progress(label: str, total: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A bar on stderr that goes when done; the function it gives advances it by so many."""
    if quiet:
        yield lambda step: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=total)
        yield lambda step: bar.advance(task, step)
