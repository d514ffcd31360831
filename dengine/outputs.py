"""Files that are written for a user: whole or not at all, and never over something else.

An output replaces only an earlier output of the same kind, which is recognised by its content, or with `force` any regular
file but a database. It never goes to a folder, a device or a link. It is written to a file of a random name, made for it
alone in the same folder, synced to the disk, and renamed: a killed or failed write leaves what was there as it was.
"""

from __future__ import annotations

import csv
import os
import re
import secrets
import stat
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO

from .errors import OutputError

LARGEST = 2 * 2**30  # bytes of a file that is looked through to recognise it; ONNX files are smaller by their format
DATABASES = (b"SQLite format 3\0", b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")  # a store, and what it has yet to take in
SUM = re.compile(rb"[0-9a-f]{64}( [ *][^\n]*)?\n?")
UNREADABLE = (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError, RuntimeError, csv.Error)


@dataclass(frozen=True)
class Kind:
    """A kind of output: what it is called, and whether a file is one, by its content."""

    name: str
    fits: Callable[[BinaryIO], bool]


def check_output(path: str | os.PathLike[str], kind: Kind, force: bool = False) -> None:
    """OutputError where a file of this kind must not be written: before the work whose result it is to hold."""
    target = Path(path)
    with _told(target):
        try:
            found = os.lstat(target)
        except FileNotFoundError:
            return
        what = _no_file(found.st_mode)
        if what:
            raise OutputError(f"Expected a file to write, {target} is a {what}; name another one.")
        if found.st_size and (_is_database(target) or not (force or _is(target, kind))):
            raise OutputError(_refusal(target, kind))


def write_output(
    path: str | os.PathLike[str], content: bytes, kind: Kind, force: bool = False, *, make_folder: bool = False
) -> Path:
    """Write a file whole or not at all; returns its path. OutputError as `check_output`, and for what the disk says.

    make_folder : make its folder if need be.
    """
    target = Path(path)
    with _told(target):
        if make_folder:
            target.parent.mkdir(parents=True, exist_ok=True)
        check_output(target, kind, force)
        _replace(target, content)
    return target


def _no_file(mode: int) -> str:
    """What stands there instead of a regular file; "" for one."""
    kinds = ((stat.S_ISREG, ""), (stat.S_ISLNK, "link"), (stat.S_ISDIR, "folder"), (stat.S_ISFIFO, "pipe"))
    return next((what for is_one, what in kinds if is_one(mode)), "device")


def _is_database(target: Path) -> bool:
    with target.open("rb") as file:
        return file.read(16).startswith(DATABASES)


def _is(target: Path, kind: Kind) -> bool:
    with target.open("rb") as file, suppress(*UNREADABLE):
        return kind.fits(file)
    return False


def _refusal(target: Path, kind: Kind) -> str:
    if _is_database(target):
        return f"{target} is a database, as a store is, and was left as it was; name another file for the {kind.name}."
    return (
        f"{target} is no {kind.name} of dengine's, and was left as it was; name another file, or replace it with --force "
        "(force=True)."
    )


def _replace(target: Path, content: bytes) -> None:
    """Put a new file in the place of a name; what was there stays until all of it is on the disk."""
    partial = target.with_name(f".dengine-{secrets.token_hex(8)}.partial")
    number = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)  # exclusively: no planted link is followed
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)
    _sync_folder(target.parent)


def _sync_folder(folder: Path) -> None:
    """Keep the new name through a loss of power, where the system can."""
    with suppress(OSError):  # Windows opens no folders, some network drives sync none
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


@contextmanager
def _told(target: Path) -> Iterator[None]:
    """What the system says, as an OutputError that says what to do."""
    try:
        yield
    except (OSError, ValueError) as error:  # the latter for a name with a NUL
        said = getattr(error, "strerror", None) or error
        raise OutputError(
            f"Cannot write {target}: {said}; choose a folder that exists, is writable and has room."
        ) from error


# What an earlier output is recognised by.


def table_of(columns: Iterable[str]) -> Kind:
    """CSV whose header shares half of these columns or more: an earlier version may have had others."""
    wanted = set(columns)

    def fits(file: BinaryIO) -> bool:
        header = next(csv.reader(TextIOWrapper(file, "utf-8", newline="")), [])
        return 2 * len(wanted & set(header)) >= len(wanted)

    return Kind("table with these columns", fits)


def _holds(ending: str) -> Callable[[BinaryIO], bool]:
    """Whether a zip archive has a member of this ending."""

    def fits(file: BinaryIO) -> bool:
        with zipfile.ZipFile(file) as archive:
            return any(name.endswith(ending) for name in archive.namelist())

    return fits


def _is_onnx(file: BinaryIO) -> bool:
    size = os.fstat(file.fileno()).st_size
    return file.read(1) == b"\x08" and size <= LARGEST and b"dengine.json" in file.read()


def _is_sums(file: BinaryIO) -> bool:
    lines = file.read(2**16).splitlines(keepends=True)
    return bool(lines) and all(SUM.fullmatch(line) for line in lines)


def _is_picture(file: BinaryIO) -> bool:
    """Whether Matplotlib drew it: a PNG says so at its beginning, a PDF or an SVG within."""
    head = file.read(4096)
    drawn = head.startswith((b"\x89PNG\r\n\x1a\n", b"%PDF-", b"<?xml"))
    return drawn and b"matplotlib" in (head + (b"" if head[:1] == b"\x89" else file.read(LARGEST))).lower()


TORCHSCRIPT = Kind("TorchScript export", _holds("/extra/dengine.json"))
ONNX = Kind("ONNX export", _is_onnx)
SUMS = Kind("file of SHA-256 sums", _is_sums)
TRACES = Kind("file of simulated traces", _holds("simulated.npy"))
PICTURE = Kind("picture", _is_picture)
TABLES = Kind("page of tables", lambda file: file.read(13) == b"## Guarantee ")
