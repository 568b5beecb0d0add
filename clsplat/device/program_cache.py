"""Programs as a driver compiled them, kept in the user's cache folder: for drivers that keep none themselves.

One file a program, named by everything it depends on; written whole (atomic.py) and checked against its own digest
when read, so that processes need no lock between them and a damaged file is only a miss. pyopencl's cache has a lock
that a killed process leaves behind, and ends the program with a KeyError at a damaged file (2026.1).
"""

from __future__ import annotations

import hashlib
import os
import platform
from contextlib import suppress
from functools import cache
from pathlib import Path

from ..errors import OutputError
from ..files.atomic import atomic_writer
from .device import DeviceInfo

# These keep what they build from source by themselves, PoCL also each kernel by its group size.
SELF_CACHING = ("Portable Computing Language", "NVIDIA CUDA")
MAX_BYTES = 256 << 20  # of all files; beyond it those unused for longest go

_DIGEST = hashlib.sha256().digest_size


def cache_folder() -> Path:
    """clsplat's folder in the user's cache (it need not exist); RuntimeError where the user has no home."""
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    return Path(home) / "clsplat"


def binary_path(info: DeviceInfo, text: str, options: list[str]) -> Path | None:
    """The file of a program's binary, whether it exists or not; None when the driver, or no folder, keeps it."""
    if info.platform in SELF_CACHING:
        return None
    place = (
        info.platform,
        info.platform_version,
        info.name,
        info.version,
        info.driver,
        _cpu_features() if info.type == "CPU" else "",
    )
    digest = hashlib.sha256("\0".join((*place, *options, text)).encode()).hexdigest()
    try:
        return cache_folder() / "programs" / f"{digest[:40]}.bin"
    except RuntimeError:
        return None


def load_binary(path: Path) -> bytes | None:
    """What `store_binary` wrote; None when there is nothing, or nothing whole."""
    try:
        stored = path.read_bytes()
    except OSError:
        return None
    binary = stored[_DIGEST:]
    if hashlib.sha256(binary).digest() != stored[:_DIGEST]:
        return None
    with suppress(OSError):
        os.utime(path)  # used just now
    return binary


def store_binary(path: Path, binary: bytes) -> None:
    """Keep a binary; a folder that cannot be written only costs the build again."""
    with suppress(OutputError, OSError):
        with atomic_writer(path) as stream:
            stream.write(hashlib.sha256(binary).digest() + binary)
        _trim(path.parent)


def _trim(folder: Path) -> None:
    """Remove the files unused for longest until the rest fit MAX_BYTES. Others may be removing the same ones."""
    held = []
    for file in folder.iterdir():
        with suppress(FileNotFoundError):
            status = file.stat()
            held.append((status.st_mtime, status.st_size, file))
    excess = sum(size for _, size, _ in held) - MAX_BYTES
    for _, size, file in sorted(held):
        if excess <= 0:
            return
        file.unlink(missing_ok=True)
        excess -= size


@cache
def _cpu_features() -> str:
    """What tells this processor from others of the same name, for machines that share a home folder."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith(("flags", "Features")):
                return line
    return platform.processor()
