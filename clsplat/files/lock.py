"""One run a folder: two that write into the same one would mix their files."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import OutputError
from .atomic import remove_leftovers

try:
    import fcntl
except ImportError:  # Windows: no lock
    fcntl = None  # type: ignore[assignment]

_held: set[Path] = set()


@contextmanager
def folder_lock(folder: Path | None) -> Iterator[None]:
    """Keep other runs out of a folder while the block lasts; what a killed one has left half written is removed.

    The lock is the operating system's, on the folder itself: it ends with the process, however that ends. A block
    within a block of the same process, as of a search that trains, is the same writer. File systems that know no locks
    have none.

    Parameters
    ----------
    folder : that is there; None: nothing is written.

    Raises
    ------
    OutputError : another run writes into it.
    """
    path = None if folder is None else folder.resolve()
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
                    f"{folder}: another run writes into it: wait for its end, or choose another folder"
                ) from None
        _held.add(path)
        try:
            remove_leftovers(path)
            yield
        finally:
            _held.remove(path)
    finally:
        os.close(descriptor)
