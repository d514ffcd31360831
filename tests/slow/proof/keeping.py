"""What the programs of the proof share: options, and finished work that is kept on disk.

>>> rows = play_kept(play, [(0, ""), (1, "")], source, Path("out/null"), jobs=2)
"""

import argparse
import hashlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from joblib import Memory, Parallel, delayed

import dengine

PROOF = Path(__file__).parent
PACKAGE = Path(dengine.__file__).parent
UNRELATED = ("cli", "serve", "export", "experiments")  # folders that decide nothing


def make_parser(description: str | None, out: str, kept: str) -> argparse.ArgumentParser:
    """Return a parser with the options --out, --docs and --jobs; `kept` says what --out holds."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path(out), help=kept)
    parser.add_argument("--docs", type=Path, help="folder for the table; by default --out")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    return parser


def source_files(folder: Path, unrelated: Collection[str] = UNRELATED) -> list[Path]:
    """Return the Python files below a folder that influence a result.

    No `__main__.py` does, nor a file or a folder whose name, without suffix, is in `unrelated`.
    """
    return [
        path
        for path in folder.rglob("*.py")
        if path.stem != "__main__" and not {path.stem, path.parent.name} & {*unrelated}
    ]


def digest_of(files: Iterable[Path]) -> str:
    """Return the SHA-256 of the contents of files, in the order of their paths, in hexadecimal."""
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def play(function: Callable[..., Any], arguments: tuple[Any, ...], source: str) -> Any:
    """Call a function; the result is kept under all three, so `source` tells versions apart."""
    return function(*arguments)


def play_kept(
    function: Callable[..., Any],
    calls: Sequence[tuple[Any, ...]],
    source: str,
    out: Path,
    jobs: int,
) -> Iterator[Any]:
    """Call a function with each tuple of arguments, and yield the results in order.

    What is kept in `out` for the same arguments and `source`, the digest of the code, is not
    computed again; each further result is kept as soon as it is there.
    """
    run = Memory(out, verbose=0).cache(play)
    parallel = Parallel(n_jobs=jobs, return_as="generator", batch_size=1)
    yield from parallel(delayed(run)(function, arguments, source) for arguments in calls)


def write_table(
    table: pd.DataFrame, folder: Path, name: str, float_format: str | None = None
) -> None:
    """Write a table as CSV into a folder, which is created."""
    folder.mkdir(parents=True, exist_ok=True)
    table.to_csv(folder / name, index=False, float_format=float_format)
