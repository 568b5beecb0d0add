"""Where the real scenes are: folder CLSPLAT_DATA, else shared/data beside the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data_folder() -> Path:
    """Folder of the real scenes; it may not exist."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    return Path(os.environ.get("CLSPLAT_DATA") or beside)


def scene_folder(name: str) -> Path:
    """Folder of scene `name`; skips the test where it is absent."""
    folder = data_folder() / name
    if not folder.is_dir():
        pytest.skip(f"scene {name!r} is not in {data_folder()}; set CLSPLAT_DATA to the folder of scenes")
    return folder
