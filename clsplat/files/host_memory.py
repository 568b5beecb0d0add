"""Memory of the machine and of this process: how much is free, how much was used, and how to give some back."""

from __future__ import annotations

import contextlib
import ctypes
import sys

from . import windows

_UNLIMITED = 1 << 62


def available_bytes() -> int:
    """Return the free memory of the machine on Linux and Windows; on other systems a number that never limits."""
    if sys.platform == "win32":
        free = windows.available_bytes()
        return _UNLIMITED if free is None else free
    stated = _of_table("/proc/meminfo", "MemAvailable:")
    return _UNLIMITED if stated is None else stated


def peak_bytes() -> int:
    """Return the peak memory of this process; 0 if the system does not report it."""
    if sys.platform == "win32":
        return windows.peak_bytes()
    # The system call would also count the memory of the program that has started this one.
    if sys.platform == "linux" and (stated := _of_table("/proc/self/status", "VmHWM:")) is not None:
        return stated
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024  # bytes on macOS, KiB on Linux


def _of_table(path: str, name: str) -> int | None:
    """Return the bytes in the line of a table of the Linux kernel that begins with a name; None without one."""
    try:
        with open(path, encoding="ascii", errors="replace") as file:
            return next((int(line.split()[1]) * 1024 for line in file if line.startswith(name)), None)
    except OSError:
        return None


def give_back_free_memory() -> None:
    """Give memory that the process has freed back to the system; no effect outside Linux with glibc.

    Threads that decode photos have heaps of their own. What they free would stay with them.
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def limit_address_space(nbytes: int) -> None:
    """Let later allocations of this process fail above a size [bytes], where the system can do that.

    Windows cannot, and macOS ignores it.
    """
    try:
        import resource
    except ImportError:  # Windows
        return
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    soft = nbytes if hard == resource.RLIM_INFINITY else min(nbytes, hard)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
