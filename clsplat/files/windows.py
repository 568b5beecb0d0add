"""Calls of Windows for which Python has no function: processes and memory. Only Windows runs them.

Structures and numbers are those of Microsoft's documentation of processthreadsapi.h, psapi.h and sysinfoapi.h.
"""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

_SYNCHRONIZE = 0x00100000  # right to wait for a process
_TIMED_OUT = 0x102  # result of WaitForSingleObject for a process that runs
_ACCESS_DENIED = 5  # error of OpenProcess for a process of somebody else
_HANDLE, _DWORD = ctypes.c_void_p, ctypes.c_uint32


class ProcessMemory(ctypes.Structure):
    """PROCESS_MEMORY_COUNTERS of psapi.h."""

    _fields_ = [
        ("cb", _DWORD),
        ("PageFaultCount", _DWORD),
        ("PeakWorkingSetSize", ctypes.c_size_t),
        ("WorkingSetSize", ctypes.c_size_t),
        ("QuotaPeakPagedPoolUsage", ctypes.c_size_t),
        ("QuotaPagedPoolUsage", ctypes.c_size_t),
        ("QuotaPeakNonPagedPoolUsage", ctypes.c_size_t),
        ("QuotaNonPagedPoolUsage", ctypes.c_size_t),
        ("PagefileUsage", ctypes.c_size_t),
        ("PeakPagefileUsage", ctypes.c_size_t),
    ]


class MachineMemory(ctypes.Structure):
    """MEMORYSTATUSEX of sysinfoapi.h."""

    _fields_ = [
        ("dwLength", _DWORD),
        ("dwMemoryLoad", _DWORD),
        ("ullTotalPhys", ctypes.c_uint64),
        ("ullAvailPhys", ctypes.c_uint64),
        ("ullTotalPageFile", ctypes.c_uint64),
        ("ullAvailPageFile", ctypes.c_uint64),
        ("ullTotalVirtual", ctypes.c_uint64),
        ("ullAvailVirtual", ctypes.c_uint64),
        ("ullAvailExtendedVirtual", ctypes.c_uint64),
    ]


def is_running(process: int) -> bool:
    """Return whether a process runs. `os.kill(process, 0)`, which asks this elsewhere, ends it on Windows."""
    if not 0 < process < 1 << 32:
        return False
    kernel = _kernel()
    handle = kernel.OpenProcess(_SYNCHRONIZE, 0, process)
    if not handle:
        return bool(_last_error() == _ACCESS_DENIED)
    try:
        return bool(kernel.WaitForSingleObject(handle, 0) == _TIMED_OUT)
    finally:
        kernel.CloseHandle(handle)


def peak_bytes() -> int:
    """Return the peak memory of this process; 0 if Windows does not report it."""
    kernel, counters = _kernel(), ProcessMemory()
    counters.cb = ctypes.sizeof(counters)
    known = kernel.K32GetProcessMemoryInfo(kernel.GetCurrentProcess(), ctypes.byref(counters), counters.cb)
    return int(counters.PeakWorkingSetSize) if known else 0


def available_bytes() -> int | None:
    """Return the free memory of the machine; None if Windows does not report it."""
    status = MachineMemory()
    status.dwLength = ctypes.sizeof(status)
    return int(status.ullAvailPhys) if _kernel().GlobalMemoryStatusEx(ctypes.byref(status)) else None


@cache
def _kernel() -> Any:
    """Return kernel32 with the types of its functions: a handle is as wide as a pointer, and the usual int is not."""
    library: Any = ctypes  # its stubs have WinDLL on Windows only
    kernel = library.WinDLL("kernel32", use_last_error=True)
    for name, result, arguments in (
        ("OpenProcess", _HANDLE, (_DWORD, ctypes.c_int, _DWORD)),
        ("WaitForSingleObject", _DWORD, (_HANDLE, _DWORD)),
        ("CloseHandle", ctypes.c_int, (_HANDLE,)),
        ("GetCurrentProcess", _HANDLE, ()),
        ("K32GetProcessMemoryInfo", ctypes.c_int, (_HANDLE, ctypes.POINTER(ProcessMemory), _DWORD)),
        ("GlobalMemoryStatusEx", ctypes.c_int, (ctypes.POINTER(MachineMemory),)),
    ):
        function = getattr(kernel, name)
        function.restype, function.argtypes = result, arguments
    return kernel


def _last_error() -> int:
    library: Any = ctypes
    return int(library.get_last_error())
