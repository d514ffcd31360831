"""The files that a description names, and their content."""

import fnmatch
import gzip
import re
import zlib
from collections.abc import Sequence
from pathlib import Path

from ...errors import DataError, instead
from ..description import FOLDER_FILE, Description
from ..table import UnreadableError

GZIP = ".gz"


def natural_key(text: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts numbers in texts by their size: run_2 before run_10."""
    pieces = re.split(r"(\d+)", text)
    return [(1, int(p), "") if p.isdecimal() and p.isascii() else (0, 0, p) for p in pieces if p]


def find_files(root: Path, description: Description) -> list[tuple[Path, str]]:
    """Return the files of a description below a folder, each with its path as seen from there.

    They are in the order of their names, with numbers by their size. Of a single file, that file.
    Raises DataError if there is none.
    """
    if root.is_file():
        return [(root, root.name)]
    sources = (description.label, *description.check, description.windows)
    exclude = [*description.exclude, *(source.listing for source in sources), FOLDER_FILE]
    found = {
        path.relative_to(root).as_posix(): path
        for pattern in description.files
        for path in root.glob(pattern)
        if path.is_file()
    }
    names = [
        name for name in found if not any(fnmatch.fnmatchcase(name, other) for other in exclude)
    ]
    names.sort(key=lambda name: (natural_key(name.rpartition("/")[2]), natural_key(name)))
    if not names:
        patterns = ", ".join(description.files)
        do = f"is it the description of another folder? See `dengine data {root}`"
        raise DataError(f"Expected files {patterns} in {root}, found none; {do}.")
    return [(found[name], name) for name in names]


def read_file(path: Path) -> bytes:
    """Return the content of a file, unpacked if it is gzipped.

    Raises UnreadableError if it cannot be read, or changed while it was read.
    """
    reasons: Sequence[type[Exception]] = (OSError, EOFError, zlib.error)
    with instead(UnreadableError, f"Cannot read {path.name}", *reasons):
        before = path.stat()
        content = path.read_bytes()
        after = path.stat()
        if path.suffix.lower() == GZIP:
            content = gzip.decompress(content)
    if (before.st_mtime_ns, before.st_size) != (after.st_mtime_ns, after.st_size):
        raise UnreadableError("Expected a file that stays, it changed while it was read")
    return content
