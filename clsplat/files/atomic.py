"""Atomic writes: a reader sees the old file or the new one, never a part of one."""

from __future__ import annotations

import errno
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from ..errors import OutputError
from . import windows
from .file_names import short_name

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Longest parts of a temporary name, which adds a process [bytes]. Most file systems allow 255 bytes in all.
_LONGEST_NAME, _LONGEST_SUFFIX = 200, 20
_TEMPORARY = re.compile(r"\..+\.(\d+)\.tmp(\..*)?")
# Seconds to wait before further attempts to replace a file. Windows refuses while anybody has it open, and search
# indexes and virus scanners open every new file for a moment.
WINDOWS_WAITS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
_WAITS: tuple[float, ...] = WINDOWS_WAITS if sys.platform == "win32" else ()


@contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a binary stream that becomes `path` if the block succeeds, and leaves no file if it fails.

    Missing parent folders are created.

    Raises
    ------
    OutputError : the folder or the file cannot be written.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        yield stream


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary file name for code that cannot write to a stream; otherwise as `atomic_writer`.

    The temporary name has the suffix of `path`, because some code chooses a format by it.

    Raises
    ------
    OutputError : the folder or the file cannot be written.
    """
    target = Path(path)
    # The temporary file lies beside the target because os.replace is atomic only within one file system. The tempfile
    # module is not used: its files are private to the user (mode 0600), and the target would keep that mode.
    suffix = target.suffix if len(os.fsencode(target.suffix)) <= _LONGEST_SUFFIX else ""
    temporary = target.with_name(f".{short_name(target.name, _LONGEST_NAME)}.{os.getpid()}.tmp{suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            move(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
        remedy = "free some space, or choose another place" if error.errno in _DISK_FULL else "choose another place"
        raise OutputError(f"{target}: cannot be written ({reason}); {remedy}") from error


def move(source: Path, target: Path) -> None:
    """Rename a file, which may replace another one, or a folder.

    Raises
    ------
    OSError : the system refuses, on Windows also after a second.
    """
    for seconds in _WAITS:
        try:
            os.replace(source, target)
        except PermissionError:
            time.sleep(seconds)
        else:
            return
    os.replace(source, target)


def remove_leftovers(folder: Path) -> None:
    """Delete the half-written files of killed processes in a folder and its subfolders."""
    for path in folder.rglob(".*.tmp*"):
        match = _TEMPORARY.fullmatch(path.name)
        if match and not _is_running(int(match[1])):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if sys.platform == "win32":
        return windows.is_running(process)
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
