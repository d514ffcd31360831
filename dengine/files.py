"""Files: written whole or not at all and never over what is there; NumPy archives from anywhere, read safely."""

import hashlib
import io
import json
import os
import secrets
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DataError, DengineError, OutputError, expect, instead

MOST = 8 * 2**30  # bytes
# All that zipfile, zlib, lzma and NumPy were seen to raise on damaged files.
UNREADABLE: tuple[type[Exception], ...] = (OSError, EOFError, ValueError, TypeError, LookupError, OverflowError)
UNREADABLE += (MemoryError, RuntimeError, SyntaxError, zipfile.BadZipFile, zlib.error, tokenize.TokenError)
DATABASES = (b"SQLite format 3\0", b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")  # a store, and its write-ahead log
NO_FILES = {stat.S_IFLNK: "link", stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe"}
MANIFEST = "manifest.json"
SHORTEST_KEY = 16  # bytes


def read_key(path: str | os.PathLike[str], error: type[DengineError]) -> bytes:
    """The secret in a key's file; an error of this kind for what cannot be read, or is too short to be one."""
    with instead(error, f"The key's file {path} cannot be read", OSError, do="dengine export --make-key writes one"):
        secret = Path(path).read_bytes().rstrip(b"\r\n")
    wanted = f"a key of {SHORTEST_KEY} bytes or more in {path}"
    expect(len(secret) >= SHORTEST_KEY, wanted, len(secret), "use dengine export --make-key", error)
    return secret


def must_fit(size: float, what: object) -> None:
    """DataError for more bytes of arrays than `MOST`, or than half of the machine's memory where that is less."""
    most = MOST
    with suppress(AttributeError, ValueError, OSError):  # of a system that does not tell
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        most = min(MOST, memory // 2) if memory > 0 else MOST
    if size > most:
        do = "split it, or read it where there is more memory"
        raise DataError(f"Expected at most {_size(most)} of arrays in {what}, got {_size(size)}; {do}.")


def reading(
    what: object, kind: str, package: str = "", extra: str = "", also: tuple[type[Exception], ...] = ()
) -> AbstractContextManager[None]:
    """DataError for whatever a library raises on a file that is damaged, or is not of its kind, and where it is missing.

    package, extra : what reads such files, and the extra of dengine that installs it.  also : other errors of its own.
    """
    if package and find_spec(package) is None:
        raise DataError(f'Expected {package} for {kind}, it is not installed: pip install "dengine[{extra}]".')
    return instead(DataError, f"Cannot read {what} as {kind}", *UNREADABLE, *also)


def _size(n_bytes: float) -> str:
    return f"{n_bytes / 2**30:.1f} GB" if n_bytes >= 2**29 else f"{n_bytes / 2**20:.1f} MB"


def read_archive(
    source: str | os.PathLike[str] | bytes, names: Collection[str] | None = None, *, name: str = ""
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of an .npz by name, and the names of all that it holds.

    source : a file, or its content.  names : of the arrays that are wanted; None: all.  name : for errors.
    DataError for what is no archive, is damaged, holds Python objects, or claims too much: nothing is unpacked then.
    """
    called = name or (f"{len(source)} bytes" if isinstance(source, bytes) else os.fspath(source))
    content = io.BytesIO(source) if isinstance(source, bytes) else source
    with reading(called, "an .npz file of plain arrays"), np.load(content, allow_pickle=False) as archive:
        if not isinstance(archive, np.lib.npyio.NpzFile):
            raise ValueError("it is a single array")
        members = {each.filename.removesuffix(".npy"): each.file_size for each in archive.zip.infolist()}
        wanted = [key for key in members if names is None or key in names]
        must_fit(sum(members[key] for key in wanted), called)
        return {key: np.asarray(archive[key]) for key in wanted}, list(members)


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
    """Write a file whole or not at all, as `output_file`; returns its path."""
    with output_file(path, force, make_folder=make_folder) as partial:
        partial.write_bytes(content)
    return Path(path)


@contextmanager
def output_file(path: str | os.PathLike[str], force: bool = False, *, make_folder: bool = False) -> Iterator[Path]:
    """Give an empty file to write to, which is synced and renamed to this path when the block has ended well.

    It has a random name in the same folder. OutputError as `check_output`, and for what the disk says.
    make_folder : make its folder if need be.
    """
    target = Path(path)
    with _told(target):
        if make_folder:
            target.parent.mkdir(parents=True, exist_ok=True)
        check_output(target, force)
        partial = target.with_name(f".dengine-{secrets.token_hex(8)}.partial")
        os.close(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))  # exclusively: no planted link is followed
        try:
            yield partial
            with partial.open("r+b") as file:
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


def write_manifest(folder: Path, files: Iterable[Path], force: bool = False) -> Path:
    """Write or go on with `manifest.json`, last: the SHA-256 of each output in a folder. What it lists is whole."""
    target, sums = folder / MANIFEST, {}
    with suppress(OSError, ValueError, TypeError, KeyError):  # there is none, or it is somebody else's
        sums, force = dict(json.loads(target.read_bytes())["sha256"]), True
    sums |= {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
    return write_output(target, (json.dumps({"sha256": sums}, indent=2) + "\n").encode(), force)


def _told(target: Path) -> AbstractContextManager[None]:
    """What the system says, as an OutputError that says what to do."""
    do = "choose a folder that exists, is writable and has room, and a file that no program has open"
    return instead(OutputError, f"Cannot write {target}", OSError, ValueError, do=do)  # the latter for a name with a NUL
