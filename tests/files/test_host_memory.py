"""Memory of the machine and of a process."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from clsplat.files.host_memory import available_bytes, peak_bytes

MEGABYTE = 1 << 20


def test_the_peak_is_that_of_the_largest_moment() -> None:
    block = np.ones(200 * MEGABYTE, np.uint8)
    during = peak_bytes()
    del block
    assert during > 200 * MEGABYTE
    assert peak_bytes() > during - 5 * MEGABYTE, "the system counts pages of several processors apart"
    assert available_bytes() > 0


@pytest.mark.skipif(sys.platform != "linux", reason="other systems count each process alone")
def test_the_peak_is_not_that_of_the_program_that_has_started_it() -> None:
    """The system call counts the memory that the parent had when it started the process: workers seemed as large."""
    block = np.ones(400 * MEGABYTE, np.uint8)
    code = "from clsplat.files.host_memory import peak_bytes; print(peak_bytes())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 200 * MEGABYTE < block.nbytes
