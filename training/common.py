"""Helpers of the scripts in this folder: options, a stopwatch, tables on the screen and as CSV."""

import argparse
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from dengine import Dataset
from dengine.cli.output import format_value, heading
from dengine.errors import DengineError
from dengine.experiments.tables import write_csv
from dengine.traces import as_traces

POLICY = {"alpha": 0.1, "lower_bound": 0.9}


def parse_seeds(text: str) -> range:
    """Parse '100:130' as the seeds 100 to 129.

    Raises ValueError or ArgumentTypeError for other text; argparse turns both into a message.
    """
    first, last = map(int, text.split(":"))
    if not 0 <= first < last:
        expected = "first:last with 0 <= first < last, as 100:130"
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text}")
    return range(first, last)


OPTIONS: dict[str, tuple[Any, str]] = {
    "data": (str, "a bundled set, a folder of recordings, or an .npz file with X and y"),
    "part": (str, "name of the array of parts' numbers in the file"),
    "samples": (int, "use the first so many samples of each trace; all by default"),
    "recipe": (str, "a recipe's name or TOML file, or module:Class"),
    "alpha": (float, "error level of the interval"),
    "lower_bound": (float, "the paper's LB"),
    "seeds": (parse_seeds, "first:last, without last; one replay for each"),
    "cycles": (int, "of a replay, at most as many as there are traces"),
    "n_jobs": (int, "replays at a time; -1: one for each core; times are right with 1 only"),
    "keep": (Path, "folder of finished replays"),
    "folder": (Path, "where the stores are made; a temporary folder by default"),
    "out": (Path, "folder for the tables and pictures"),
}


def options(description: str | None, **defaults: Any) -> argparse.ArgumentParser:
    """Return a parser with the `OPTIONS` that `defaults` names, each with the default given."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, default in defaults.items():
        kind, text = OPTIONS[name]
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=default, help=text)
    return parser


@contextmanager
def message_for_errors() -> Iterator[None]:
    """Context manager that ends the program with the message of an error of dengine."""
    try:
        yield
    except DengineError as error:
        raise SystemExit(f"Error: {error}") from error


def wall_time(call: Callable[..., Any], *arguments: Any) -> tuple[float, Any]:
    """Call a function; return the seconds that it took, and its result."""
    begin = time.perf_counter()
    result = call(*arguments)
    return time.perf_counter() - begin, result


def quantiles(seconds: Sequence[float] | np.ndarray) -> dict[str, Any]:
    """Return the number of times, their median, 99th percentile and worst; NaN without times."""
    values = np.quantile(seconds, [0.5, 0.99, 1.0]).tolist() if len(seconds) else [math.nan] * 3
    return {"n": len(seconds)} | dict(zip(("p50_s", "p99_s", "worst_s"), values, strict=True))


def print_table(
    rows: Sequence[Mapping[str, Any]], title: str, path: Path | None = None, width: int = 124
) -> None:
    """Print rows, one at least, as a table; write them as CSV where a path is given.

    A file that is there is replaced. The end of a column's name is its unit: _s, _bytes, _share.
    """
    if path is not None:
        write_csv(pd.DataFrame(rows), path, force=True)
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for name, value in rows[0].items():
        table.add_column(heading(name), justify="left" if isinstance(value, str) else "right")
    for row in rows:
        table.add_row(*(format_value(name, value) for name, value in row.items()))
    Console(width=width).print(table)


def noisy(data: Dataset, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw n recorded traces and add noise of 0.2 units: traces (n, C, T) and labels (n,)."""
    rows = rng.integers(len(data), size=n)
    X = as_traces(data.X[rows])
    return X + rng.normal(0.0, 0.2, X.shape).astype(np.float32), data.y[rows]
