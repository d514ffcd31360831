"""Files: written whole or not at all and never over what is there; NumPy archives from anywhere, read safely."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import secrets
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DataError, OutputError

MOST = 8 * 2**30  # bytes
NPY: Any = np.lib.format  # untyped
HEADERS = {(1, 0): NPY.read_array_header_1_0, (2, 0): NPY.read_array_header_2_0}
# All that zipfile, zlib, lzma and NumPy were seen to raise on damaged files.
UNREADABLE: tuple[type[Exception], ...] = (
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    OverflowError,
    MemoryError,
)
UNREADABLE += (RuntimeError, SyntaxError, zipfile.BadZipFile, zlib.error, tokenize.TokenError)
DATABASES = (b"SQLite format 3\0", b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")  # a store, and its write-ahead log
NO_FILES = {stat.S_IFLNK: "link", stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe"}
MANIFEST = "manifest.json"


def must_fit(size: float, what: object, limit: int | None = None) -> None:
    """DataError for more bytes of arrays than `limit`; None: 8 GB, or half of the machine's memory where that is less."""
    most = MOST if limit is None else limit
    with suppress(AttributeError, ValueError, OSError):  # of a system that does not tell
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        most = min(MOST, memory // 2) if limit is None and memory > 0 else most
    if size > most:
        raise DataError(
            f"Expected at most {_size(most)} of arrays in {what}, got {_size(size)}; split it, or read it where there is "
            "more memory."
        )


@contextmanager
def reading(
    what: object, kind: str, package: str = "", extra: str = "", also: tuple[type[Exception], ...] = ()
) -> Iterator[None]:
    """DataError for whatever a library raises on a file that is damaged, or is not of its kind, and where it is missing.

    package, extra : what reads such files, and the extra of dengine that installs it.  also : other errors of its own.
    """
    if package and find_spec(package) is None:
        raise DataError(f'Expected {package} for {kind}, it is not installed: pip install "dengine[{extra}]".')
    try:
        yield
    except DataError:
        raise
    except (*UNREADABLE, *also) as error:
        said = " ".join(str(error)[:200].split()) or type(error).__name__
        raise DataError(f"Cannot read {what} as {kind}: {said}.") from error


def _size(n_bytes: float) -> str:
    return f"{n_bytes / 2**30:.1f} GB" if n_bytes >= 2**29 else f"{n_bytes / 2**20:.1f} MB"


def read_archive(
    source: str | os.PathLike[str] | bytes,
    names: Collection[str] | None = None,
    *,
    name: str = "",
    limit: int | None = None,
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of an .npz by name, and the names of all that it holds.

    source : a file, or its content.  names : of the arrays that are wanted; None: all.  name : for errors.
    limit : bytes that the wanted arrays may take together; None: as `must_fit`.
    DataError for what is no archive, is damaged, holds Python objects, or claims too much: nothing is unpacked then.
    """
    called = name or (f"{len(source)} bytes" if isinstance(source, bytes) else os.fspath(source))
    with (
        reading(called, "an .npz file of plain arrays"),
        zipfile.ZipFile(io.BytesIO(source) if isinstance(source, bytes) else Path(source)) as archive,
    ):
        members = {each.filename.removesuffix(".npy"): each for each in archive.infolist()}
        wanted = {key: each for key, each in members.items() if names is None or key in names}
        must_fit(sum(each.file_size for each in wanted.values()), called, limit)
        for member in wanted.values():
            with archive.open(member) as file:
                _check_header(file, member)
        return {key: _read(archive, member) for key, member in wanted.items()}, list(members)


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


def is_database(path: Path) -> bool:
    """Whether a regular file begins as a store does."""
    with path.open("rb") as file:
        return file.read(16).startswith(DATABASES)


def check_output(path: str | os.PathLike[str], force: bool = False) -> None:
    """OutputError where a file must not be written: ask before the work whose result it is to hold.

    A path that exists is refused without `force`; a database, folder, link, pipe or device always.
    """
    target = Path(path)
    with _told(target):
        try:
            mode = os.lstat(target).st_mode
        except FileNotFoundError:
            return
        if not stat.S_ISREG(mode):
            what = NO_FILES.get(stat.S_IFMT(mode), "device")
            raise OutputError(f"Expected a file to write, {target} is a {what}; name another one.")
        if is_database(target):
            raise OutputError(f"{target} is a database, as a store is, and was left as it was; name another file.")
        if not force:
            raise OutputError(f"{target} exists, and was left as it was; name another file, or replace it with --force.")


def write_output(path: str | os.PathLike[str], content: bytes, force: bool = False, *, make_folder: bool = False) -> Path:
    """Write a file whole or not at all; returns its path. OutputError as `check_output`, and for what the disk says.

    It is written under a random name in the same folder, synced, and renamed.  make_folder : make its folder if need be.
    """
    target = Path(path)
    with _told(target):
        if make_folder:
            target.parent.mkdir(parents=True, exist_ok=True)
        check_output(target, force)
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
        with suppress(OSError):  # Windows opens no folders, some network drives sync none
            folder = os.open(target.parent, os.O_RDONLY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
    return target


def write_manifest(folder: Path, files: Iterable[Path], force: bool = False) -> Path:
    """Write or go on with `manifest.json`, last: the SHA-256 of each output in a folder. What it lists is whole."""
    target, sums = folder / MANIFEST, {}
    with suppress(OSError, ValueError, TypeError, KeyError):  # there is none, or it is somebody else's
        sums, force = dict(json.loads(target.read_bytes())["sha256"]), True
    sums |= {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
    return write_output(target, (json.dumps({"sha256": sums}, indent=2) + "\n").encode(), force)


@contextmanager
def _told(target: Path) -> Iterator[None]:
    """What the system says, as an OutputError that says what to do."""
    try:
        yield
    except (OSError, ValueError) as error:  # the latter for a name with a NUL
        said = getattr(error, "strerror", None) or error
        do = "choose a folder that exists, is writable and has room"
        raise OutputError(f"Cannot write {target}: {said}; {do}.") from error
