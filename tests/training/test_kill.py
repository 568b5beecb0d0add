"""A run survives kill -9 at random moments and continues with --resume: benchmarks/kill.py with few kills."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("fcntl")
SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "kill.py"


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there is no kill -9")
def test_killed_runs_end_with_the_bits_of_one_in_peace(tmp_path: Path) -> None:
    out = tmp_path / "kill.jsonl"
    command = [sys.executable, str(SCRIPT), "--kills", "8", "--seed", "3", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    row = json.loads(out.read_text())
    assert row["faults"] == []
    assert row["kills"] == 8
