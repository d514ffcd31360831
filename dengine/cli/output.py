"""What a verb shows: one JSON document, or lines and tables on stdout, a progress bar on stderr; its files; and Ctrl-C."""

import json
import math
import re
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass
from datetime import UTC, datetime
from pathlib import Path
from textwrap import fill
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from ..errors import DengineError, percent, without_password

if TYPE_CHECKING:
    from rich.table import Table

    from ..decision.certificate import Certificate

WIDE = 80  # columns where no terminal says otherwise; every table fits them
INTERRUPTED = 130  # exit code, as shells have it: 128 + SIGINT
JSON, EXPLAIN = "--json", "--explain"  # in click's context too: whether they were given


def _flag(name: str, text: str) -> Callable[[Any], Any]:
    keep: Callable[..., None] = lambda context, option, given: context.meta.update({name: given})  # noqa: E731
    return click.option(name, is_flag=True, expose_value=False, callback=keep, help=text)


json_option = _flag(JSON, "Print one JSON document and nothing else.")
explain_option = _flag(EXPLAIN, "Say below the table what its columns mean.")


def explained(legend: str) -> str:
    """What a table's columns mean, where the verb that runs was asked for it; else how to ask."""
    return legend if click.get_current_context().meta.get(EXPLAIN) else "--explain says what the columns mean."


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
        from ..representation import to_jsonable

        named = {"verb": click.get_current_context().info_name} | dict(record)
        written = named if made is None else named | {"files": files}
        click.echo(json.dumps(to_jsonable(written), indent=2, allow_nan=False))  # NaN, which JSON has not, is null by now
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


def facts(title: str, rows: Iterable[Sequence[str]], columns: Sequence[str] = ("", "")) -> "Table":
    """A table of named facts, a row each: its name, and its values under `columns`; passwords are masked."""
    from rich.table import Table

    table = Table(title=without_password(title), show_header=any(columns), title_justify="left")
    for i, name in enumerate(columns):
        table.add_column(name, style="" if i else "bold", no_wrap=not i, overflow="fold")
    for row in rows:
        table.add_row(*map(without_password, row))
    return table


def rows_of(record: Any, *left_out: str) -> Iterator[tuple[str, str]]:
    """A record's fields, each by its name and as `written`; None and empty ones are left out."""
    for each in fields(record):
        value = getattr(record, each.name)
        if each.name not in left_out and value is not None and not (isinstance(value, Sized) and not value):
            yield heading(each.name), written(each.name, value)


def listed(title: str, records: Iterable[Any], *names: str) -> "Table":
    """A table of records, a row each, of these fields."""
    rows = [[written(name, getattr(one, name)) for name in names] for one in records]
    return facts(title, rows, list(map(heading, names)))


def heading(name: str) -> str:
    """A field's name without its unit: `retrain_max_s` is retrain max."""
    return re.sub("_(s|bytes|hz)$", "", name).replace("_", " ")


def written(name: str, value: Any) -> str:
    """A field's value as a person reads it, with the unit that its name ends in."""
    if isinstance(value, str) or value is None:
        return without_password(value) if value else "-"
    if is_dataclass(value) and "__str__" in vars(type(value)):
        return str(value)
    if is_dataclass(value):
        return ", ".join(f"{part} {said}" for part, said in rows_of(value))
    if isinstance(value, Mapping):
        return ", ".join(f"{part} {written(part, each)}" for part, each in value.items() if each != 0) or "none"
    if isinstance(value, list | tuple):
        titles = PLACES.get(name, ("",) * len(value))
        return ", ".join(f"{title} {written(name, each)}".strip() for title, each in zip(titles, value, strict=True))
    if isinstance(value, bool):
        return "yes" if value else "no"
    if math.isnan(value):
        return "-"
    for ending, write in UNITS.items():
        if name.endswith(ending):
            return write(value)
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:,.4g}"


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
    """A size as a person writes it: 812 bytes, 296.0 kB, 1.4 MB."""
    from rich.filesize import decimal

    return decimal(int(n_bytes))


PLACES = {"prices": ("check", "escape", "false reject")}  # of a field that is a tuple: what stands at each place
UNITS: dict[str, Callable[[float], str]] = {  # by the ending of a field's name
    **dict.fromkeys(("_s", "seconds", "budget"), duration),
    **dict.fromkeys(("_time", "last_seen"), when),
    **dict.fromkeys(("share", "rate", "tolerance"), percent),
    "_bytes": size,
    "_hz": lambda hertz: f"{hertz:g} Hz",
}


def certificate_record(certificate: "Certificate") -> dict[str, Any]:
    """A certificate as JSON has it: its numbers, and what they say in words."""
    said = {name: getattr(certificate, name) for name in ("kept", "sentence", "sentence_on_rejects")}
    return asdict(certificate) | said


@contextmanager
def progress(label: str, total: int | None) -> Iterator[Callable[[int], None]]:
    """A bar on stderr that goes when done, none beside JSON; the function it gives advances it by so many.

    total : None where how many there are is not known.
    """
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
    """A bar whose next step ends the work with EndAskedError where Ctrl-C or SIGTERM asked for that; a second at once."""
    asked, done = False, 0
    ending = [each for each in signal.Signals if each.name in ("SIGINT", "SIGTERM", "SIGBREAK")]
    before = {number: signal.getsignal(number) for number in ending}

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        signal.signal(number, before[signal.Signals(number)])

    with progress(label, total) as advance:

        def count(n: int) -> None:
            nonlocal done
            done += n
            advance(n)
            if asked:
                raise EndAskedError(done)

        for number in before:
            signal.signal(number, ask)
        try:
            yield count
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def end_interrupted(*lines: str) -> NoReturn:
    """Say on stderr what was kept, and end with exit code 130."""
    for line in lines:
        click.echo(without_password(line), err=True)
    click.get_current_context().exit(INTERRUPTED)
