"""Reading of whole files."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path


def read_whole(path: Path) -> bytes:
    """Return the content of a file or a pipe. Raise OSError for a device: /dev/zero, for example, never ends."""
    with path.open("rb") as stream:
        if stat.S_ISCHR(os.fstat(stream.fileno()).st_mode):
            raise OSError(errno.EINVAL, "a device, not a file", os.fspath(path))
        return stream.read()
