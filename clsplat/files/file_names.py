"""Names of files that not every system allows, and names that only some systems tell apart."""

from __future__ import annotations

import os
import sys

IGNORES_CASE = sys.platform in ("win32", "darwin")  # the usual file systems of Windows and macOS do
RESERVED = frozenset('<>:"|?*' if sys.platform == "win32" else "")  # a colon would name a hidden part of another file


def name_key(path: str | os.PathLike[str]) -> str:
    """Return a text that two paths share if they name one file on this system."""
    text = os.fspath(path)
    return text.casefold() if IGNORES_CASE else text
