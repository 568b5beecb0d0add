"""Writing files whole: a reader sees the old file or the new one, never half of one."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from ..errors import OutputError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_TEMPORARY = re.compile(r"\..+\.(\d+)\.tmp(\..*)?")


@contextmanager
def atomic_writer(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A binary stream that becomes `path` when the block ends well, and leaves nothing when it does not.

    Missing parent folders are made.

    Raises
    ------
    OutputError : the folder or the file cannot be written.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        yield stream


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """As `atomic_writer`, for what must be given a file's name: one to write to, with the suffix of `path`.

    Raises
    ------
    OutputError : the folder or the file cannot be written.
    """
    target = Path(path)
    # Beside the target, because os.replace is atomic within one file system only. Not tempfile: its files are
    # private to the user (mode 0600), and the mode would stay.
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield temporary
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
        mend = "free some space, or choose another place" if error.errno in _FULL else "choose another place"
        raise OutputError(f"{target}: cannot be written ({reason}); {mend}") from error


def remove_leftovers(folder: Path) -> None:
    """Delete what processes that were killed have left half written in a folder and below it."""
    for path in folder.rglob(".*.tmp*"):
        match = _TEMPORARY.fullmatch(path.name)
        if match and not _is_running(int(match[1])):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if os.name == "nt":
        return True  # os.kill would end it
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True
