"""The default suite needs the extras `cpu` and `test` only: tests of other extras are skipped without them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
OTHER_EXTRAS = (
    "viser",
    "websockets",
    "playwright",
    "imageio_ffmpeg",
    "flip_evaluator",
    "pdoc",
    "lpips",
    "torch",
    "bpy",
    "pxr",
    "pillow_heif",
    "distributed",
)
COLLECT = """
import importlib.util
import sys

missing, found = sys.argv[1].split(","), importlib.util.find_spec

class Missing:
    def find_spec(name, path=None, target=None):
        if name.split(".")[0] in missing:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing)
importlib.util.find_spec = lambda name, package=None: None if name in missing else found(name, package)
import pytest
sys.exit(pytest.main(["--collect-only", "-q", "-n0", "-p", "no:cacheprovider", sys.argv[2]]))
"""


def test_the_suite_is_collected_without_other_extras() -> None:
    command = [sys.executable, "-c", COLLECT, ",".join(OTHER_EXTRAS), str(TESTS)]
    done = subprocess.run(command, cwd=TESTS.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]
