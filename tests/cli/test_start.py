"""Start of the program: standard streams that are closed, full, or without a reader."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from cli_runner import error_of

from clsplat.models import info

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


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGPIPE")
@pytest.mark.parametrize("command", ["--help", "info", "devices", "eval"])
def test_a_reader_that_has_ended_ends_the_command_quietly(command: str, model: Path) -> None:
    """As `clsplat info MODEL | head -1` does, with the exit code of Unix tools."""
    args = [command, *([str(model)] if command in ("info", "eval") else [])]
    reader, writer = os.pipe()
    os.close(reader)
    child = subprocess.run([sys.executable, "-c", START, *args], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    said = child.stderr.decode().replace("\r", "\n").splitlines()
    assert [line for line in said if line.strip() and not line.startswith("measuring")] == []
    assert child.returncode == 141


def test_the_broken_pipe_of_another_program_is_an_error(monkeypatch: pytest.MonkeyPatch, model: Path) -> None:
    def broken(*arguments: object, **values: object) -> None:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    monkeypatch.setattr(info, "inspect", broken)
    assert error_of("info", model) == "error: [Errno 32] Broken pipe"
