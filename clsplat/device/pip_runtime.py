"""Register Intel's CPU runtime with the OpenCL loader if pip installed it, because pip cannot.

The wheels `intel-opencl-rt` and `intel-cmplr-lib-rt` put their libraries into `<prefix>/lib`, where the dynamic linker
does not search. Their `.icd` file holds a path of Intel's build machine. This module loads the libraries that the
runtime needs. Then it writes an `.icd` file with the true path, next to copies of the system's, and shows the loader
this folder. Nothing has to remove the folder, so a process that is killed leaves nothing behind.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import sys
import tempfile
from pathlib import Path

from ..errors import DeviceError, Remedy
from .caches import user_cache

VENDORS_VARIABLE = "OCL_ICD_VENDORS"
SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
RUNTIME = "libintelocl.so"
_ICD = "clsplat-intel-cpu.icd"
# Libraries that libintelocl.so links against. Each stands after those that it needs.
_PRELOAD = ("libintlc.so.5", "libirng.so", "libimf.so", "libsvml.so", "libtbb.so.12")


def register_pip_runtime() -> bool:
    """Register the pip-installed runtime with this process's OpenCL loader; return whether it is registered.

    It must run after `ensure_caches` and before the loader's first use in the process; further calls cost nothing. It
    does nothing if the runtime is not installed, if the system has registered one, or if the user has set
    OCL_ICD_VENDORS.

    Raises
    ------
    DeviceError : the folder of the `.icd` files cannot be written.
    """
    library = Path(sys.prefix) / "lib" / RUNTIME
    if not library.is_file():
        return False
    chosen = os.environ.get(VENDORS_VARIABLE)
    if chosen is not None:
        # If an earlier call or a parent process has set it, this process still has to load the libraries.
        return (Path(chosen) / _ICD).is_file() and _preload(library.parent)
    system = sorted(SYSTEM_VENDORS.glob("*.icd"))
    if any(RUNTIME in icd.read_text(encoding="utf-8", errors="replace") for icd in system) or not _preload(
        library.parent
    ):
        return False
    texts = {icd.name: icd.read_bytes() for icd in system} | {_ICD: f"{library.resolve()}\n".encode()}
    os.environ[VENDORS_VARIABLE] = str(_folder_of(texts))
    return True


def _folder_of(texts: dict[str, bytes]) -> Path:
    """Return a folder with these files. It is in the user's cache and stays there: other processes use it, too.

    Raises
    ------
    DeviceError : the folder cannot be written.
    """
    digest = hashlib.sha256(repr(sorted(texts.items())).encode()).hexdigest()[:16]
    folder = user_cache() / "clsplat" / f"opencl-vendors-{digest}"
    if folder.is_dir():
        return folder
    written = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        written = Path(tempfile.mkdtemp(dir=folder.parent))
        for name, text in texts.items():
            (written / name).write_bytes(text)
        written.rename(folder)
    except OSError as error:
        if written is not None:
            shutil.rmtree(written, ignore_errors=True)
        if not folder.is_dir():  # else another process was first
            raise DeviceError(
                f"{folder}: cannot be written ({error.strerror or error})",
                Remedy("set XDG_CACHE_HOME to another folder"),
            ) from None
    return folder


def _preload(folder: Path) -> bool:
    """Load the runtime's libraries for the whole process; return False if one cannot be loaded."""
    try:
        for name in _PRELOAD:
            ctypes.CDLL(str(folder / name), mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True
