"""Standard streams that the caller closed, or whose reader has ended."""

from __future__ import annotations

import os
import sys


def open_closed_streams() -> None:
    """Open the null device for each standard stream that the caller closed, as services and `2>&-` do.

    Otherwise Python has None in its place. The next file that is opened gets its number, so that messages of libraries
    go into that file.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the smallest free number
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8", closefd=False))


def drop_unread() -> None:
    """Send the rest of each standard stream whose reader has ended to the null device.

    Otherwise Python writes what is in the buffer once more when it ends, and exits with code 120.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, stream.fileno())
            os.close(null)
