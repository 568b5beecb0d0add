"""A lock on an output folder: two runs that write into the same folder would mix their files."""

from __future__ import annotations

import errno
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..errors import OutputError
from .atomic import remove_leftovers
from .real_path import real_path

fcntl: Any = None  # of POSIX
msvcrt: Any = None  # of Windows
try:
    import fcntl
except ImportError:
    with suppress(ImportError):
        import msvcrt

# Errors of a lock that another process holds. Windows says EACCES, or EDEADLOCK after it has waited.
_HELD_ELSEWHERE = (errno.EWOULDBLOCK, errno.EACCES, errno.EDEADLK)

_held: set[Path] = set()


@contextmanager
def folder_lock(folder: Path | None) -> Iterator[None]:
    """Keep other runs out of a folder while the block lasts, and remove the half-written files of killed runs.

    The operating system holds the lock and releases it when the process ends in any way. Blocks of one process may be
    nested: a search that trains takes the lock twice. File systems without locks are not locked. Windows does not lock
    folders, so a file in the folder for temporary files stands for the folder there.

    Parameters
    ----------
    folder : an existing folder; None if nothing will be written.

    Raises
    ------
    OutputError : another run writes into the folder.
    """
    path = None if folder is None else real_path(folder)
    if path is None or path in _held or (fcntl is None and msvcrt is None):
        yield
        return
    stand_in = None if fcntl is not None else _stand_in(path)
    descriptor = os.open(path, os.O_RDONLY) if stand_in is None else os.open(stand_in, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        try:
            _lock(descriptor)
        except OSError as error:
            if error.errno in _HELD_ELSEWHERE:
                raise OutputError(
                    f"{folder}: another run writes into it: wait until it ends, or choose another folder"
                ) from None
        _held.add(path)
        try:
            remove_leftovers(path)
            yield
        finally:
            _held.remove(path)
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> None:
    """Lock an open file for this process. Closing it releases the lock. OSError if it cannot be locked."""
    if fcntl is not None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    else:
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)  # the first byte, which need not exist


def _stand_in(folder: Path) -> Path:
    """Return the file whose lock stands for a folder. It is empty, and stays: another run may have just opened it."""
    name = hashlib.sha256(os.path.normcase(folder).encode(errors="surrogatepass")).hexdigest()[:32]
    return Path(tempfile.gettempdir()) / f"clsplat-{name}.lock"
