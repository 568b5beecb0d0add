"""Two runs into one folder: the second is refused until the first has ended, in any way.

Each test runs with the lock of this system, and with the one of Windows on a pretended msvcrt.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pretended_windows
import pytest

from clsplat.compression.state import BudgetState
from clsplat.errors import OutputError
from clsplat.files import lock
from clsplat.files.lock import folder_lock
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.run import train

pytest.importorskip("fcntl")

HOLD = """
import sys, time
from pathlib import Path
from clsplat.files.lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""
AS_WINDOWS = f"""
import sys
sys.path.append({str(Path(pretended_windows.__file__).parent)!r})
import pretended_windows
pretended_windows.become_windows()
"""


@pytest.fixture(params=["here", "windows"])
def start(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    """Return the beginning of a program whose locks are those of this system or of Windows, as in this process."""
    if request.param == "here":
        return ""
    pretended_windows.lock_as_windows(monkeypatch)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return AS_WINDOWS


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "model").mkdir()
    return tmp_path / "model"


def holder(folder: Path, start: str) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", start + HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_another_process_keeps_out_until_it_ends(folder: Path, start: str, end: signal.Signals) -> None:
    process = holder(folder, start)
    try:
        with pytest.raises(OutputError, match="another run writes into it"), folder_lock(folder):
            pytest.fail("entered the locked folder")
    finally:
        process.send_signal(end)
        process.wait(10)
    time.sleep(0.05)
    with folder_lock(folder):
        pass


def test_blocks_within_a_block_are_one_writer(folder: Path, start: str) -> None:
    with folder_lock(folder):
        with folder_lock(folder / "."):
            pass
        assert refused(folder, start), "the end of the inner block released the lock"
    assert not refused(folder, start)
    with folder_lock(None):
        pass


def refused(folder: Path, start: str) -> bool:
    code = start + HOLD.replace("60", "0")
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True)
    return "another run writes into it" in done.stderr


def test_a_running_search_keeps_its_results(folder: Path, start: str, scene: Scene) -> None:
    """A second run with --overwrite is refused before it removes anything."""
    (folder / BudgetState.FILE).write_text("{}")
    process = holder(folder, start)
    try:
        with pytest.raises(OutputError, match="another run writes into it"):
            train(scene, TrainConfig(iterations=2, cap_max=60), output=folder, overwrite=True)
        assert (folder / BudgetState.FILE).exists()
    finally:
        process.kill()
        process.wait(10)
    train(scene, TrainConfig(iterations=2, cap_max=60), output=folder, overwrite=True)
    assert not (folder / BudgetState.FILE).exists()


@pytest.mark.parametrize("start", ["windows"], indirect=True)
def test_each_folder_has_a_lock_of_its_own_outside_of_it(folder: Path, start: str) -> None:
    """Windows could not remove or rename a folder with an open file in it."""
    other = folder.with_name("other")
    other.mkdir()
    process = holder(folder, start)
    try:
        with folder_lock(other):
            assert list(other.iterdir()) == []
        assert list(folder.iterdir()) == []
    finally:
        process.kill()
        process.wait(10)


def test_a_system_without_locks_does_not_lock(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "fcntl", None)
    process = holder(folder, "")
    with folder_lock(folder):
        process.kill()
        process.wait(10)
