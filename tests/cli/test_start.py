"""Start of the program: closed standard streams."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

START = "import sys; from clsplat_cli.start import main; sys.argv[0] = 'clsplat'; main()"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no exec in the same process")
def test_closed_streams_change_nothing(scene: Path, tmp_path: Path) -> None:
    """Numbers 0 to 2 must not become those of files, which would then contain messages of libraries."""
    args: list[object] = ["train", scene, "-m", tmp_path / "m", "--iterations", "2", "--cap-max", "20"]
    child = subprocess.run([sys.executable, "-c", _closing(args)], check=False)
    assert child.returncode == 0
    assert (tmp_path / "m" / "point_cloud").is_dir()


def _closing(args: list[object]) -> str:
    """Return a program that closes its streams and becomes clsplat."""
    command = [sys.executable, "-c", START, *map(str, args)]
    return f"import os; os.closerange(0, 3); os.execv({sys.executable!r}, {command!r})"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("args", [["--help"], ["--version"], ["train", "--help"], ["devices"]])
def test_a_text_that_cannot_be_written_is_one_line(args: list[str]) -> None:
    """As with standard output in a file on a full disk."""
    with open("/dev/full", "wb") as full:
        child = subprocess.run([sys.executable, "-c", START, *args], stdout=full, stderr=subprocess.PIPE, check=False)
    (line,) = child.stderr.decode().splitlines()
    assert line == "error: standard output: cannot be written (No space left on device): send it elsewhere"
    assert child.returncode == 1
