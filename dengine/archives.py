"""NumPy's .npz archives from anywhere: plain arrays, no more of them than memory holds, and nothing that runs.

What an archive claims is checked before any of it is unpacked: a file of 12 MB can claim, and give, 12 GB.
"""

from __future__ import annotations

import io
import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import DataError

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
