"""Files that are written for a user: whole or not at all, and never over something else.

An output replaces only an earlier output of the same kind, which is recognised by its content, or with `force` any regular
file but a database. It never goes to a folder, a device or a link. It is written to a file of a random name, made for it
alone in the same folder, synced to the disk, and renamed: a killed or failed write leaves what was there as it was.

NumPy's .npz archives from anywhere: plain arrays, no more of them than memory holds, and nothing that runs.

What an archive claims is checked before any of it is unpacked: a file of 12 MB can claim, and give, 12 GB.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
import secrets
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from .errors import DataError, OutputError

MOST = 8 * 2**30  # bytes
SHARE = 0.5  # of the machine's memory
NPY: Any = np.lib.format  # untyped
HEADERS = {(1, 0): NPY.read_array_header_1_0, (2, 0): NPY.read_array_header_2_0}
UNREADABLE = (  # all that zipfile, zlib, lzma and NumPy were seen to raise on damaged files
    *(
        OSError,
        EOFError,
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        OverflowError,
        MemoryError,
        RuntimeError,
        SyntaxError,
    ),
    *(
        zipfile.BadZipFile,
        zlib.error,
        tokenize.TokenError,
    ),  # NotImplementedError, of a compression nobody knows, is a RuntimeError
)


def memory_limit() -> int:
    """Bytes that the arrays of one file may take, unpacked: 8 GB, or half of the machine's memory where that is less."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # a system that does not tell
        return MOST
    return min(MOST, int(SHARE * memory)) if memory > 0 else MOST


def must_fit(size: float, what: object, limit: int | None = None) -> None:
    """DataError where so many bytes of arrays are more than `limit`, by default `memory_limit()`."""
    most = memory_limit() if limit is None else limit
    if size > most:
        raise DataError(
            f"Expected at most {_size(most)} of arrays in {what}, got {_size(size)}; split it, or read it where there is "
            "more memory."
        )


def read_archive(
    source: str | os.PathLike[str] | bytes,
    names: Collection[str] | None = None,
    *,
    name: str = "",
    limit: int | None = None,
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of an .npz by name, and the names of all that it holds.

    source : a file, or its content.  names : of the arrays that are wanted; None: all. Others are not looked at.
    name : what to call it in an error.  limit : bytes that the wanted arrays may take together; None: `memory_limit()`.
    Raises DataError for what is no archive, is damaged, holds Python objects, or is too large; nothing is unpacked then.
    """
    called = name or (f"{len(source)} bytes" if isinstance(source, bytes) else os.fspath(source))
    try:
        with zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else Path(source)) as archive:
            members = {each.filename.removesuffix(".npy"): each for each in archive.infolist()}
            wanted = {key: each for key, each in members.items() if names is None or key in names}
            must_fit(sum(each.file_size for each in wanted.values()), called, limit)
            for member in wanted.values():
                with archive.open(member) as file:
                    _check_header(file, member)
            return {key: _read(archive, member) for key, member in wanted.items()}, list(members)
    except DataError:
        raise
    except UNREADABLE as error:
        raise DataError(f"Cannot read {called} as an .npz file of plain arrays: {str(error)[:200]}.") from error


def _check_header(file: Any, member: zipfile.ZipInfo) -> None:
    """ValueError where an array is said to be larger than its member: NumPy would take memory for it."""
    read = HEADERS.get(NPY.read_magic(file))
    if read is None:
        raise ValueError(f"{member.filename} has a header of an unknown version")
    shape, _, dtype = read(file)
    if dtype.hasobject:
        raise ValueError(f"{member.filename} holds Python objects, or something else")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != member.file_size - file.tell():
        raise ValueError(f"{member.filename} claims the shape {shape} of {dtype}, and has another size")


def _read(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    with archive.open(member) as file:
        values: NDArray[Any] = NPY.read_array(file, allow_pickle=False)
        if file.read(1):  # the last byte is where zipfile checks the sum
            raise ValueError(f"{member.filename} is longer than its array")
    return values


def _size(n_bytes: float) -> str:
    return f"{n_bytes / 2**30:.1f} GB" if n_bytes >= 2**29 else f"{n_bytes / 2**20:.1f} MB"


LARGEST = 2 * 2**30  # bytes of a file that is looked through to recognise it; ONNX files are smaller by their format
DATABASES = (b"SQLite format 3\0", b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")  # a store, and what it has yet to take in
SUM = re.compile(rb"[0-9a-f]{64}( [ *][^\n]*)?\n?")
UNREADABLE_OF_OUTPUTS = (zipfile.BadZipFile, ValueError, EOFError, NotImplementedError, RuntimeError, csv.Error)


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
    with target.open("rb") as file, suppress(*UNREADABLE_OF_OUTPUTS):
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
