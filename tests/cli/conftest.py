"""The commands' tests know the shared scene and model as folders."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def scene(capture_folder: Path) -> Path:
    """Folder of the small capture; tests must not write into it."""
    return capture_folder


@pytest.fixture(scope="session")
def model(model_folder: Path) -> Path:
    """Folder of the small model; tests must not write into it."""
    return model_folder
