"""Commands of compilers: found, run, and their first error lines."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from .usage import CompilerError

_ERROR_LINES = 6
CLANG, LINK, OPT, LLC = "clang-19", "llvm-link-19", "opt-19", "llc-19"
LLVM_REMEDY = "`apt install clang-19 llvm-19`"


def lacks(*programs: str) -> list[str]:
    """Return those of the programs that are not in the PATH."""
    return [program for program in programs if shutil.which(program) is None]


def run(command: Sequence[str | Path], *, cwd: Path | None = None) -> str:
    """Run a command and return what it printed on both streams.

    Raises
    ------
    CompilerError : it failed.
    """
    result = subprocess.run(
        [str(part) for part in command],
        cwd=cwd,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
    )
    if result.returncode:
        lines = [line for line in result.stdout.splitlines() if line.strip()]
        raise CompilerError("\n".join([f"{command[0]}: exit status {result.returncode}", *lines[:_ERROR_LINES]]))
    return result.stdout


def in_packages(*parts: str) -> Path | None:
    """Return a file of an installed Python package below `site-packages`, or None."""
    for folder in sys.path:
        path = Path(folder, *parts)
        if path.is_file():
            return path
    return None
