"""Folders for the caches of compiled kernels: the user's, or a temporary one if that cannot be written.

PoCL shows no platform if it cannot make its cache. pyopencl's cache ends the process with a traceback. So this module
looks first, and points both of them to a folder that works.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import warnings
from pathlib import Path

from ..errors import DeviceError

USER_VARIABLE = "XDG_CACHE_HOME"
POCL_VARIABLE = "POCL_CACHE_DIR"
_NO_FOLDER = f"no folder for a cache of kernels can be written: set {USER_VARIABLE} to one that can"
_ROOM = 1 << 20  # bytes that must be free: on a full disk PoCL ends the process


def user_cache() -> Path:
    """Return the folder of the user's caches, which may not exist; RuntimeError if the user has no home."""
    return Path(os.environ.get(USER_VARIABLE) or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache")


def ensure_caches() -> None:
    """Point this process and its children to a temporary cache if the user's cannot be written, with one warning.

    It must run before pyopencl is imported, which opens its cache. Further calls find nothing to change.

    Raises
    ------
    DeviceError : a temporary folder cannot be written either.
    """
    problems = {}
    pocl = os.environ.get(POCL_VARIABLE)
    if pocl and (problem := _problem(Path(pocl))):
        problems[POCL_VARIABLE] = problem
    if problem := _problem_of_user_cache():
        problems[USER_VARIABLE] = problem
    if not problems:
        return
    try:
        folder = Path(tempfile.mkdtemp(prefix="clsplat-cache-"))
    except OSError:
        raise DeviceError(_NO_FOLDER) from None
    atexit.register(_remove, folder, os.getpid())
    if _problem(folder):
        raise DeviceError(_NO_FOLDER)
    for variable in problems:
        os.environ[variable] = str(folder / variable.lower())
    warnings.warn(
        f"cache of kernels cannot be written ({'; '.join(problems.values())}): kernels are built again in every run: "
        f"set {' and '.join(problems)} to a folder that can be written",
        stacklevel=2,
    )


def _problem_of_user_cache() -> str | None:
    """Return why the caches of clsplat, PoCL and pyopencl cannot be written; None if all of them can."""
    try:
        folder = user_cache()
    except RuntimeError:
        return "the user has no home folder"
    others = [folder / name for name in ("pocl", "pocl/kcache", "pytools")]
    return next(filter(None, map(_problem, [folder / "clsplat", *filter(_exists, others)])), None)


def _exists(folder: Path) -> bool:
    try:
        return folder.exists()
    except OSError:  # a folder above it may not be entered
        return True


def _problem(folder: Path) -> str | None:
    """Return folder and reason if no file of some size can be written there. A missing folder is made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_ROOM))
            return None
    except OSError as error:
        return f"{folder}: {error.strerror or error}"


def _remove(folder: Path, process: int) -> None:
    """Delete the temporary folder at the end of the process that made it, not of a fork."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
