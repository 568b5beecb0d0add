"""Commands without what only POSIX has, and with text in no encoding but the one that is named."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pretended_windows
import pytest
from cli_runner import SHORT

pytest.importorskip("fcntl")

COMMAND = f"""
import sys, warnings
sys.path.append({str(Path(pretended_windows.__file__).parent)!r})
import pretended_windows
pretended_windows.become_windows()
warnings.filterwarnings("error", category=EncodingWarning, module="clsplat")
from clsplat_cli.start import main
main()
"""
# Ctrl-C comes soon after a file is there.
INTERRUPT = """
import os, signal, threading, time
def interrupt():
    while not os.path.exists({file!r}):
        time.sleep(0.05)
    time.sleep({seconds})
    signal.raise_signal(signal.SIGINT)
threading.Thread(target=interrupt, daemon=True).start()
"""


def run(*args: object, before: str = "") -> subprocess.CompletedProcess[str]:
    """Run `clsplat ARGS` in a process that has become Windows, as far as that is possible."""
    start = COMMAND.replace("from clsplat_cli", f"{before}\nfrom clsplat_cli", 1)
    return subprocess.run(
        [sys.executable, "-X", "warn_default_encoding", "-c", start, *map(str, args)],
        capture_output=True,
        encoding="utf-8",
        timeout=300,
        check=False,
    )


def test_a_model_is_trained_rendered_and_measured(capture_folder: Path, tmp_path: Path) -> None:
    model = tmp_path / "model"
    for args in (
        ["train", capture_folder, "-m", model, "--eval", *SHORT],
        ["train", capture_folder, "-m", model, "--eval", "--overwrite", *SHORT],
        ["render", model, "-o", tmp_path / "images"],
        ["eval", model],
        ["info", model],
    ):
        done = run(*args)
        assert done.returncode == 0, done.stderr
        assert "\x1b" not in done.stdout + done.stderr
    log = (model / "log.jsonl").read_bytes()
    assert b"\r" not in log
    assert json.loads(log.splitlines()[-1])["iteration"] == 60
    path = json.loads((model / "config.json").read_text(encoding="utf-8"))["scene"]["path"]
    assert path == capture_folder.resolve().as_posix()


def test_ctrl_c_saves_the_model(capture_folder: Path, tmp_path: Path) -> None:
    """Windows has neither SIGHUP nor pthread_kill."""
    model = tmp_path / "model"
    args = ["train", capture_folder, "-m", model, "--iterations", "100000", "--cap-max", "100"]
    done = run(*args, before=INTERRUPT.format(file=str(model / "log.jsonl"), seconds=0.2))
    assert done.returncode == 130, done.stderr
    assert "Traceback" not in done.stderr
    assert (model / "checkpoint.npz").is_file(), done.stderr


@pytest.mark.parametrize("seconds", [0.05, 0.2])
def test_ctrl_c_before_the_work_ends_the_command_in_one_line(capture_folder: Path, seconds: float) -> None:
    done = run("info", capture_folder, before=INTERRUPT.format(file=str(capture_folder), seconds=seconds))
    assert done.returncode in (0, 130), done.stderr
    assert done.stderr in ("", "error: interrupted\n")
