"""The files that a description names, their content, and how errors in them become faults."""

import gzip
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ...errors import DataError, instead, listed, shortened
from ..dataset import Fault, Faults
from ..description import Description, Strings
from ..table import UnreadableError

# The format of files with each suffix; `.gz` may stand behind it.
SUFFIXES = {
    ".csv": "text",
    ".tsv": "text",
    ".txt": "text",
    ".dat": "text",
    ".asc": "text",
    ".lvm": "text",
    ".log": "text",
    ".prn": "text",
    ".json": "json",
    ".jsonl": "jsonl",
    ".ndjson": "jsonl",
    ".parquet": "parquet",
    ".npz": "npz",
    ".ts": "ts",
    ".mcap": "mcap",
    ".db3": "mcap",
}
# Formats of recordings that other packages read.
FOREIGN = (
    ".npy",
    ".mat",
    ".h5",
    ".hdf5",
    ".tdms",
    ".bag",
    ".xlsx",
    ".xls",
    ".feather",
    ".pkl",
    ".arff",
)
# Hidden files, pages for people, and descriptions.
NO_RECORDING = re.compile(
    r"(?i)(^|/)(\.|(readme|licen[sc]e|notes|changelog)(\.[^/]*)?$|recordings\.toml$)"
)
DATE = re.compile(r"(?<![0-9])([0-9]{1,2})\.([0-9]{1,2})\.([0-9]{4})(?![0-9])")
HALF_DAY = re.compile(r"\d ?[aApP][mM](?![A-Za-z])")
# Dates and times that are in another order than the numbers in them.
UNSORTED = re.compile(
    rf"(?<!\d)(?<!\d[-./])\d\d?([-./ ])(\d\d?|[A-Za-z]{{3,9}})\1\d{{2,4}}(?!\d)|{HALF_DAY.pattern}"
)
BAD = (ValueError, NotImplementedError, OSError, IndexError)  # what an unusable pattern raises


def natural_key(text: str) -> list[Any]:
    """Return a key that sorts runs of digits in texts by their size: run_2 before run_10.

    Decimals and signs do not count: 0.5 is before 0.25. Dates like 31.12.2025 are sorted by year,
    month and day.
    """
    pieces: list[Any] = re.split(r"([0-9]+)", DATE.sub(r"\3.\2.\1", text))
    pieces[1::2] = map(int, pieces[1::2])  # texts and numbers take turns
    return pieces


def file_key(path: str) -> tuple[list[Any], list[Any]]:
    """Return the key by which files are in the order `name`: by file name, then by path."""
    return natural_key(Path(path).name), natural_key(path)


def is_unsorted(word: str) -> bool:
    """Return whether a word has a date, or a time with AM or PM, that `sort_key` does not order.

    A date is three parts between equal marks (`-`, `.`, `/` or a blank), the first of one or two
    digits, like 31.12.25 or 24-01-15. 31.12.2025 does not count, since `natural_key` reads it with
    the year first.
    """
    return UNSORTED.search(DATE.sub("", word)) is not None


def sort_key(word: str) -> list[Any]:
    """Return a key that sorts decimal numbers by their value, and other words as `natural_key`.

    Numbers with a sign or a negative exponent, like -5 and 1e-3, are such other words.
    """
    is_decimal = re.fullmatch(r"[0-9]+(\.[0-9]*)?([eE]\+?[0-9]+)?", word)
    return ["", float(word), ""] if is_decimal else natural_key(word)


def as_source(source: Any) -> Any:
    """Return a path as a `Path`, and an object with `columns`, like a DataFrame, as it is.

    Raises DataError for anything else, for a path at which there is nothing, and for one that the
    system refuses.
    """
    if hasattr(source, "columns"):
        return source
    with instead(
        DataError,
        f"Expected a file, a folder or a DataFrame, got {shortened(str(source))}",
        TypeError,
        *BAD,
        do='bundled sets, like "insertion", and arrays take no description, and no key of one',
    ):
        Path(source).stat()
        return Path(source)


def match_files(root: Path, patterns: Strings) -> set[str]:
    """Return the files below a folder that any pattern matches, as paths relative to the folder.

    The paths have `/` between folders. Folders that match are left out; `**` at the end stands for
    all files below. Hidden files (`.x.csv`) match, too, and a pattern with `..` finds files outside
    the folder. Raises DataError for a malformed pattern.
    """
    with instead(
        DataError, f"Expected patterns below a folder in files and exclude, got {patterns}", *BAD
    ):
        return {
            path.relative_to(root).as_posix()
            for pattern in patterns
            for path in root.glob(f"{pattern}/*" if pattern.endswith("**") else pattern)
            if path.is_file()
        }


def suffix_of(name: str) -> str:
    """Return the suffix of a file with its dot, in small letters; "" if there is none.

    Of `x.csv.gz` it is `.csv`.
    """
    return Path(name.lower().removesuffix(".gz")).suffix


def names_in(root: Path, patterns: Strings) -> Strings:
    """Return a folder's files that may be recordings: relative paths in the order of `file_key`.

    Left out are hidden files and folders, files outside of the folder (`../x.csv`),
    `recordings.toml`, and files like README or LICENSE. Without `patterns`, only files with a
    suffix of recordings, like .csv or .json, are returned. If `root` is a file, the list has only
    its name. If nothing is there, the list is empty. Raises DataError for a malformed pattern,
    unless `root` is a file.

    patterns : patterns of the files, like `*.csv`; empty: all files below the folder with such a
    suffix.
    """
    if root.is_file():
        return [root.name]
    return sorted(
        (
            name
            for name in match_files(root, patterns or ["**/*"])
            if not NO_RECORDING.search(name)
            and (patterns or suffix_of(name) in (*SUFFIXES, *FOREIGN))
        ),
        key=file_key,
    )


def find_files(root: Path, description: Description) -> list[str]:
    """Return the files that a description names, as paths relative to the folder.

    The description says how recordings are read; its `files` and `exclude` are patterns like
    `*.csv`. If `files` is empty, all files with a suffix of recordings, like .csv, are meant. The
    result is sorted by file name, run_2 before run_10. Hidden files and others that are no
    recordings (`names_in`), files that list labels or parts, if the description names them, and
    files that match a pattern in `exclude` are left out. If `root` is a file, its name alone is
    returned, whatever the description says. Raises DataError if no file is left, or for a malformed
    pattern.
    """
    if root.is_file():
        return [root.name]
    aside = match_files(root, description.exclude) | description.listings
    names = [name for name in names_in(root, description.files) if name not in aside]
    if not names:
        raise DataError(
            f"Expected files {', '.join(description.files)} in {root}, found none; is it the "
            f"description of another folder? See `dengine data {root}`."
        )
    return names


def unread_note(source: Any, description: Description) -> str:
    """Return a note that lists files of a folder that the description does not mention; "" if none.

    They have a suffix of recordings, like .csv or .json (`names_in`), match neither `files` nor
    `exclude`, and are no listing that the description names. There are none in a source that is no
    folder. Raises DataError for a malformed pattern.
    """
    if not isinstance(source, Path) or source.is_file():
        return ""
    known = match_files(source, (*description.files, *description.exclude)) | description.listings
    others = [name for name in names_in(source, ()) if name not in known]
    return f"Not read, for neither files nor exclude has them: {listed(others)}." if others else ""


def read_file(path: Path) -> bytes:
    """Return the content of a file, unpacked if its name ends in `.gz`.

    Raises UnreadableError if it cannot be read or unpacked, or changed while it was read.
    """
    with instead(UnreadableError, f"Cannot read {path.name}", *BAD, EOFError, zlib.error):
        before = path.stat()
        content = path.read_bytes()
        after = path.stat()
        if path.suffix.lower() == ".gz":
            content = gzip.decompress(content)
    if (before.st_mtime_ns, before.st_size) != (after.st_mtime_ns, after.st_size):
        raise UnreadableError("Expected a file that stays, it changed while it was read")
    return content


def first_of(faults: Faults) -> str:
    """Return the first fault for the end of a message, behind a blank; "" if there is none."""
    return f" {faults[0]}." if faults else ""


@contextmanager
def caught(faults: Faults, source: str) -> Iterator[None]:
    """Context manager that turns a DataError in its block into a fault, and suppresses it.

    The fault, which says why a file or recording is left out, is appended to `faults`. It has
    `source` as the file or part, and the line and column of the error, if it has them. All other
    exceptions pass.
    """
    try:
        yield
    except DataError as error:
        faults.append(
            Fault(
                source,
                getattr(error, "line", 0),
                str(error).rstrip("."),
                getattr(error, "column", ""),
            )
        )
