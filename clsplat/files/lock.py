"""A lock on an output folder: two runs that write into the same folder would mix their files."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import OutputError
from .atomic import remove_leftovers
from .real_path import real_path

try:
    import fcntl
except ImportError:  # Windows has no fcntl, so that folders are not locked there
    fcntl = None  # type: ignore[assignment]

_held: set[Path] = set()


@contextmanager
def folder_lock(folder: Path | None) -> Iterator[None]:
    """Keep other runs out of a folder while the block lasts, and remove the half-written files of killed runs.

    The operating system holds the lock, on the folder itself, and releases it when the process ends in any way. Blocks
    of one process may be nested: a search that trains takes the lock twice. File systems without locks are not locked.

    Parameters
    ----------
    folder : an existing folder; None if nothing will be written.

    Raises
    ------
    OutputError : another run writes into the folder.
    """
    path = None if folder is None else real_path(folder)
    if path is None or path in _held or fcntl is None:
        yield
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
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
