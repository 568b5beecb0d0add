"""Half-written files of killed processes are removed; files of running processes and of other programs stay."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.files.atomic import atomic_path
from clsplat.files.lock import folder_lock

pytest.importorskip("fcntl")
KILLED = """
import os, sys
from pathlib import Path
from clsplat.files.atomic import atomic_writer
with atomic_writer(Path(sys.argv[1])) as stream:
    stream.write(b"half")
    stream.flush()
    os.kill(os.getpid(), 9)
"""


def test_leftovers_of_a_killed_process_are_removed(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "model.ply"
    target.parent.mkdir()
    target.write_bytes(b"old")
    subprocess.run([sys.executable, "-c", KILLED, str(target)], check=False)
    left = [path for path in target.parent.iterdir() if path != target]
    assert len(left) == 1
    unrelated = (tmp_path / ".notes.1.tmpfile", tmp_path / ".tmp", tmp_path / f".a.{os.getppid()}.tmp")
    for path in unrelated:
        path.write_bytes(b"")
    with atomic_path(tmp_path / "living.ply") as temporary:
        temporary.write_bytes(b"half")
        with folder_lock(tmp_path):
            assert temporary.exists()
    assert not left[0].exists()
    assert target.read_bytes() == b"old"
    assert all(path.exists() for path in unrelated)
