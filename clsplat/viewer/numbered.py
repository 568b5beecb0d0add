"""Files under free names: nothing that is there is ever replaced."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from pathlib import Path

_saving = threading.Lock()  # two browsers may save at once


def save_numbered(folder: Path, stem: str, suffix: str, write: Callable[[Path], None]) -> Path:
    """Write STEM_001SUFFIX, or the next free number, into a folder, and return its path.

    Parameters
    ----------
    write : writes the file, and makes the folder if it is missing.
    """
    pattern = re.compile(rf"{re.escape(stem)}_(\d+){re.escape(suffix)}")
    with _saving:
        found = (pattern.fullmatch(file.name) for file in folder.glob(f"{stem}_*{suffix}"))
        last = max((int(match[1]) for match in found if match), default=0)
        target = folder / f"{stem}_{last + 1:03}{suffix}"
        write(target)
    return target
