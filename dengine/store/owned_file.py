"""`OwnedFile`, a file that one process locks and reads and writes at offsets; the journal is such a
file. `open_plain` opens a file without following a symbolic link. In a child process, after a fork,
all owned files are closed.

POSIX locks the file (`flock`) and reads and writes at an offset in one call. Windows locks one byte
far behind all content, so that others can read the rest, and sets the offset first. Either lock
ends with the process, however that ends.
"""

import errno
import os
import threading
import weakref
from pathlib import Path
from typing import Any

LOCKED_BYTE = 2**31 - 2  # the last that the C library of Windows can lock


def _lock(descriptor: int) -> None:
    """Lock an open file, given by its descriptor, for this process, without waiting.

    Raise BlockingIOError if another descriptor has the lock, and the OSError of the system if it
    fails for another reason, for example because the file system has no locks. The lock ends when
    the file is closed or the process ends. It is an exclusive lock by `flock`. On Windows one byte
    far behind the content is locked, and the offset of the file is moved there.
    """
    try:
        import fcntl
    except ImportError:
        import msvcrt

        windows: Any = msvcrt  # of which a type checker on another system knows nothing
        os.lseek(descriptor, LOCKED_BYTE, os.SEEK_SET)
        try:
            windows.locking(descriptor, windows.LK_NBLCK, 1)
        except PermissionError as error:  # as it says that the byte is locked
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)) from error
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def open_plain(path: Path, flags: int) -> int:
    """Open a file with the flags of `os.open` in binary mode, and return its descriptor.

    A new file is readable and writable by its owner alone, but on Windows it has the rights that
    its folder gives. Raise OSError for a symbolic link, and if the system refuses.
    """
    no_follow = getattr(os, "O_NOFOLLOW", 0)
    binary = getattr(os, "O_BINARY", 0)  # or Windows writes \r\n for \n
    if not no_follow and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return os.open(path, flags | no_follow | binary, 0o600)


sync = getattr(os, "fdatasync", os.fsync)  # not every system has the quicker one


class OwnedFile:
    """An open file that one process owns; it is created, with its folder, if need be.

    Parameters
    ----------
    path : Path
        A symbolic link is refused.
    owning : bool
        Lock the file, and open it for writing. False: only read it, whoever owns it; it must exist.

    Raises
    ------
    BlockingIOError
        If another process, or another object of this one, owns it.
    OSError
        Whatever else the system reports.
    """

    def __init__(self, path: Path, owning: bool) -> None:
        self.path = path
        self._seeking = threading.Lock()
        if owning:
            self._open_and_lock()
        else:
            self._fd = open_plain(path, os.O_RDONLY)
        _OPEN.add(self)

    def _open_and_lock(self) -> None:
        """Create the file and its folder if need be, open and lock it.

        If the file was deleted or replaced before it was locked, this starts again. Raise
        BlockingIOError if it is locked already, and OSError for a symbolic link and whatever else
        the system refuses.
        """
        while True:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._fd = open_plain(self.path, os.O_RDWR | os.O_CREAT)
            try:
                _lock(self._fd)
                if self.in_place():
                    return
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
        """Return whether this open file is still the one at its path; on Windows always True.

        It is False if there is no file at the path. Raise OSError if the system refuses to look, or
        this file is closed.
        """
        if os.name == "nt":  # there an open file cannot be deleted, moved or replaced
            return True
        try:
            return os.path.samestat(os.fstat(self._fd), self.path.lstat())
        except FileNotFoundError:
            return False

    def read(self, size: int, offset: int) -> bytes:
        """Return `size` bytes from an offset in bytes, or fewer at the end of the file.

        Threads may call this at the same time. Raise OSError if the file is closed or cannot be
        read.
        """
        if hasattr(os, "pread"):
            return os.pread(self._fd, size, offset)
        with self._seeking:
            os.lseek(self._fd, offset, os.SEEK_SET)
            return os.read(self._fd, size)

    def write(self, content: bytes | bytearray, offset: int) -> None:
        """Write all of the content at an offset in bytes; nothing is synced.

        Raise OSError if the file is closed, the system refuses, or a full disk takes only a part,
        which stays in the file.
        """
        if hasattr(os, "pwrite"):
            written = os.pwrite(self._fd, content, offset)
        else:
            with self._seeking:
                os.lseek(self._fd, offset, os.SEEK_SET)
                written = os.write(self._fd, content)
        if written < len(content):  # a full disk takes a part
            raise OSError(f"only {written} of {len(content)} bytes were written")

    def sync(self) -> None:
        """Return once what was written is on the disk; raise OSError if the disk fails."""
        sync(self._fd)

    def truncate(self, size: int) -> None:
        """Set the size in bytes: cut the file off, or extend it; OSError if the system refuses."""
        os.ftruncate(self._fd, size)

    def reserve(self, size: int) -> None:
        """Reserve disk space for `size` bytes in total, and sync the file.

        The file becomes at least `size` bytes long, with zeros at its end. If the system cannot
        reserve the space, for example on a full disk, the file keeps its size and nothing is
        raised. OSError is raised only if the file is closed, the sync fails, or the file cannot be
        cut back to its size.
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
    """Close every open `OwnedFile`; it is called in a child process after a fork."""
    for file in list(_OPEN):
        file.close()


if hasattr(os, "register_at_fork"):  # a child that outlives its engine would keep the cell
    os.register_at_fork(after_in_child=_close_all)
