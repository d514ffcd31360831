"""Hides from dengine's modules what Windows lacks, in a process and those that it starts, by
PYTHONPATH.

Libraries keep this system. There is an `msvcrt`, whose `locking` fails as Windows' does.
"""

import builtins
import errno
import fcntl
import os
import signal
import types
from typing import Any

MODULES = ("fcntl", "uvloop", "resource", "termios", "tty", "pty", "pwd", "grp", "syslog", "msvcrt")
HIDDEN = {
    "os": (
        "fdatasync posix_fallocate posix_fadvise register_at_fork memfd_create pread "
        "pwrite preadv pwritev O_NOFOLLOW O_CLOEXEC O_DIRECTORY O_NONBLOCK O_SYNC O_DSYNC "
        "getuid geteuid getgid getegid getgroups setuid setgid nice getpriority sysconf "
        "sched_getaffinity sched_setaffinity fork forkpty killpg setsid getsid getpgid "
        "fchmod fchown chown lockf statvfs fstatvfs mkfifo mknod uname getloadavg wait3 "
        "wait4 sendfile"
    ),
    "signal": (
        "SIGHUP SIGQUIT SIGUSR1 SIGUSR2 SIGALRM SIGPIPE SIGSTOP SIGCONT SIGTSTP SIGKILL "
        "SIGCHLD SIG_BLOCK SIG_SETMASK SIG_UNBLOCK pthread_sigmask pthread_kill sigwait "
        "sigpending sigtimedwait alarm setitimer getitimer siginterrupt pause"
    ),
}
ORIGINAL = builtins.__import__


def locking(descriptor: int, mode: int, n_bytes: int) -> None:
    assert (mode, n_bytes, os.lseek(descriptor, 0, os.SEEK_CUR)) == (2, 1, 2**31 - 2)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OSError(errno.EACCES, os.strerror(errno.EACCES)) from None


def without(module: types.ModuleType, names: str) -> types.ModuleType:
    """A module that lacks names."""
    created, hidden = types.ModuleType(module.__name__), set(names.split())
    created.__dict__.update(
        {name: value for name, value in vars(module).items() if name not in hidden}
    )
    return created


SEEN = {"os": without(os, HIDDEN["os"]), "signal": without(signal, HIDDEN["signal"])}
SEEN["msvcrt"] = types.ModuleType("msvcrt")
SEEN["msvcrt"].__dict__.update(LK_NBLCK=2, locking=locking)


def import_hidden(
    name: str, globals_: Any = None, locals_: Any = None, fromlist: Any = (), level: int = 0
) -> Any:
    ours = str((globals_ or {}).get("__name__", "")).split(".")[0] == "dengine"
    if ours and level == 0 and name in SEEN:
        return SEEN[name]
    if ours and level == 0 and name in MODULES:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    return ORIGINAL(name, globals_, locals_, fromlist, level)


builtins.__import__ = import_hidden
