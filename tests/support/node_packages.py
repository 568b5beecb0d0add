"""Scripts for Node with npm packages, which clsplat does not install (see tests/splats/formats/test_peers.py)."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

MODULES = Path(os.environ.get("CLSPLAT_NODE_MODULES", "/nonexistent"))


def package(name: str) -> None:
    """Skip the test without the package or without Node."""
    if not (MODULES / name).is_dir():
        pytest.skip(f"CLSPLAT_NODE_MODULES has no {name}")
    if shutil.which("node") is None:
        pytest.skip("there is no node")


def node(tmp_path: Path, script: str, *arguments: object) -> str:
    """Standard output of a script that finds the packages."""
    (tmp_path / "node_modules").symlink_to(MODULES)
    (tmp_path / "read.mjs").write_text(script, encoding="utf-8")
    command = ["node", str(tmp_path / "read.mjs"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, encoding="utf-8", check=True, timeout=60).stdout


def transform(source: Path, output: Path, *options: str) -> Path:
    """Let splat-transform write a file, and return its path."""
    package("@playcanvas/splat-transform")
    program = MODULES / "@playcanvas/splat-transform" / "bin" / "cli.mjs"
    subprocess.run(["node", program, "-q", *options, source, output], check=True, capture_output=True, timeout=60)
    return output
