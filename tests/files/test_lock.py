"""Two runs into one folder: the second is refused until the first has ended, in any way."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from clsplat.compression.state import FILE, remove_search
from clsplat.errors import OutputError
from clsplat.files.lock import folder_lock

pytest.importorskip("fcntl")

HOLD = """
import sys, time
from pathlib import Path
from clsplat.files.lock import folder_lock
with folder_lock(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def holder(folder: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL])
def test_another_process_keeps_out_until_it_ends(tmp_path: Path, end: signal.Signals) -> None:
    process = holder(tmp_path)
    try:
        with pytest.raises(OutputError, match="another run writes into it"), folder_lock(tmp_path):
            pytest.fail("entered the locked folder")
    finally:
        process.send_signal(end)
        process.wait(10)
    time.sleep(0.05)
    with folder_lock(tmp_path):
        pass


def test_blocks_within_a_block_are_one_writer(tmp_path: Path) -> None:
    with folder_lock(tmp_path):
        with folder_lock(tmp_path / "."):
            pass
        assert refused(tmp_path), "the end of the inner block released the lock"
    assert not refused(tmp_path)
    with folder_lock(None):
        pass


def refused(folder: Path) -> bool:
    done = subprocess.run([sys.executable, "-c", HOLD.replace("60", "0"), str(folder)], capture_output=True, text=True)
    return "another run writes into it" in done.stderr


def test_a_running_search_keeps_its_results(tmp_path: Path) -> None:
    """A second run with --overwrite is refused before it removes anything."""
    (tmp_path / FILE).write_text("{}")
    process = holder(tmp_path)
    try:
        with pytest.raises(OutputError, match="another run writes into it"):
            remove_search(tmp_path)
        assert (tmp_path / FILE).exists()
    finally:
        process.kill()
        process.wait(10)
    remove_search(tmp_path)
    assert not (tmp_path / FILE).exists()
