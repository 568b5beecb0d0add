"""Paths without links."""

from __future__ import annotations

import os
from pathlib import Path


def real_path(path: str | os.PathLike[str]) -> Path:
    """Return an absolute path without links. Links that lead in a circle stay as they are.

    `Path.resolve` raises RuntimeError for such links before Python 3.13.
    """
    return Path(os.path.realpath(path))
