"""Fixtures for the commands' tests: the shared scene and model as folders."""

from __future__ import annotations

import shutil
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


@pytest.fixture
def copied_model(model: Path, tmp_path: Path) -> Path:
    """A copy of the small model, for a test that writes into its folder."""
    return Path(shutil.copytree(model, tmp_path / "copy"))
