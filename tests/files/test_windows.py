"""Calls of Windows: what clsplat asks of kernel32, and what it makes of the answers. kernel32 is pretended."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from clsplat.files import atomic, host_memory, windows
from clsplat.files.lock import folder_lock

GONE, DENIED = 87, 5  # errors of OpenProcess


class Kernel:
    """kernel32 with one process: `handle` is 0 if it cannot be opened, `state` is what waiting for it returns."""

    def __init__(self, handle: int = 7, state: int = 0x102) -> None:
        self.handle, self.state = handle, state
        self.open: list[int] = []

    def OpenProcess(self, access: int, inherits: int, process: int) -> int:
        assert (access, inherits) == (0x100000, 0)
        self.open += [self.handle] * bool(self.handle)
        return self.handle

    def WaitForSingleObject(self, handle: int, milliseconds: int) -> int:
        assert (handle, milliseconds) == (self.handle, 0)
        return self.state

    def CloseHandle(self, handle: int) -> int:
        self.open.remove(handle)
        return 1

    def GetCurrentProcess(self) -> int:
        return -1

    def K32GetProcessMemoryInfo(self, process: int, counters: Any, size: int) -> int:
        assert (process, size) == (-1, counters._obj.cb)
        counters._obj.PeakWorkingSetSize = 3 << 30
        return self.state

    def GlobalMemoryStatusEx(self, status: Any) -> int:
        assert status._obj.dwLength == ctypes.sizeof(windows.MachineMemory)
        status._obj.ullAvailPhys = 5 << 30
        return self.state


@pytest.fixture
def pretend(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Kernel]:
    """pretend(handle, state, error): be on Windows, with such a kernel32."""

    def run(handle: int = 7, state: int = 0x102, error: int = 0) -> Kernel:
        kernel = Kernel(handle, state)
        monkeypatch.setattr(sys, "platform", "win32")
        monkeypatch.setattr(windows, "_kernel", lambda: kernel)
        monkeypatch.setattr(windows, "_last_error", lambda: error)
        return kernel

    return run


@pytest.mark.parametrize(
    ("handle", "state", "error", "runs"),
    [(7, 0x102, 0, True), (7, 0, 0, False), (0, 0, GONE, False), (0, 0, DENIED, True)],
)
def test_a_process_runs_until_waiting_for_it_ends(
    pretend: Callable[..., Kernel], handle: int, state: int, error: int, runs: bool
) -> None:
    kernel = pretend(handle, state, error)
    assert atomic._is_running(os.getpid()) is runs
    assert kernel.open == []
    assert not atomic._is_running(1 << 40), "no process has this number"


def test_leftovers_of_ended_processes_are_removed(
    pretend: Callable[..., Kernel], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """os.kill with signal 0, which asks elsewhere, would end the process."""
    monkeypatch.setattr(os, "kill", lambda *_: pytest.fail("a process would be ended"))
    (tmp_path / ".model.ply.123.tmp.ply").touch()
    kernel = pretend()
    with folder_lock(tmp_path):
        assert list(tmp_path.iterdir())
    kernel.state = 0
    with folder_lock(tmp_path):
        assert not list(tmp_path.iterdir())


def test_memory_comes_from_windows(pretend: Callable[..., Kernel], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "resource", None)
    kernel = pretend()
    assert host_memory.peak_bytes() == 3 << 30
    assert host_memory.available_bytes() == 5 << 30
    kernel.state = 0
    assert host_memory.peak_bytes() == 0, "not reported"
    assert host_memory.available_bytes() == 1 << 62, "not reported: no limit"


@pytest.mark.parametrize(("platform", "unit"), [("linux", 1024), ("darwin", 1)])
def test_the_peak_is_in_bytes_on_every_system(monkeypatch: pytest.MonkeyPatch, platform: str, unit: int) -> None:
    monkeypatch.setattr(host_memory, "_of_table", lambda *_: None)  # a system that does not show its tables
    usage = SimpleNamespace(RUSAGE_SELF=0, getrusage=lambda _: SimpleNamespace(ru_maxrss=1000))
    monkeypatch.setitem(sys.modules, "resource", usage)
    monkeypatch.setattr(sys, "platform", platform)
    assert host_memory.peak_bytes() == 1000 * unit


def test_structures_have_the_sizes_of_the_headers() -> None:
    assert ctypes.sizeof(windows.ProcessMemory) == 72
    assert ctypes.sizeof(windows.MachineMemory) == 64


@pytest.fixture
def fresh_kernel() -> Iterator[None]:
    windows._kernel.cache_clear()
    yield
    windows._kernel.cache_clear()


@pytest.mark.usefixtures("fresh_kernel")
def test_handles_are_as_wide_as_pointers(monkeypatch: pytest.MonkeyPatch) -> None:
    """ctypes cuts results and arguments without a type to 32 bits."""
    functions: dict[str, SimpleNamespace] = {}

    class Library:
        def __init__(self, name: str, use_last_error: bool) -> None:
            assert (name, use_last_error) == ("kernel32", True)

        def __getattr__(self, name: str) -> SimpleNamespace:
            return functions.setdefault(name, SimpleNamespace())

    monkeypatch.setattr(ctypes, "WinDLL", Library, raising=False)
    windows._kernel()
    called = {name for name in vars(Kernel) if not name.startswith("_")}
    assert set(functions) == called
    assert functions["OpenProcess"].restype is functions["GetCurrentProcess"].restype is ctypes.c_void_p
    for name in ("WaitForSingleObject", "CloseHandle", "K32GetProcessMemoryInfo"):
        assert functions[name].argtypes[0] is ctypes.c_void_p


def test_a_file_that_is_open_elsewhere_is_replaced_soon(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Windows refuses to replace it with PermissionError."""
    target, refusals, waited = tmp_path / "model.ply", [2], []
    target.write_bytes(b"old")
    replace = os.replace

    def refuse(source: Path, to: Path) -> None:
        if refusals[0]:
            refusals[0] -= 1
            raise PermissionError(13, "The process cannot access the file")
        replace(source, to)

    monkeypatch.setattr(os, "replace", refuse)
    monkeypatch.setattr(atomic, "_WAITS", atomic.WINDOWS_WAITS)
    monkeypatch.setattr(atomic.time, "sleep", waited.append)
    with atomic.atomic_writer(target) as stream:
        stream.write(b"new")
    assert target.read_bytes() == b"new"
    assert len(waited) == 2
    refusals[0] = 100
    with (
        pytest.raises(atomic.OutputError, match=r"cannot be written \(The process"),
        atomic.atomic_writer(target) as stream,
    ):
        stream.write(b"newer")
    assert 0.5 < sum(waited) < 2
    assert [path.name for path in tmp_path.iterdir()] == ["model.ply"]
    assert target.read_bytes() == b"new"
