"""A cache of compiled programs in the user's cache folder, for drivers that have no cache.

Each program has one file, whose name is a digest of everything that the program depends on. A file is written
atomically and holds its own digest. So processes need no lock, and a damaged file is only a cache miss. pyopencl's
cache has a lock that a killed process leaves behind, and fails with a KeyError at a damaged file (2026.1).
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
from .caches import user_cache
from .device import POCL, DeviceInfo

# Platforms whose drivers cache programs. PoCL also caches each kernel by its group size.
SELF_CACHING = (POCL, "NVIDIA CUDA")
MAX_BYTES = 256 << 20  # of all files; the files unused for longest are removed first

_DIGEST = hashlib.sha256().digest_size


def cache_folder() -> Path:
    """Return clsplat's folder in the user's cache, which may not exist; RuntimeError if the user has no home."""
    return user_cache() / "clsplat"


def binary_path(info: DeviceInfo, text: str, options: list[str]) -> Path | None:
    """Return the file for a program's binary. None if the driver has a cache, or if the user has no cache folder."""
    if info.platform in SELF_CACHING:
        return None
    identity = (
        info.platform,
        info.platform_version,
        info.name,
        info.version,
        info.driver,
        _cpu_features() if info.type == "CPU" else "",
    )
    digest = hashlib.sha256("\0".join((*identity, *options, text)).encode()).hexdigest()
    try:
        return cache_folder() / "programs" / f"{digest[:40]}.bin"
    except RuntimeError:
        return None


def load_binary(path: Path) -> bytes | None:
    """Return the binary that `store_binary` wrote; None if the file is missing or damaged."""
    try:
        stored = path.read_bytes()
    except OSError:
        return None
    binary = stored[_DIGEST:]
    if hashlib.sha256(binary).digest() != stored[:_DIGEST]:
        return None
    with suppress(OSError):
        os.utime(path)  # marks it as used
    return binary


def store_binary(path: Path, binary: bytes) -> None:
    """Store a binary. Without write access nothing is stored, and the program is built again next time."""
    with suppress(OutputError, OSError):
        with atomic_writer(path) as stream:
            stream.write(hashlib.sha256(binary).digest() + binary)
        _trim(path.parent)


def _trim(folder: Path) -> None:
    """Remove the files unused for longest until the rest fit MAX_BYTES. Other processes may remove the same files."""
    files = []
    for file in folder.iterdir():
        with suppress(FileNotFoundError):
            status = file.stat()
            files.append((status.st_mtime, status.st_size, file))
    excess = sum(size for _, size, _ in files) - MAX_BYTES
    for _, size, file in sorted(files):
        if excess <= 0:
            return
        file.unlink(missing_ok=True)
        excess -= size


@cache
def _cpu_features() -> str:
    """Return the features of this processor: machines that share a home folder may differ in them."""
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith(("flags", "Features")):
                return line
    return platform.processor()
