"""Files: outputs, written as a whole or not at all, and NumPy archives, read safely. Data
sets, exports, backups, tables and figures are read and written by them.

`output_file` and `write_output` replace a file only with `force`, and never a database;
`new_folder` refuses a folder that is not empty. `read_archive` unpacks no Python objects, and no
more bytes than the machine can hold. `read_key` reads the secret key of exports or ledgers.
"""

import io
import json
import os
import secrets
import stat
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DataError, DengineError, OutputError, expect, instead

FilePath = str | os.PathLike[str]
MAX_BYTES = 8 * 2**30  # of arrays
# All that zipfile, zlib, lzma and NumPy were seen to raise on damaged files.
UNREADABLE: tuple[type[Exception], ...] = (
    *(OSError, EOFError, ValueError, TypeError, LookupError, OverflowError, MemoryError),
    *(RuntimeError, SyntaxError, zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)
# First bytes of a store, and of its write-ahead log.
DATABASES = (b"SQLite format 3\0", b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")
SPECIAL_FILES = {stat.S_IFLNK: "link", stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe"}
ZIP = b"PK"
NUMPY = b"\x93NUMPY"
MIN_KEY_BYTES = 16


def read_key(path: FilePath, error: type[DengineError]) -> bytes:
    """Return the secret key in a file, without line breaks at its end.

    The key signs exported files, or is that of a store's ledger (a chain of checksums over its
    rows). Raises `error` if the file cannot be read, or the key has fewer than 16 bytes.
    """
    with instead(
        error,
        f"The key's file {path} cannot be read",
        OSError,
        do="dengine export --make-key writes one",
    ):
        secret = Path(path).read_bytes().rstrip(b"\r\n")
    expect(
        len(secret) >= MIN_KEY_BYTES,
        f"a key of {MIN_KEY_BYTES} bytes or more in {path}",
        len(secret),
        "use dengine export --make-key",
        error,
    )
    return secret


def check_size(size: float, source: object) -> None:
    """Raise DataError if arrays would need too much memory.

    The limit is 8 GiB, or half of the machine's memory if that is known and less.

    Parameters
    ----------
    size : float
        Bytes of all arrays.
    source : object
        The file or other source that holds the arrays, for the error.
    """
    limit = MAX_BYTES
    with suppress(AttributeError, ValueError, OSError):  # on systems without these figures
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if memory > 0:
            limit = min(limit, memory // 2)
    if size > limit:
        raise DataError(
            f"Expected at most {limit / 2**20:,.0f} MB of arrays in {source}, got "
            f"{size / 2**20:,.0f} MB; split it, or read it where there is more memory."
        )


def read_errors(
    source: object, kind: str, package: str = "", extra: str = ""
) -> AbstractContextManager[None]:
    """Return a context manager that raises DataError instead of what a library raises on bad files.

    It catches OSError, ValueError, MemoryError and others that damaged files were seen to raise; a
    DataError passes unchanged.

    Parameters
    ----------
    source : object
        What is read, for the error.
    kind : str
        What it should be, for the error: "a Parquet file".
    package : str
        Python package that reads such files. If it is not installed, this call itself raises
        DataError, before there is a context manager. "": no package is needed.
    extra : str
        Extra of dengine that installs the package, for that error: `pip install "dengine[extra]"`.
    """
    if package and find_spec(package) is None:
        raise DataError(
            f'Expected {package} for {kind}, it is not installed: pip install "dengine[{extra}]".'
        )
    return instead(DataError, f"Cannot read {source} as {kind}", *UNREADABLE)


def read_archive(
    source: FilePath | bytes, names: Collection[str] | None = None, *, name: str = ""
) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """Read arrays of an .npz archive.

    Parameters
    ----------
    source : path or bytes
        The file, or its content.
    names : collection of str, optional
        Arrays to read; a name that the archive does not have is passed over. None: all.
    name : str
        What to call the archive in errors; by default its path, or its number of bytes.

    Returns
    -------
    arrays : dict of str to array
        By name, without the ending .npy of its member, in the order of the archive.
    all_names : list of str
        Names of all arrays in the archive, read or not, in its order.

    Raises
    ------
    DataError
        If the file cannot be read, is no archive or is damaged; damage within an array that is not
        read is not noticed. Also if an array that is to be read holds Python objects, which are
        never unpacked, or if the arrays that are to be read need too much memory (see
        `check_size`).
    """
    title = name or (f"{len(source)} bytes" if isinstance(source, bytes) else os.fspath(source))
    with (
        read_errors(title, "an .npz file of plain arrays"),
        io.BytesIO(source) if isinstance(source, bytes) else Path(source).open("rb") as file,
    ):
        head = file.read(len(NUMPY))
        if head == NUMPY:
            raise ValueError("it is a single array")
        if not head.startswith(ZIP):
            raise ValueError("it is none" if head else "it is empty")
        if not zipfile.is_zipfile(file):
            raise ValueError("the file is cut off")
        file.seek(0)
        archive = np.load(file, allow_pickle=False)
        sizes = {
            member.filename.removesuffix(".npy"): member.file_size
            for member in archive.zip.infolist()
        }
        wanted = [key for key in sizes if names is None or key in names]
        check_size(sum(sizes[key] for key in wanted), title)
        # NumPy gives the bytes of a member that is no array.
        return {key: np.asarray(archive[key]) for key in wanted}, list(sizes)


def is_database(path: Path) -> bool:
    """Return whether a file begins like a SQLite database or its write-ahead log.

    It must be a regular file. An OSError of opening or reading it passes unchanged.
    """
    with path.open("rb") as file:
        return file.read(16).startswith(DATABASES)


def toml_value(value: Any) -> str:
    """Return a text, a number, a boolean, or a list or tuple of these, as TOML writes it.

    NumPy's numbers are numbers, too. NaN and infinity become nan and inf. Another object is written
    as a quoted text, its `str`. So is None, as "None": TOML has no None, and the caller must
    replace it.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float):
        return repr(value)  # JSON has no infinity
    # JSON's texts and booleans are TOML's, but for DEL, which TOML wants escaped.
    text = json.dumps(value if isinstance(value, str | int) else str(value), ensure_ascii=False)
    return text.replace("\x7f", "\\u007f")


def check_output(path: FilePath, force: bool = False) -> None:
    """Raise OutputError if a file must not be written.

    Call it before the work whose result the file is to hold. A file that does not exist yet is
    accepted, even if its folder does not, and nothing is created.

    Parameters
    ----------
    path : path
        File to write. A database, folder, link, pipe or device is always refused, and so is an
        existing file that cannot be read, or a path that the system refuses.
    force : bool, default False
        Whether another file that exists may be replaced.
    """
    target = Path(path)
    with _write_errors(target, ValueError):  # which a name with a NUL raises
        try:
            mode = os.lstat(target).st_mode
        except FileNotFoundError:
            return
        if not stat.S_ISREG(mode):
            raise OutputError(
                f"Expected a file to write, {target} is a "
                f"{SPECIAL_FILES.get(stat.S_IFMT(mode), 'device')}; name another one."
            )
        unchanged = "was left as it was; name another file"
        if is_database(target):
            raise OutputError(f"{target} is a database, as a store is, and {unchanged}.")
        if not force:
            raise OutputError(f"{target} exists, and {unchanged}, or replace it with --force.")


def write_output(
    path: FilePath, content: bytes, force: bool = False, *, make_folder: bool = False
) -> Path:
    """Write a file as a whole or not at all, and return its path.

    `force`, `make_folder` and the errors are those of `output_file`.
    """
    with output_file(path, force, make_folder=make_folder) as partial:
        partial.write_bytes(content)
    return Path(path)


@contextmanager
def output_file(
    path: FilePath, force: bool = False, *, make_folder: bool = False
) -> Iterator[Path]:
    """Context manager that gives the path of an empty file to write.

    If the block ends well, the file is forced to disk (fsync) and renamed to `path`, and its folder
    is forced to disk if the system can do that; if the block raises, the file is deleted and `path`
    stays as it was. Whether `path` may be replaced is checked before the block, and not again.

    Parameters
    ----------
    path : path
        File that is to be there at the end.
    force : bool, default False
        Whether a file that exists may be replaced. A database, folder, link, pipe or device never
        is; see `check_output`.
    make_folder : bool, default False
        Whether the folder of `path` is made, with its parents, if it does not exist. The folder
        stays even if the block raises.

    Yields
    ------
    Path
        An empty file with a random name in the same folder.

    Raises
    ------
    OutputError
        If `check_output` refuses the path or the folder does not exist. Every other OSError becomes
        one as well, also an OSError that the block raises.
    """
    target = Path(path)
    check_output(target, force)
    with _write_errors(target):
        if make_folder:
            target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".dengine-{secrets.token_hex(8)}.partial")
        # Exclusively, so that no link that somebody put there is followed.
        partial.touch(exist_ok=False)
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


@contextmanager
def new_folder(path: FilePath) -> Iterator[Path]:
    """Context manager that makes a folder, or takes an empty one, and gives its path.

    Parents are made, too. Nothing is deleted at the end, even if the block raises. Raises
    OutputError if `path` is a file or a folder that is not empty, and in place of every OSError,
    also one that the block raises.
    """
    target = Path(path)
    with _write_errors(target):
        target.mkdir(parents=True, exist_ok=True)
        if any(target.iterdir()):
            raise OutputError(
                f"Expected a new or an empty folder, {target} holds something; name another folder."
            )
        yield target


def _write_errors(target: Path, *also: type[Exception]) -> AbstractContextManager[None]:
    """Return a context manager that raises OutputError in place of OSError or a class in `also`.

    The message says that `target` cannot be written, and advises to choose another folder or file.
    """
    return instead(
        OutputError,
        f"Cannot write {target}",
        OSError,
        *also,
        do=(
            "choose a folder that exists, is writable and has room, and a file that no program has "
            "open"
        ),
    )
