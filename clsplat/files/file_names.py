"""Names of files that not every system allows, and names that only some systems tell apart."""

from __future__ import annotations

import hashlib
import os
import sys
from pathlib import PurePosixPath

IGNORES_CASE = sys.platform in ("win32", "darwin")  # the usual file systems of Windows and macOS do
RESERVED = frozenset('<>:"|?*' if sys.platform == "win32" else "")  # a colon would name a hidden part of another file

_MAX_NAME, _MAX_PATH = 240, 2000  # longest names and paths [bytes]; file systems allow 255 and 4096


def name_key(path: str | os.PathLike[str]) -> str:
    """Return a text that two paths share if they name one file on this system."""
    text = os.fspath(path)
    return text.casefold() if IGNORES_CASE else text


def printable(name: str) -> str:
    """Return a name for programs that take UTF-8 only. Other bytes become escapes, as `\\udcff`."""
    return name.encode("utf-8", "backslashreplace").decode()


def short_name(name: str, n_bytes: int) -> str:
    """Return a name of at most this number of bytes, at least 20.

    A longer name is cut, and ends in digits that differ between names that begin alike.
    """
    text = os.fsencode(name)
    if len(text) <= n_bytes:
        return name
    digits = hashlib.sha256(text).hexdigest()[:8]
    return f"{text[: n_bytes - 9].decode(errors='ignore')}-{digits}"


def can_be_file(text: str) -> bool:
    """Return whether a file can have this path, with a suffix added."""
    path = PurePosixPath(text.replace("\\", "/"))
    try:
        parts = [len(os.fsencode(part)) for part in path.parts]
        short = max(parts, default=0) <= _MAX_NAME and sum(parts) <= _MAX_PATH
        return short and bool(path.name) and "\0" not in text
    except UnicodeEncodeError:  # the text contains half of a surrogate pair
        return False
