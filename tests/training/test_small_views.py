"""Test views that are too small to be measured stop a run before it starts."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_runner import clsplat, error_of

ROUNDS = ("--iterations", 5, "--cap-max", 200, "--sh-degree", 0)


@pytest.mark.parametrize("command", ["train", "compare"])
def test_test_views_below_the_window_are_refused(capture_folder: Path, tmp_path: Path, command: str) -> None:
    """The photos have 48x36 px."""
    extra = ("--eval",) if command == "train" else ("--systems", "default")
    message = error_of(command, capture_folder, "-o", tmp_path / "out", "-r", 4, *extra, *ROUNDS[:2])
    assert (
        "test view 'view_000.png' has 12x9 px; SSIM needs at least 11x11: use larger photos, or no test views"
        in message
    )
    assert not list((tmp_path / "out").rglob("*.ply"))


def test_small_training_views_are_allowed(capture_folder: Path, tmp_path: Path) -> None:
    clsplat("train", capture_folder, "-m", tmp_path / "m", "-r", 4, *ROUNDS)
