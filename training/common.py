"""The options that several scripts have, in one place."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

POLICY = {"alpha": 0.1, "lower_bound": 0.9}


def span(text: str) -> range:
    """'100:130' -> the seeds 100 to 129."""
    first, last = map(int, text.split(":"))
    if not 0 <= first < last:
        raise argparse.ArgumentTypeError(f"expected first:last with 0 <= first < last, as 100:130, got {text}")
    return range(first, last)


KNOWN: dict[str, tuple[Any, str]] = {
    "data": (str, "a bundled set, a folder of recordings, or an .npz file with X and y"),
    "samples": (int, "use the first so many samples of each trace; all by default"),
    "recipe": (str, "a recipe's name or TOML file, or module:Class"),
    "alpha": (float, "error level of the interval"),
    "lower_bound": (float, "the paper's LB"),
    "seeds": (span, "first:last, the last one left out; a replay each"),
    "cycles": (int, "of a replay, at most as many as there are traces"),
    "n_jobs": (int, "replays at a time; -1: one a core; times are honest with 1"),
    "keep": (Path, "folder of finished replays"),
    "folder": (Path, "where the stores are made; a temporary folder by default"),
    "out": (Path, "folder for the tables and pictures"),
}


def options(description: str | None, **defaults: Any) -> argparse.ArgumentParser:
    """A parser with these of the `KNOWN` options."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        kind, text = KNOWN[name]
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, default=default, help=text)
    return parser
