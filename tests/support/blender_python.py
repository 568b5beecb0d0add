"""The Python that has Blender as a module."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


def blenders_python() -> str | None:
    """Return a Python with bpy: this one, or that of CLSPLAT_BLENDER_PYTHON; None if there is none."""
    python = os.environ.get("CLSPLAT_BLENDER_PYTHON", sys.executable)
    asking = "import importlib.util, sys; sys.exit(importlib.util.find_spec('bpy') is None)"
    found = subprocess.run([python, "-c", asking], check=False, capture_output=True)
    return python if found.returncode == 0 else None


def blenders_python_or_skip() -> str:
    """Return a Python with bpy, or skip the test."""
    python = blenders_python()
    if python is None:
        pytest.skip("bpy is not installed: pip install bpy==5.0.* for Python 3.11, or set CLSPLAT_BLENDER_PYTHON")
    return python
