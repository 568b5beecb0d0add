"""Folder of the real scenes: CLSPLAT_DATA, or shared/data beside the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def data_folder() -> Path:
    """Return the folder of the real scenes. It may not exist."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    return Path(os.environ.get("CLSPLAT_DATA") or beside)


def scene_folder(name: str) -> Path:
    """Return the folder of a scene. Skip the test if the scene is missing."""
    folder = data_folder() / name
    if not folder.is_dir():
        pytest.skip(f"scene {name!r} is not in {data_folder()}; set CLSPLAT_DATA to the folder of scenes")
    return folder
