"""Make Intel's CPU runtime usable when it came by pip, which cannot register it with the OpenCL loader.

The wheels `intel-opencl-rt` and `intel-cmplr-lib-rt` put their libraries into `<prefix>/lib`, where the
dynamic linker does not look, and an `.icd` file with a path of Intel's build machine. So: load the libraries
that the runtime needs, write an `.icd` file with the true path beside copies of the system's, and point the
loader there.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import shutil
import sys
import tempfile
from pathlib import Path

VENDORS_VARIABLE = "OCL_ICD_VENDORS"
SYSTEM_VENDORS = Path("/etc/OpenCL/vendors")
RUNTIME = "libintelocl.so"
_ICD = "clsplat-intel-cpu.icd"
# What libintelocl.so links against, each after what it needs itself.
_PRELOAD = ("libintlc.so.5", "libirng.so", "libimf.so", "libsvml.so", "libtbb.so.12")


def register_pip_runtime() -> bool:
    """Register the pip-installed runtime with this process's OpenCL loader; True when it is registered.

    Must run before the loader's first use in the process; doing it again costs nothing. Does nothing where
    the runtime is not installed, the system has registered one, or the user has set OCL_ICD_VENDORS.
    """
    library = Path(sys.prefix) / "lib" / RUNTIME
    if not library.is_file():
        return False
    chosen = os.environ.get(VENDORS_VARIABLE)
    if chosen is not None:
        # Ours, set earlier or by a parent process? Then this process still has to load the libraries.
        return (Path(chosen) / _ICD).is_file() and _preload(library.parent)
    system = sorted(SYSTEM_VENDORS.glob("*.icd"))
    if any(RUNTIME in icd.read_text(errors="replace") for icd in system) or not _preload(library.parent):
        return False
    folder = Path(tempfile.mkdtemp(prefix="clsplat-icd-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for icd in system:
        shutil.copyfile(icd, folder / icd.name)
    (folder / _ICD).write_text(f"{library.resolve()}\n")
    os.environ[VENDORS_VARIABLE] = str(folder)
    return True


def _preload(folder: Path) -> bool:
    """Load the runtime's own libraries for everyone in this process; False when one cannot be."""
    try:
        for name in _PRELOAD:
            ctypes.CDLL(str(folder / name), mode=ctypes.RTLD_GLOBAL)
    except OSError:
        return False
    return True
