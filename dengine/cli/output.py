"""What a verb shows: one JSON document, or lines and tables on stdout, a progress bar on stderr; its files; and Ctrl-C."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from textwrap import fill
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from ..errors import DengineError, without_password

if TYPE_CHECKING:
    from rich.table import Table

    from ..datasets.importing import ImportReport
    from ..decision.certificate import Certificate

WIDE = 80  # columns where no terminal says otherwise; every table fits them
INTERRUPTED = 130  # exit code, as shells have it: 128 + SIGINT
JSON = "dengine.json"  # in click's context: whether --json was given
json_option = click.option(
    "--json",
    is_flag=True,
    expose_value=False,
    callback=lambda context, option, given: context.meta.update({JSON: given}),
    help="Print one JSON document and nothing else.",
)


def as_json() -> bool:
    """Whether the verb that runs was asked for JSON: nothing else is printed then."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(JSON))


@dataclass(frozen=True)
class Out:
    """Where a verb writes: a folder, or the file of its only picture. force : replace the files that are there."""

    path: Path
    force: bool = False

    def write(self, made: Mapping[str, Any]) -> list[Path]:
        """Write tables as CSV, texts and figures by their names, and a manifest; one without a name is the file itself."""
        from matplotlib.figure import Figure

        from ..experiments.figures import save
        from ..experiments.tables import write_csv
        from ..files import write_manifest, write_output

        files = []
        for name, each in made.items():
            if isinstance(each, Figure):
                files.append(save(each, self.path / name, force=self.force))
            elif isinstance(each, str):
                files.append(write_output(self.path / name, each.encode("utf-8"), self.force, make_folder=True))
            else:
                files.append(write_csv(each, self.path / name, self.force))
        return files if "" in made else [*files, write_manifest(self.path, files, self.force)]


def tell(
    record: Mapping[str, Any], *parts: Any, out: Out | None = None, made: Callable[[], Mapping[str, Any]] | None = None
) -> None:
    """Print what a verb found: its record as one JSON document, or for people these tables and lines.

    made : gives what is written to `out`. A refusal to write is raised once what was computed has been shown.
    """
    files: list[Path] = []
    refusal: DengineError | None = None
    if out is not None and made is not None:
        try:
            files = out.write(made())
        except DengineError as error:
            refusal = error
    if as_json():
        from ..records import plain

        named = {"verb": click.get_current_context().info_name} | dict(record)
        written = named if made is None else named | {"files": files}
        click.echo(json.dumps(plain(written), indent=2, allow_nan=False))  # NaN, which JSON has not, is null by now
    else:
        show(*parts, *(f"Wrote {path}" for path in files))
    if refusal is not None:
        raise refusal


def show(*parts: Any) -> None:
    """Print tables and text to stdout; passwords are masked.

    A line is broken between words, a long path never; text of several lines stays as it is.
    """
    from rich.console import Console

    screen = Console() if sys.stdout.isatty() else Console(width=WIDE)
    for part in parts:
        if isinstance(part, str):
            part = without_password(part)
            part = part if "\n" in part else fill(part, screen.width, break_long_words=False, break_on_hyphens=False)
        screen.print(part, highlight=False, markup=False, soft_wrap=isinstance(part, str))


def facts(title: str, rows: Iterable[tuple[str, ...]], columns: Sequence[str] = ("", "")) -> Table:
    """A table of named facts, a row each: its name, and its values under `columns`; passwords are masked."""
    from rich.table import Table

    table = Table(title=without_password(title), show_header=any(columns), title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, style="" if i else "bold", no_wrap=not i, overflow="fold")
    for row in rows:
        table.add_row(*map(without_password, row))
    return table


def figures(title: str, rows: Sequence[Mapping[str, str]], caption: str, total: bool = False) -> Table:
    """A table of numbers, to the right, under the rows' names. total : whether a line sets the last row apart."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    look: dict[str, Any] = {"box": SIMPLE_HEAD, "title_justify": "left", "caption_justify": "left"}
    look |= {"caption": f"\n{caption}\n", "pad_edge": False, "show_edge": False}
    table = Table(title=f"\n{without_password(title)}\n", **look)
    for name in rows[0]:
        table.add_column(name, justify="right", no_wrap=True)
    for i, row in enumerate(rows):
        if total and i == len(rows) - 1:
            table.add_section()
        table.add_row(*row.values())
    return table


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
def progress(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on stderr that goes when done, none beside JSON; the function it gives advances it by so many."""
    if as_json():
        yield lambda step: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(without_password(label), total=total)
        yield lambda step: bar.advance(task, step)


class EndAskedError(Exception):
    """Raised between two steps to leave a loop that belongs to somebody else; its argument: the steps that were done."""


@contextmanager
def steps(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar whose next step ends the work with EndAskedError where Ctrl-C asked for that; a second Ctrl-C ends at once."""
    asked, done, before = False, 0, signal.getsignal(signal.SIGINT)
    heard = threading.current_thread() is threading.main_thread()  # Python delivers signals to that one alone

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(signal.SIGINT, before)

    with progress(label, total) as advance:

        def count(n: int) -> None:
            nonlocal done
            done += n
            advance(n)
            if asked:
                raise EndAskedError(done)

        if heard:
            signal.signal(signal.SIGINT, ask)
        try:
            yield count
        finally:
            if heard:
                signal.signal(signal.SIGINT, before)


def end_interrupted(*lines: str) -> NoReturn:
    """Say on stderr what was kept, and end with exit code 130."""
    for line in lines:
        click.echo(without_password(line), err=True)
    click.get_current_context().exit(INTERRUPTED)
