"""What a verb shows: one JSON document, or lines and tables on stdout, a progress bar on stderr; and Ctrl-C."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from textwrap import fill
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from ..errors import without_password

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from ..datasets.importing import ImportReport
    from ..decision.certificate import Certificate

WIDE = 80  # columns where no terminal says otherwise; every table fits them
INTERRUPTED = 130  # exit code, as shells have it: 128 + SIGINT
Asked = Callable[[], bool]


def show(*parts: Any) -> None:
    """Print tables and lines to stdout; lines are broken between words, a long path never, and passwords are masked."""
    out = console()
    for part in parts:
        if isinstance(part, str):
            part = fill(without_password(part), out.width, break_long_words=False, break_on_hyphens=False)
        out.print(part, highlight=False, markup=False, soft_wrap=isinstance(part, str))


def console() -> Console:
    """The screen, or a file of its usual width."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=WIDE)


def facts(title: str, rows: Iterable[tuple[str, ...]], columns: Sequence[str] = ("", "")) -> Table:
    """A table of named facts, a row each: its name, and its values under `columns`; passwords are masked."""
    from rich.table import Table

    table = Table(title=without_password(title), show_header=any(columns), title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, style="" if i else "bold", no_wrap=not i, overflow="fold")
    for row in rows:
        table.add_row(*map(without_password, row))
    return table


def figures(
    title: str, rows: Sequence[Mapping[str, str]], caption: str = "", words: Sequence[str] = (), total: bool = False
) -> Table:
    """A table of numbers, to the right, under the rows' names; words : columns that hold words, and give way.

    total : whether a line sets the last row apart.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    look: dict[str, Any] = {"box": SIMPLE_HEAD, "title_justify": "left", "caption_justify": "left"}
    look |= {"caption": f"\n{caption}\n"} if caption else {}
    table = Table(title=f"\n{without_password(title)}\n", pad_edge=False, show_edge=False, **look)
    for name in rows[0]:
        text = name in words
        table.add_column(name, justify="left" if text else "right", no_wrap=not text, overflow="fold")
    for i, row in enumerate(rows):
        if total and i == len(rows) - 1:
            table.add_section()
        table.add_row(*row.values())
    return table


def write_json(result: Mapping[str, Any]) -> None:
    """Print one JSON document; NaN, which JSON has not, becomes null."""
    from ..records import plain

    click.echo(json.dumps(plain(result), indent=2, allow_nan=False))


def duration(seconds: float) -> str:
    """A time as a person writes it: 180 µs, 35 ms, 4.6 s, 240 s."""
    if seconds < 0.9995e-3:
        return f"{1e6 * seconds:.0f} µs"
    if seconds < 0.9995:
        return f"{1e3 * seconds:.1f} ms" if seconds < 9.95e-3 else f"{1e3 * seconds:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 99.95 else f"{seconds:.0f} s"


def when(seconds: float | None, form: str = "%Y-%m-%d %H:%M:%S UTC") -> str:
    """A moment, in UTC; seconds since 1970."""
    return "-" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime(form)


def size(n_bytes: float) -> str:
    """A size as a person writes it: 812 B, 296 kB, 1.4 MB, 4.4 GB."""
    for factor, unit in ((1e9, "GB"), (1e6, "MB")):
        if n_bytes >= 0.9995 * factor:
            return f"{n_bytes / factor:.1f} {unit}"
    return f"{n_bytes / 1e3:.0f} kB" if n_bytes >= 1e3 else f"{n_bytes:.0f} B"


def imported_line(report: ImportReport, store: str) -> str:
    """What became of imported labels; what did not happen is not mentioned."""
    left = f" Its last line, {report.cut} bytes, was not finished and was left out." if report.cut else ""
    if report.contradicted:
        left += f" {report.contradicted} labels say the opposite of what is there and were left out; correct them there."
    if not report.imported and not report.quarantined:
        return f"Nothing new for {store}: all {report.known} traces were there from an earlier import.{left}"
    bad = f" {report.quarantined} bad traces are kept there too and never trained on." if report.quarantined else ""
    known = f" {report.known} were there from an earlier import and were left out." if report.known else ""
    return f"Imported {report.imported} labelled traces into {store}.{bad}{known}{left}"


def certificate_record(certificate: Certificate) -> dict[str, Any]:
    """A certificate as JSON has it: its numbers, and what they say in words."""
    said = {name: getattr(certificate, name) for name in ("kept", "sentence", "sentence_on_rejects", "advice")}
    return asdict(certificate) | said


@contextmanager
def progress(label: str, total: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A bar on stderr that goes when done; the function it gives advances it by so many."""
    if quiet:
        yield lambda step: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(without_password(label), total=total)
        yield lambda step: bar.advance(task, step)


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
