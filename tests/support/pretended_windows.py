"""What Windows lacks is taken away, and what it has instead is made from parts of this system.

`lock_as_windows` is for tests. A child process begins with `become_windows`, before it imports clsplat.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import pytest

SIGNALS = ("ALRM", "CHLD", "CONT", "HUP", "KILL", "PIPE", "QUIT", "STOP", "TSTP", "USR1", "USR2", "WINCH")
OS_NAMES = (
    *("chown", "fork", "getegid", "geteuid", "getgid", "getloadavg", "getpgid", "getuid", "killpg", "mkfifo", "nice"),
    *("O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "sched_getaffinity", "setsid", "statvfs", "sysconf"),
)
MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")
_open, _kill = os.open, os.kill


def fake_msvcrt() -> Any:
    """Return a module msvcrt whose locks keep other processes out. They are those of POSIX."""
    import fcntl

    def locking(descriptor: int, mode: int, size: int) -> None:
        assert (mode, size) == (2, 1)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise OSError(errno.EACCES, "Permission denied") from None

    return SimpleNamespace(LK_NBLCK=2, locking=locking)


def open_no_folder(path: Any, flags: int, *rest: Any, **options: Any) -> int:
    """Do what os.open does on Windows: it refuses folders."""
    if os.path.isdir(path):
        raise PermissionError(errno.EACCES, "Permission denied", path)
    return _open(path, flags, *rest, **options)


def lock_as_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clsplat's locks be those of Windows during a test."""
    from clsplat.files import lock

    monkeypatch.setattr(lock, "fcntl", None)
    monkeypatch.setattr(lock, "msvcrt", fake_msvcrt())
    monkeypatch.setattr(os, "open", open_no_folder)


def become_windows() -> None:
    """Take from this process the modules, functions and signals that Windows lacks. Other threads must not run.

    Libraries that ask once for the system and then use what it has are imported before.
    """
    with suppress(ImportError):
        import platformdirs  # noqa: F401
    sys.modules["msvcrt"] = fake_msvcrt()
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for name in OS_NAMES:
        if hasattr(os, name):
            delattr(os, name)
    for name in SIGNALS:
        if hasattr(signal, f"SIG{name}"):
            delattr(signal, f"SIG{name}")
    del signal.pthread_kill
    os.open, os.kill = open_no_folder, _kill_none


def _kill_none(process: int, number: int) -> None:
    """Fail the test where os.kill would end a process of Windows."""
    assert number, "os.kill(process, 0) ends the process on Windows"
    _kill(process, number)
