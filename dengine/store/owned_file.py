"""`OwnedFile`, a file that one process locks and reads and writes at offsets.

The journal is such a file. POSIX locks the file (`flock`) and reads and writes at an offset in one
call. Windows locks one byte far behind all content, so that others can read the rest, and sets the
offset first. Either lock ends with the process, however that ends, and a child process does not
inherit it.
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
    """Return this system's function that locks a descriptor, or raises BlockingIOError."""
    exclusive_now = 2 | 4  # LOCK_EX and LOCK_NB, of every system that has flock
    with suppress(ImportError):
        from fcntl import flock

        return lambda descriptor: flock(descriptor, exclusive_now)
    with suppress(ImportError):
        import msvcrt

        return _lock_of_windows(msvcrt)
    # For a Python that was built without either module.
    flock_of_c = ctypes.CDLL(None, use_errno=True).flock

    def lock(descriptor: int) -> None:
        if flock_of_c(descriptor, exclusive_now):
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    return lock


def _lock_of_windows(msvcrt: Any) -> Callable[[int], object]:
    """Return the function that locks a descriptor on Windows, and raises as `flock` does.

    Locking moves the descriptor's offset.
    """

    def lock(descriptor: int) -> None:
        """Lock one byte of the file; BlockingIOError if it is locked."""
        os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except PermissionError as error:  # as it says that the byte is locked
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from error

    return lock


LOCK = _lock_of_system()


def open_plain(path: Path, flags: int) -> int:
    """Open a file and return its descriptor; a new one is readable by its owner alone.

    OSError for a symbolic link.
    """
    no_follow = getattr(os, "O_NOFOLLOW", 0)
    binary = getattr(os, "O_BINARY", 0)  # or Windows writes \r\n for \n
    if not no_follow and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return os.open(path, flags | no_follow | binary, 0o600)


class OwnedFile:
    """An open file; it is created if need be.

    Parameters
    ----------
    path : Path
        A symbolic link is refused.
    owning : bool, default True
        Lock the file. False: only read it, whoever owns it.

    Raises
    ------
    BlockingIOError
        If another process, or another object of this one, owns it.
    OSError
        Whatever else the system reports.
    """

    def __init__(self, path: Path, owning: bool = True) -> None:
        self.path = path
        self._seeking = threading.Lock()
        self._fd = self._open_and_lock() if owning else open_plain(path, os.O_RDONLY)
        _OPEN.add(self)

    def _open_and_lock(self) -> int:
        """Open and lock the file, and again if another file is at its path by then.

        Return the descriptor.
        """
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
            os.close(self._fd)  # its owner deleted it before it was locked here: once more

    @property
    def closed(self) -> bool:
        """Whether the file was closed."""
        return self._fd < 0

    @property
    def size(self) -> int:
        """Size in bytes."""
        return os.fstat(self._fd).st_size

    def in_place(self) -> bool:
        """Return whether this open file is still the one at its path."""
        if os.name == "nt":  # there an open file cannot be deleted, moved or replaced
            return True
        try:
            return os.path.samestat(os.fstat(self._fd), self.path.lstat())
        except FileNotFoundError:
            return False

    def read(self, size: int, offset: int) -> bytes:
        """Return `size` bytes from an offset, or fewer at the end of the file."""
        if hasattr(os, "pread"):
            return os.pread(self._fd, size, offset)
        with self._seeking:
            os.lseek(self._fd, offset, os.SEEK_SET)
            return os.read(self._fd, size)

    def write(self, content: bytes | bytearray, offset: int) -> None:
        """Write all of the content at an offset, or raise an OSError."""
        if hasattr(os, "pwrite"):
            written = os.pwrite(self._fd, content, offset)
        else:
            with self._seeking:
                os.lseek(self._fd, offset, os.SEEK_SET)
                written = os.write(self._fd, content)
        if written < len(content):  # a full disk takes a part
            raise OSError(f"only {written} of {len(content)} bytes were written")

    def sync(self) -> None:
        """Return once what was written is on the disk."""
        getattr(os, "fdatasync", os.fsync)(self._fd)  # not every system has the quicker one

    def truncate(self, size: int) -> None:
        """Set the size in bytes: cut the file off, or extend it."""
        os.ftruncate(self._fd, size)

    def reserve(self, size: int) -> None:
        """Reserve disk space for `size` bytes in total, and sync.

        Without space the file stays as it is.
        """
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
        """Close the file, which unlocks it; a second call does nothing."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


_OPEN: weakref.WeakSet[OwnedFile] = weakref.WeakSet()


def _close_all() -> None:
    """Close every open file, in a child process after a fork."""
    """Close every open file, in a child process after a fork."""
    for file in list(_OPEN):
        file.close()


if hasattr(os, "register_at_fork"):  # a child that outlives its engine would keep the cell
    os.register_at_fork(after_in_child=_close_all)
