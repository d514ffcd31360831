"""What the subcommands of `dengine` print and write: JSON or tables, files, progress bars.

A subcommand calls `print_result` once: it prints one JSON document (`--json`), or tables and lines
for people, and writes the files of `--out`. Besides: tables of records, values as people read them,
progress bars on stderr, and what Ctrl-C does.
"""

import json
import math
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from textwrap import fill
from threading import Event, Thread
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from ..errors import DengineError, percent, without_password

if TYPE_CHECKING:
    from rich.table import Table

    from ..decision.certificate import Certificate

Record = dict[str, Any]  # what `--json` prints, by name
Advance = Callable[[int], None]  # adds a number of steps to those that are done
SCREEN_WIDTH = 80  # columns where no terminal says otherwise; every table fits them
LONGEST_NAME = 40  # characters in the first column of a table that is never wrapped
LINE_SECONDS = 30.0  # between two lines about progress where there is no terminal
INTERRUPTED = 130  # exit code, as shells have it: 128 + SIGINT
# The names of two flags, and the keys in click's context that hold whether they were given.
JSON = "--json"
EXPLAIN = "--explain"


def _context_flag(name: str, text: str) -> Callable[[Any], Any]:
    """Return a decorator that adds the flag `name`, whose help is `text`, to a subcommand.

    Its value is kept in the `meta` of click's context under this name. The subcommand does not
    receive it as an argument.
    """

    def keep(context: click.Context, option: click.Parameter, value: bool) -> None:
        context.meta[name] = value

    return click.option(name, is_flag=True, expose_value=False, callback=keep, help=text)


json_option = _context_flag(JSON, "Print one JSON document and nothing else.")
explain_option = _context_flag(EXPLAIN, "Explain the columns below the table.")


def legend_or_hint(legend: str) -> str:
    """Return the legend of a table if the running subcommand was given `--explain`, else a line
    that names that flag. Raises RuntimeError if no subcommand runs.
    """
    if click.get_current_context().meta.get(EXPLAIN):
        return legend
    return "--explain says what the columns mean."


def as_json() -> bool:
    """Return whether the running subcommand was given `--json`, and prints nothing but JSON; False
    if none runs.
    """
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(JSON))


@dataclass(frozen=True)
class Out:
    """Where a subcommand writes its files, as `--out` and `--force` say.

    Parameters
    ----------
    path : Path
        A folder, or the file of the subcommand's only picture.
    force : bool
        Replace files that exist.
    """

    path: Path
    force: bool

    def write(self, contents: Mapping[str, Any]) -> list[Path]:
        """Write files into the folder `path`, which is made if it is missing; return their paths.

        Parameters
        ----------
        contents : mapping of str to DataFrame or Figure
            File name -> a table (written as CSV) or a figure, in the format of the file's suffix
            (PNG without a suffix). The name "" is `path` itself, which is then a file; its folder
            is made.

        Returns
        -------
        paths : list of Path
            Of the files that were written.

        Raises
        ------
        OutputError
            A file exists and `force` is not set, it is a database or a link, it cannot be written,
            or no format of figures has its suffix. The files before it in `contents` are written
            already.
        """
        from matplotlib.figure import Figure

        from ..experiments.figures import save
        from ..experiments.tables import write_csv

        paths = []
        for name, content in contents.items():
            write: Any = save if isinstance(content, Figure) else write_csv
            paths.append(write(content, self.path / name, force=self.force))
        return paths


def print_result(
    record: Record,
    *parts: Any,
    out: Out | None = None,
    make_files: Callable[[], Mapping[str, Any]] | None = None,
) -> None:
    """Print a subcommand's result, after writing its files.

    Parameters
    ----------
    record : mapping
        The JSON document, which `--json` prints alone. Its values may be anything that
        `to_jsonable` takes: NaN and infinities are printed as null, and passwords of URLs are
        masked. The subcommand's name, as "verb", and, with `make_files`, the paths of the files
        that were written, as "files", are added to it, in a copy. If a file could not be written,
        none is listed, not even those written before it.
    *parts : str or rich.Table
        What is printed without `--json`. A line for each file that was written follows.
    out : Out or None
        Where the files go. None writes none.
    make_files : callable or None
        Returns the files' contents, as `Out.write` takes them. Called only if `out` is given.

    Raises
    ------
    DengineError
        `make_files` raised it, or a file could not be written. It is raised after the result was
        printed, so that what was computed is not lost; any other exception of `make_files` or of
        `Out.write` is raised before.
    """
    files: list[Path] = []
    refusal: DengineError | None = None
    if out is not None and make_files is not None:
        try:
            files = out.write(make_files())
        except DengineError as error:
            refusal = error
    if as_json():
        from ..representation import to_jsonable

        document: Record = {"verb": click.get_current_context().info_name} | record
        if make_files is not None:
            document["files"] = files
        # `to_jsonable` has turned NaN, which JSON lacks, into None.
        click.echo(json.dumps(to_jsonable(document), indent=2, allow_nan=False))
    else:
        print_parts(*parts, *(f"Wrote {path}" for path in files))
    if refusal is not None:
        raise refusal


def print_parts(*parts: Any) -> None:
    """Print tables and texts to stdout, the texts with the passwords of database URLs masked.

    `table_of_rows` masks them in its tables; in other tables they stay. A table fits the terminal,
    or 80 columns if there is none. A text of one line is wrapped to this width between words, so
    long paths stay whole. A text of several lines is printed as it is, and "" as an empty line.
    """
    from rich.console import Console

    screen = Console(width=None if sys.stdout.isatty() else SCREEN_WIDTH, emoji=False)
    for part in parts:
        is_text = isinstance(part, str)
        if is_text:
            part = without_password(part)
            if "\n" not in part:
                part = fill(part, screen.width, break_long_words=False, break_on_hyphens=False)
        screen.print(part, highlight=False, markup=False, soft_wrap=is_text)


def table_of_rows(
    title: str, rows: Iterable[Sequence[str]], columns: Sequence[str] = ("", "")
) -> "Table":
    """Return a rich Table whose first column is bold; passwords of database URLs are masked.

    A cell that is too wide is wrapped; in the first column only if it has a cell of more than 40
    characters (`LONGEST_NAME`). Print it with `markup=False`: cells and titles of columns are not
    escaped.

    Parameters
    ----------
    title : str
        Title of the table.
    rows : iterable of sequences of str
        The cells of each row.
    columns : sequence of str
        Titles of the columns; if all are empty, the table has no header.
    """
    from rich.markup import escape
    from rich.table import Table

    table = Table(
        title=escape(without_password(title)), show_header=any(columns), title_justify="left"
    )
    cells = [[*map(without_password, row)] for row in rows]
    is_short = all(len(row[0]) <= LONGEST_NAME for row in cells)
    for i, name in enumerate(columns):
        table.add_column(
            name, style="" if i else "bold", no_wrap=is_short and not i, overflow="fold"
        )
    for row in cells:
        table.add_row(*row)
    return table


def table_of_records(title: str, records: Iterable[Any], *names: str) -> "Table":
    """Return a rich Table with a row for each record and a column for each of the named fields.

    `heading` makes the titles of the columns, and `format_value` the cells. Without records it has
    the titles only. Passwords of database URLs are masked. Print it with `markup=False`, because
    cells are not escaped. Raises AttributeError for a field that a record lacks.
    """
    return table_of_rows(
        title,
        [[format_value(name, getattr(record, name)) for name in names] for record in records],
        [heading(name) for name in names],
    )


def field_rows(record: Any, *left_out: str) -> Iterator[tuple[str, str]]:
    """Yield (heading, formatted value) for each field of the dataclass `record`.

    `heading` and `format_value` make both texts, in the order of the fields. Fields that are None
    or empty (a text, list or mapping), and those named in `left_out`, are skipped; 0 and False are
    not.
    """
    for field in fields(record):
        value = getattr(record, field.name)
        is_empty = value is None or (isinstance(value, Sized) and not value)
        if field.name not in left_out and not is_empty:
            yield heading(field.name), format_value(field.name, value)


def heading(name: str) -> str:
    """Return a field's name as people read it, without its unit: retrain_max_s -> retrain max.

    Units are `_s`, `_bytes` and `_hz` at the end; every other underscore becomes a space.
    """
    return re.sub("_(s|bytes|hz)$", "", name).replace("_", " ")


def format_value(name: str, value: Any) -> str:
    """Return a field's value as people read it.

    Parameters
    ----------
    name : str
        The field's name. Its ending tells the unit (`FORMATTERS`): `_s` seconds, `_bytes` bytes,
        `share` a share of 1, and so on.
    value : object
        A number, a text, a dataclass, or a mapping, list or tuple of these. None, NaN and "" give
        "-", a bool "yes" or "no". A dataclass gives its own `str`, or else its fields with their
        headings, of which those that are None or empty are left out. Of a mapping only the items
        that are not 0 are shown, each after its key, by which it is formatted; if there are none,
        the text is "none". Items are joined by commas; each of the three `prices` stands after its
        title: check, escape (a bad part that is accepted) or false reject. An empty list or tuple
        gives "". A number whose name has no known ending has 4 significant digits, or is whole if
        it is a whole number, with commas between thousands. Passwords of database URLs in a text
        are masked.

    Raises
    ------
    ValueError
        For `prices` with another number of items than three.
    """
    if isinstance(value, str) or value is None:
        return without_password(value) if value else "-"
    if is_dataclass(value):
        if "__str__" in vars(type(value)):
            return str(value)
        return ", ".join(f"{title} {text}" for title, text in field_rows(value))
    if isinstance(value, Mapping):
        counts = [f"{key} {format_value(key, item)}" for key, item in value.items() if item != 0]
        return ", ".join(counts) or "none"
    if isinstance(value, list | tuple):
        titles = TUPLE_TITLES.get(name, ("",) * len(value))
        return ", ".join(
            f"{title} {format_value(name, item)}".strip()
            for title, item in zip(titles, value, strict=True)
        )
    if isinstance(value, bool):
        return "yes" if value else "no"
    if math.isnan(value):
        return "-"
    for ending, formatter in FORMATTERS.items():
        if name.endswith(ending):
            return formatter(value)
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.4g}"


def format_duration(seconds: float) -> str:
    """Return a duration, given in seconds, as text in µs, ms or s: 180 µs, 35 ms, 4.6 s, 240 s.

    It is rounded to whole units, but from 1 to 10 ms, and from 1 to 100 s, to one decimal.
    """
    if seconds < 0.9995e-3:
        return f"{1e6 * seconds:.0f} µs"
    if seconds < 9.95e-3:
        return f"{1e3 * seconds:.1f} ms"
    if seconds < 0.9995:
        return f"{1e3 * seconds:.0f} ms"
    return f"{seconds:.1f} s" if seconds < 99.95 else f"{seconds:.0f} s"


def format_time(seconds: float | None, form: str = "%Y-%m-%d %H:%M:%S UTC") -> str:
    """Return a time, given in seconds since 1970, as text in UTC; "-" for None.

    `form` is a format of `strftime`, by default the date and the time to the second, and "UTC". The
    fraction of a second is cut off.
    """
    return "-" if seconds is None else datetime.fromtimestamp(seconds, UTC).strftime(form)


def format_size(n_bytes: float) -> str:
    """Return a size as people write it: 812 bytes, 296.0 kB, 1.4 MB.

    A kB is 1,000 bytes. A fraction of a byte is cut off; from 1 kB on there is one decimal.
    """
    from rich.filesize import decimal

    return decimal(int(n_bytes))


# By the name of a field that is a tuple: the title of each of its places.
TUPLE_TITLES = {"prices": ("check", "escape", "false reject")}
# By the ending of a field's name.
FORMATTERS: dict[str, Callable[[float], str]] = {
    **dict.fromkeys(("_s", "seconds", "budget"), format_duration),
    **dict.fromkeys(("_time", "last_seen"), format_time),
    **dict.fromkeys(("share", "rate", "tolerance"), percent),
    "_bytes": format_size,
    "_hz": lambda hertz: f"{hertz:g} Hz",
    "distance": lambda value: f"{value:.3g}",
}


def certificate_record(certificate: "Certificate") -> Record:
    """Return a certificate as a dict for JSON.

    It has all its fields, `kept` (whether the bound on accepted parts lies within the tolerance),
    and its sentences on accepted and on rejected parts, `sentence` and `sentence_on_rejects`.
    """
    return asdict(certificate) | {
        name: getattr(certificate, name) for name in ("kept", "sentence", "sentence_on_rejects")
    }


@contextmanager
def progress_bar(label: str, total: int | None) -> Iterator[Advance]:
    """Show a progress bar on stderr while the block runs; it vanishes at the end.

    If stderr is no terminal, a thread writes a line every 30 s that says how far the work is. With
    `--json` nothing is shown, and `advance` does nothing.

    Parameters
    ----------
    label : str
        Text beside the bar; passwords in it are masked.
    total : int or None
        Number of steps; None if it is not known.

    Yields
    ------
    advance : callable
        `advance(n)` moves the bar by n steps.
    """
    if as_json():
        yield lambda n: None
        return
    if not sys.stderr.isatty():
        with _progress_lines(label, total) as advance:
            yield advance
        return
    from rich.console import Console
    from rich.progress import MofNCompleteColumn, Progress

    with Progress(
        *Progress.get_default_columns(),
        MofNCompleteColumn(),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task(without_password(label), total=total)
        yield lambda n: bar.advance(task, n)


@contextmanager
def _progress_lines(label: str, total: int | None) -> Iterator[Advance]:
    """Write a line on the progress to stderr every 30 s (`LINE_SECONDS`) while the block runs.

    A thread writes the lines: `label`, the number of steps done of `total` ("?" if it is None or
    0), and the time so far. The function that is yielded, `advance(n)`, adds n steps and writes
    nothing itself.
    """
    n_steps = 0
    ended = Event()

    def advance(n: int) -> None:
        """Count n more steps."""
        nonlocal n_steps
        n_steps += n

    def write_lines() -> None:
        """Write a line every `LINE_SECONDS` until the block ends."""
        begin = time.monotonic()
        while not ended.wait(LINE_SECONDS):
            seconds = format_duration(time.monotonic() - begin)
            click.echo(
                without_password(f"{label}: {n_steps:,} of {total or '?'} in {seconds}"), err=True
            )

    Thread(target=write_lines, daemon=True).start()
    try:
        yield advance
    finally:
        ended.set()


class StepInterruptedError(Exception):
    """Raised between two steps to end a loop after Ctrl-C; its argument is the number of steps."""


@contextmanager
def interruptible_steps(label: str, total: int) -> Iterator[Advance]:
    """Show a progress bar, and let Ctrl-C or SIGTERM end the work between two steps.

    It replaces the handlers of these signals, and of Ctrl-Break on Windows, until the block ends.
    The first signal makes the next call of `count` raise StepInterruptedError; if no call follows,
    the signal has no effect. A second signal of the same kind acts at once, as it would have
    without this block; one of another kind is only remembered, too. It must be used in the main
    thread, because Python allows signal handlers only there; elsewhere ValueError is raised.

    Parameters
    ----------
    label : str
        Text beside the bar.
    total : int
        Number of steps.

    Yields
    ------
    count : callable
        `count(n)` records n finished steps, moves the bar, and, if a signal has arrived, raises
        StepInterruptedError, whose argument is the number of finished steps.
    """
    from ..serve.retraining import END_SIGNALS

    interrupted = False
    n_done = 0
    previous = {number: signal.getsignal(number) for number in END_SIGNALS}

    def interrupt(number: int, frame: FrameType | None) -> None:
        """Remember the signal, and restore the earlier handler for a second signal of its kind."""
        nonlocal interrupted
        interrupted = True
        signal.signal(number, previous[signal.Signals(number)])

    with progress_bar(label, total) as advance:

        def count(n: int) -> None:
            """Record n finished steps; raise StepInterruptedError if a signal has arrived."""
            nonlocal n_done
            n_done += n
            advance(n)
            if interrupted:
                raise StepInterruptedError(n_done)

        for number in previous:
            signal.signal(number, interrupt)
        try:
            yield count
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def exit_interrupted(*lines: str) -> NoReturn:
    """Print lines to stderr that say what was kept, and end the running subcommand, and so the
    process, with exit code 130; passwords are masked.

    It raises click's `Exit`, and never returns. The lines are printed also with `--json`.
    """
    for line in lines:
        click.echo(without_password(line), err=True)
    click.get_current_context().exit(INTERRUPTED)
