"""A file that one process owns, read and written at offsets; what Windows does otherwise is met here.

POSIX locks the file (`flock`) and reads and writes at an offset in one call. Windows locks one byte far behind
what is ever written, so that others read the rest, and needs the offset set first. Either lock ends with the
process, whatever ended it, and no child has it.
"""

import ctypes
import errno
import os
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

LOCKED_BYTE = 2**31 - 2  # the last that the C library of Windows can lock


def _lock_of_system() -> Callable[[int], object]:
    """Return what locks a descriptor at once, or raises a BlockingIOError where somebody has it."""
    exclusive_now = 2 | 4  # LOCK_EX and LOCK_NB, of every system that has flock
    with suppress(ImportError):
        from fcntl import flock

        return lambda descriptor: flock(descriptor, exclusive_now)
    with suppress(ImportError):
        import msvcrt

        return _lock_of_windows(msvcrt)
    flock_of_c = ctypes.CDLL(None, use_errno=True).flock  # of a Python that was built without either

    def lock(descriptor: int) -> None:
        if flock_of_c(descriptor, exclusive_now):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    return lock


def _lock_of_windows(msvcrt: Any) -> Callable[[int], object]:
    """Return what locks a descriptor by Windows, with a BlockingIOError as `flock` has it; it moves the offset."""

    def lock(descriptor: int) -> None:
        os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError as error:  # as it says that the byte is locked
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from error

    return lock


LOCK = _lock_of_system()


def open_plain(path: Path, flags: int) -> int:
    """Open a file, which is made for its owner alone; OSError for a link."""
    no_follow = getattr(os, "O_NOFOLLOW", 0)
    binary = getattr(os, "O_BINARY", 0)  # or Windows writes \r\n for \n
    if not no_follow and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return os.open(path, flags | no_follow | binary, 0o600)


class OwnedFile:
    """An open file, which is made if need be.

    Parameters
    ----------
    path : Path
        A link is refused.
    owning : bool, default True
        Whether to lock it; else it is only read, whoever owns it.

    Raises
    ------
    BlockingIOError
        Where another process, or another object of this one, owns it.
    OSError
        What the system says.
    """

    def __init__(self, path: Path, owning: bool = True) -> None:
        self.path = path
        self._seeking = threading.Lock()
        self._fd = self._open_and_lock() if owning else open_plain(path, os.O_RDONLY)
        _OPEN.add(self)

    def _open_and_lock(self) -> int:
        """Open and lock the file that is still at its path once the lock is held."""
        while True:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._fd = open_plain(self.path, os.O_RDWR | os.O_CREAT)
            try:
                LOCK(self._fd)
                if self.in_place():
                    return self._fd
            except BaseException:
                os.close(self._fd)
                raise
            os.close(self._fd)  # its owner went, and took the file along, before it was locked: once more

    @property
    def closed(self) -> bool:
        """Whether it was closed."""
        return self._fd < 0

    @property
    def size(self) -> int:
        """Bytes that it has."""
        return os.fstat(self._fd).st_size

    def in_place(self) -> bool:
        """Whether it is the file at its path."""
        if os.name == "nt":  # it lets nobody delete, move or replace a file that is open
            return True
        try:
            return os.path.samestat(os.fstat(self._fd), self.path.lstat())
        except FileNotFoundError:
            return False

    def read(self, size: int, offset: int) -> bytes:
        """Return so many bytes, or fewer at the end."""
        if hasattr(os, "pread"):
            return os.pread(self._fd, size, offset)
        with self._seeking:
            os.lseek(self._fd, offset, os.SEEK_SET)
            return os.read(self._fd, size)

    def write(self, content: bytes | bytearray, offset: int) -> None:
        """Write all of it, or raise an OSError."""
        if hasattr(os, "pwrite"):
            written = os.pwrite(self._fd, content, offset)
        else:
            with self._seeking:
                os.lseek(self._fd, offset, os.SEEK_SET)
                written = os.write(self._fd, content)
        if written < len(content):  # a disk that is full takes a part
            raise OSError(f"only {written} of {len(content)} bytes were written")

    def sync(self) -> None:
        """Return once what was written is on the disk."""
        getattr(os, "fdatasync", os.fsync)(self._fd)  # not every system has the quicker one

    def truncate(self, size: int) -> None:
        """Cut it off, or extend it."""
        os.ftruncate(self._fd, size)

    def reserve(self, size: int) -> None:
        """Have the disk keep room for so many bytes, and sync; without room it stays as it is."""
        before = self.size
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(self._fd, 0, size)
            else:
                self.write(bytes(max(size - before, 0)), before)
        except OSError:
            self.truncate(before)
        os.fsync(self._fd)

    def close(self) -> None:
        """Close it, which gives it free."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


_OPEN: weakref.WeakSet[OwnedFile] = weakref.WeakSet()


def _close_all() -> None:
    for file in list(_OPEN):
        file.close()


if hasattr(os, "register_at_fork"):  # a child that outlives its engine would keep the cell
    os.register_at_fork(after_in_child=_close_all)
