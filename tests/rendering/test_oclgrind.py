"""A simulated device checks the kernels for stray accesses, data races and reads of unwritten memory."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from clsplat.device.program import OPTIONS_VARIABLE

OCLGRIND = shutil.which("oclgrind")
CHILD = Path(__file__).parents[1] / "support" / "oclgrind_child.py"

pytestmark = pytest.mark.skipif(OCLGRIND is None, reason="oclgrind is not installed (apt install oclgrind)")

# Oclgrind 21.10 stops at LLVM's `freeze`, so uninitialised values are tracked in unoptimised kernels. Races and
# stray accesses are checked in optimised kernels.
MODES = {
    "races": (["--data-races"], ""),
    "uninitialized": (["--uninitialized"], "-O0"),
}


def run_under_oclgrind(tmp_path: Path, what: str, mode: str) -> str:
    """Return all that Oclgrind reported while oclgrind_child.py ran. The child must finish."""
    flags, build_options = MODES[mode]
    log = tmp_path / "oclgrind.log"
    assert OCLGRIND is not None
    child = [sys.executable, str(CHILD), what, mode]
    command = [OCLGRIND, *flags, "--max-errors", "20", "--log", str(log), *child]
    tests = str(Path(__file__).resolve().parents[1])  # the child imports tests/reference
    environment = {**os.environ, OPTIONS_VARIABLE: build_options, "OMP_NUM_THREADS": "1", "PYTHONPATH": tests}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.endswith("finished\n"), done.stdout + done.stderr
    return log.read_text() if log.exists() else ""


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "what", ["render", "sort", *(pytest.param(f"render-{what}", marks=pytest.mark.slow) for what in ("all", "hazards"))]
)
def test_kernels_are_clean(tmp_path: Path, what: str, mode: str) -> None:
    report = run_under_oclgrind(tmp_path, what, mode)
    assert not report, report[:3000]


def test_faults_are_found(tmp_path: Path) -> None:
    """The same calls report planted faults of each kind. This checks the test above."""
    races = run_under_oclgrind(tmp_path, "faults", "races")
    assert "Invalid write of size 4 at global memory" in races
    assert "data race at local memory" in races
    assert "uninitialized" in run_under_oclgrind(tmp_path, "faults", "uninitialized")
