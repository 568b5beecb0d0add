"""Memory of the machine: how much is free, and how to give some back."""

from __future__ import annotations

import ctypes
import sys


def available_bytes() -> int:
    """Return the free memory of the machine on Linux; on other systems a number that never limits."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 1 << 62


def give_back_free_memory() -> None:
    """Give memory that the process has freed back to the system; no effect outside Linux with glibc.

    Threads that decode photos have heaps of their own. What they free would stay with them.
    """
    if sys.platform != "linux":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
